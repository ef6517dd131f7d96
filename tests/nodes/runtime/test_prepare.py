"""What a node's process does first: share of the processors, file descriptors, a log that cannot end it. Real processes."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nodes.lab.doctor.check import OK, WARNING
from nodes.lab.doctor.priority import shares
from nodes.runtime.bus import Bus
from nodes.runtime.descriptors import Reserve
from nodes.runtime.priority import FIRST, HELPER, WORLD, Share, nices_to_try, share_of
from tests.nodes.test_arm_live import Lab
from tests.support.disarm import ask_to_disarm
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

REPOSITORY = Path(__file__).parents[3]


def python(program, session=True, **options):
    """Run a program in a process of its own."""
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, cwd=REPOSITORY, text=True, capture_output=True, start_new_session=session, **options
    )


@pytest.mark.parametrize(
    ("nice", "current", "limit", "tried"),
    [
        (FIRST, 0, 0, [-10]),  # no privilege is promised; the kernel may still allow it
        (FIRST, 0, 25, [-10, -5]),
        (FIRST, 0, 40, [-10]),
        (FIRST, -15, 0, []),
        (FIRST, 10, 15, [-10, 5]),
        (HELPER, 0, 0, [15]),
        (HELPER, 19, 40, []),
    ],
)
def test_a_node_that_stops_the_car_is_never_lowered_and_a_helper_never_raised(nice, current, limit, tried):
    assert nices_to_try(nice, current, limit) == tried


def test_a_helper_gives_way_in_its_session_and_out_of_it():
    done = python("from nodes.runtime.priority import *; print(take_share(HELPER), share_of('self'))")
    assert done.returncode == 0, done.stderr
    # A session that was made by setsid has an autogroup where the kernel makes them; the one of this test may have none (a container's).
    made = python("print(open('/proc/self/autogroup').read())").stdout.split()
    enabled = Path("/proc/sys/kernel/sched_autogroup_enabled")
    group = f", autogroup {HELPER}" if made and enabled.read_text().strip() == "1" else ""
    assert done.stdout == f"nice {HELPER}{group} nice {HELPER}{group}\n"


def test_the_session_of_a_shell_is_left_alone():
    program = "import os; from nodes.runtime.priority import *; print(take_share(HELPER).autogroup)"
    before = share_of("self").autogroup
    assert python(program, session=False).stdout == "None\n"
    assert share_of("self").autogroup == before


def test_what_stops_the_car_and_the_simulated_lab_get_what_the_system_allows_and_doctor_says_what():
    program = "import os; os.setpriority(os.PRIO_PROCESS, 0, -10)"
    allowed = python(program).returncode == 0
    for role, nice in (("safety", FIRST), ("motor", FIRST), ("twin", WORLD)):
        done = python(f"from nodes.runtime.priority import *; print(take_share_of('{role}').nice)")
        assert int(done.stdout) == (nice if allowed else 0)
    finding = shares()[0]
    assert finding.check == "priority"
    assert finding.state == (OK if allowed else WARNING)
    assert f"nice {FIRST if allowed else 0}" in finding.found
    assert bool(finding.do) != allowed


def test_a_share_counts_only_if_both_values_reach_it():
    assert Share(-10, -10).reaches(FIRST)
    assert Share(-10, None).reaches(FIRST)
    assert not Share(-10, 0).reaches(FIRST)
    assert not Share(0, -10).reaches(FIRST)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_under_the_log_ends_no_node():
    program = (
        "import sys; from nodes.runtime.prepare import prepare_process; prepare_process('x')\n"
        "for _ in range(3000): print('a line of the log', file=sys.stderr, flush=True)\n"
        "open(sys.argv[1], 'w').write('alive')"
    )
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", program, "/dev/stdout"],
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=full,
            text=True,
        )
    assert (done.returncode, done.stdout) == (0, "alive")


def test_a_bus_without_descriptors_is_one_clear_error(tmp_path):
    program = (
        "import os, resource, sys; from pathlib import Path; from nodes.runtime.bus import Bus\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))\n"
        "held = []\n"
        "try:\n"
        "    while True: held.append(os.dup(0))\n"
        "except OSError: pass\n"
        "for free in range(40):\n"
        "    try: Bus(Path(sys.argv[1])).close()\n"
        "    except OSError as error: print(error)\n"
        "    if held: os.close(held.pop())\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    done = subprocess.run(command, cwd=REPOSITORY, text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("expected 32 free file descriptors for the sockets, got 0")
    assert 25 < len(lines) < 40


def test_a_reserve_is_freed_when_it_is_needed_and_taken_again():
    program = (
        "import json, os, resource; from nodes.runtime.descriptors import Reserve\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))\n"
        "reserve, said, held = Reserve(), [], []\n"
        "said.append(reserve.check())\n"
        "try:\n"
        "    while True: held.append(os.dup(0))\n"
        "except OSError: pass\n"
        "said.append(reserve.check())\n"
        "for _ in range(30): os.close(os.dup(0)); held.append(os.dup(0))\n"
        "said.append(reserve.check())\n"
        "for each in held: os.close(each)\n"
        "said += [reserve.check(), len(os.listdir('/proc/self/fd'))]\n"
        "print(json.dumps(said))"
    )
    first, short, still, after, count = json.loads(python(program).stdout)
    assert (first, after) == ("", "")
    assert short == still
    assert short.startswith("no file descriptor is free, the limit is 128")
    assert count > 32, "the reserve is held again"


def test_a_safety_node_without_descriptors_says_so_and_still_takes_a_stop(tmp_path):
    lab = Lab(tmp_path)
    try:
        lab.start()
        lab.wait_ready()
        with Bus(tmp_path) as eyes:
            eyes.subscribe("/status/safety")
            states = []

            def in_state(state):
                eyes.wait(0.05)
                states.extend(received.message() for received in eyes.receive())
                return states and states[-1].state == state

            wait_for(lambda: in_state("ready"), "the safety node")
            limit = len(os.listdir(f"/proc/{lab.process.pid}/fd"))
            resource.prlimit(lab.process.pid, resource.RLIMIT_NOFILE, (limit, limit))
            wait_for(lambda: in_state("fault"), "the safety node to say so")
            assert states[-1].text.startswith("no file descriptor is free")
            answer = ask_to_disarm(tmp_path, "", lambda waited_s: None)
            assert (answer.granted, answer.braked) == (True, True)
            assert lab.process.poll() is None
    finally:
        lab.close()
    assert lab.process.returncode == -signal.SIGKILL, "only the end of the test ended it"


def test_the_reserve_costs_nothing_that_is_not_given_back():
    before = len(os.listdir("/proc/self/fd"))
    reserve = Reserve()
    reserve.close()
    reserve.close()
    assert len(os.listdir("/proc/self/fd")) == before
