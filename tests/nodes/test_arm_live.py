"""Requests to arm and to disarm on real sockets: a real safety process, a recorder as the only subscriber, late and restarted nodes."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nodes.gateway import GatewayConfig, GatewayNode
from nodes.launching.running import has_ended
from nodes.linking.keys import DRIVE, KeyFolder
from nodes.runtime.arm_requests import arm_message, ask_to_arm
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import LaunchError
from nodes.runtime.locks import hold
from nodes.runtime.messages import drive_message, header, pose_message, types
from nodes.runtime.paths import RESOLVED_NAME, lock_path, socket_path
from nodes.runtime.requests import RequestIdentity
from tests.support.disarm import ask_to_disarm
from tests.support.live.processes import free_ports
from tests.support.messages import filled
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
CLOCK = SystemClock()


class Lab:
    """A run folder with a car that is measured and commanded, a motor node that does what it is told, and a recorder of /arm."""

    def __init__(self, folder):
        self.folder, self.process, self.recorded = folder, None, []
        self.well, self.motor, self._stopping, self.peer = True, True, False, "TWIN firmware 5.02"
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        with Bus(self.folder) as bus:
            bus.subscribe("/arm")
            bus.subscribe("/safety/drive")
            speed, next_s = 0.0, time.monotonic()
            while not self._stopping:
                bus.wait(max(0.0, next_s - time.monotonic()))
                for received in bus.receive():
                    if received.topic == "/arm":
                        self.recorded.append(received.message())
                    else:
                        speed = float(received.message().drive.speed)
                if time.monotonic() < next_s:
                    continue
                next_s += 0.02
                now_ns = time.time_ns()
                if self.well:
                    bus.publish("/vicon/car", pose_message(np.eye(4), now_ns))
                bus.publish("/policy/drive", drive_message(0.5, 0.0, now_ns))
                if self.motor:
                    bus.publish("/motor/sent", sent(speed, now_ns, self.peer))

    def start(self):
        command = [sys.executable, "-m", "nodes.safety", "--folder", str(self.folder), "--name", "safety"]
        self.process = subprocess.Popen(
            [
                *command,
                "--set",
                f"room={TWIN / 'room.yaml'}",
                "--set",
                f"vehicle={TWIN / 'vehicle.yaml'}",
                "--set",
                "nodes=[]",
            ]
        )

    def wait_ready(self, reason="not armed since the start"):
        def ready(state):
            return state.reason == reason and state.command_age_s < 0.2 and state.pose_age_s < 0.2

        self.wait_state(ready, "a safety node that is ready")

    def wait_state(self, wanted, what):
        """Wait until the safety node itself reports what is wanted."""
        with Bus(self.folder) as bus:
            bus.subscribe("/safety/state")

            def reported():
                bus.wait(0.1)
                return any(wanted(received.message()) for received in bus.receive())

            wait_for(reported, what)

    def wait_gateway(self, text):
        """Wait until the gateway of this host reports this."""
        with Bus(self.folder) as bus:
            bus.subscribe("/status/gateway")

            def reported():
                bus.wait(0.1)
                return any(text in received.message().text for received in bus.receive())

            wait_for(reported, f"a gateway that reports {text}")

    def end(self):
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def close(self):
        self.end()
        self._stopping = True
        self._thread.join()


def sent(speed_mps, stamp_ns, peer):
    return filled(
        types.MotorSent,
        header=header(stamp_ns),
        speed_mps=speed_mps,
        servo=0.5,
        braking=speed_mps == 0.0,
        peer=peer,
    )


@pytest.mark.parametrize(
    ("peer", "told"),
    [
        ("TWIN firmware 5.02", "the simulated car at 192.0.2.7, TWIN firmware 5.02"),
        ("firmware 5.02", "a REAL car at 192.0.2.7, firmware 5.02"),
        ("", "the car at 192.0.2.7, whose motor node does not report; it may be REAL"),
    ],
)
def test_the_car_of_another_host_is_named_by_what_its_motor_node_reports(lab, peer, told):
    """A workstation's launch has no motor node that says which car it drives."""
    imports = "[/motor/sent, /safety/state]"
    resolved = (
        f"nodes: {{gateway: {{module: nodes.gateway, config: {{connect: 192.0.2.7, imports: {imports}}}}}}}"
    )
    (lab.folder / RESOLVED_NAME).write_text(resolved)
    lab.peer = peer
    lab.start()
    lab.wait_ready()
    output, _ = command(lab, "car", "arm").communicate(timeout=600)
    assert output.splitlines()[0] == f"{lab.folder}: {told}"


@pytest.fixture
def lab(tmp_path):
    lab = Lab(tmp_path)
    yield lab
    lab.close()


def command(lab, *words):
    program = [sys.executable, "-m", "nodes.cli", *words, "--folder", str(lab.folder)]
    # A shell starts what it runs in the background with SIGINT ignored, and children inherit that.
    heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeds
    )


def test_no_request_is_lost_with_a_recorder(lab):
    lab.start()
    lab.wait_ready()
    for _ in range(15):
        answer = ask_to_arm(lab.folder, "")
        assert (answer.granted, answer.armed, answer.text) == (True, True, "operator")
        answer = ask_to_disarm(lab.folder, "enough", pytest.fail)
        assert (answer.granted, answer.armed, answer.braked) == (True, False, True)
        assert answer.text == "disarmed by operator: enough"


def test_a_disarm_waits_loudly_for_a_safety_node_that_joins_late(lab):
    asking = command(lab, "disarm", "--reason", "look out")
    first = asking.stderr.readline()
    while "nothing is known yet" in first:  # a slow computer
        first = asking.stderr.readline()
    assert "NOT CONFIRMED: no answer from the safety node for 0." in first
    wait_for(
        lambda: lab.recorded, "the request at the recorder"
    )  # the command repeats it until the node answers
    lab.start()
    output, _ = asking.communicate(timeout=600)
    assert (asking.returncode, output) == (0, "CONFIRMED: not armed: disarmed by operator: look out\n")


def test_a_disarm_that_is_given_up_is_no_success(lab):
    asking = command(lab, "disarm")
    assert "NOT CONFIRMED" in asking.stderr.readline()
    asking.send_signal(signal.SIGINT)
    assert asking.wait(120) == 130
    asking.stdout.close()
    asking.stderr.close()


def test_a_disarm_without_a_motor_node_says_so(lab):
    lab.start()
    lab.wait_ready()
    lab.motor = False
    asking = command(lab, "disarm")
    output, errors = asking.communicate(timeout=600)
    assert asking.returncode == 1
    assert output == ""
    assert (
        "NOT CONFIRMED: not armed: disarmed by operator: , but the motor node did not report within 0.3 s"
        in errors
    )


def test_why_it_is_not_armed(lab):
    with pytest.raises(LaunchError, match=r"from the safety node within 2 s, got none; the car may be armed"):
        ask_to_arm(lab.folder, "")
    lab.start()
    lab.wait_ready()
    lab.well = False
    time.sleep(0.4)
    asking = command(lab, "car", "arm")
    output, errors = asking.communicate(timeout=600)
    assert (asking.returncode, errors) == (1, "")
    named, answer = output.splitlines()
    assert named == f"{lab.folder}: no motor node on this host"
    assert answer.startswith("not armed: no pose of the car for ")


REFUSED = "refused at the drive door of robot: our key robot is not on its list; allow it there"
SILENT = "the other host has been silent for "


@contextlib.contextmanager
def way_to_a_car(lab, allowed, imports=("/safety/state",)):
    """The gateway's process of a workstation, and a car without a safety node that allows its key or not. Yields what ends the car."""
    keys = KeyFolder(lab.folder / "keys")
    keys.new("robot")
    if allowed:
        keys.allow("robot", DRIVE)
    watch_port, drive_port = free_ports(2)
    common = {"watch_port": watch_port, "drive_port": drive_port, "keys": keys.path}
    there = GatewayConfig(listen="127.0.0.1", imports=("/arm",), exports=imports, **common)
    car = GatewayNode(there, lambda topic: 0)
    config = GatewayConfig(connect="127.0.0.1", exports=("/arm",), imports=imports, **common)
    settings = [
        part
        for name, value in config.model_dump(mode="json").items()
        for part in ("--set", f"{name}={json.dumps(value)}")
    ]
    program = [sys.executable, "-m", "nodes.gateway", "--folder", str(lab.folder), "--name", "gateway"]
    gateway = subprocess.Popen([*program, *settings])
    with contextlib.ExitStack() as at_the_end:
        at_the_end.callback(gateway.wait)
        at_the_end.callback(gateway.terminate)
        at_the_end.callback(car.inbox.close)
        end_car = contextlib.ExitStack()
        end_car.callback(car.close)
        at_the_end.callback(end_car.close)
        yield end_car.close


@pytest.mark.parametrize(("allowed", "told"), [(False, REFUSED), (True, SILENT)])
def test_what_the_gateway_reports_is_added_where_no_safety_node_answers(lab, allowed, told):
    told = f"The gateway reports: {told}"
    with way_to_a_car(lab, allowed) as end_car:
        if allowed:
            wait_for(lambda: "Check that the node is running" in why_not_armed(lab), "a link that is up")
            end_car()
        wait_for(lambda: told in why_not_armed(lab), "the gateway's report")
        why = why_not_armed(lab)
        assert (
            "Check that the node" in why,
            why.endswith(". To be safe, run advnerf disarm on the car"),
        ) == (
            False,
            True,
        )
        asking = command(lab, "disarm")
        wait_for(lambda: told in asking.stderr.readline(), "the gateway's report")
        asking.send_signal(signal.SIGINT)
        assert asking.wait(120) == 130
        asking.stdout.close()
        asking.stderr.close()


def test_a_host_that_is_not_heard_is_not_blamed_for_the_safety_node_of_this_one(lab):
    with way_to_a_car(lab, True, imports=("/vicon/board",)) as end_car:
        end_car()
        lab.wait_gateway("the other host has not been heard yet")
        assert "Check that the node is running. To be safe, run advnerf disarm" in why_not_armed(lab)


def why_not_armed(lab):
    with pytest.raises(LaunchError) as failure:
        ask_to_arm(lab.folder, "")
    return str(failure.value)


def test_a_hung_safety_node_answers_when_it_wakes_and_an_arm_is_void_by_then(lab):
    lab.start()
    lab.wait_ready()
    os.kill(lab.process.pid, signal.SIGSTOP)
    asking = command(lab, "disarm")
    assert "NOT CONFIRMED" in asking.stderr.readline()
    asked = RequestIdentity.at(CLOCK.now())
    with sender(lab) as send:
        send(asked)
        time.sleep(1.1)
        os.kill(lab.process.pid, signal.SIGCONT)
        output, _ = asking.communicate(timeout=600)
        assert (asking.returncode, output) == (0, "CONFIRMED: not armed: disarmed by operator: \n")
        state = send.until_answered(asked)
    assert not state.armed
    assert not state.granted


def test_a_fault_between_two_repeats_of_an_arm_leaves_the_car_disarmed(lab):
    lab.start()
    lab.wait_ready()
    asked = RequestIdentity.at(CLOCK.now())
    with sender(lab) as send:
        assert send.until_answered(asked).armed
        lab.well = False
        time.sleep(0.35)
        lab.well = True
        time.sleep(0.1)
        state = send.until_answered(asked)
    assert not state.armed
    if (
        CLOCK.now().mono_ns - asked.mono_ns < 1_000_000_000
    ):  # else a slow computer made the request itself void
        assert state.granted
    assert state.reason.startswith("no pose of the car for ")


def test_a_restart_between_two_repeats_of_an_arm_leaves_the_car_disarmed(lab):
    lab.start()
    lab.wait_ready()
    asked = RequestIdentity.at(CLOCK.now())
    with sender(lab) as send:
        assert send.until_answered(asked).armed
        lab.end()
        lab.start()
        lab.wait_ready()
        state = send.until_answered(asked)
    assert (state.armed, state.granted) == (False, False)
    assert "older than the last stop (not armed since the start)" in state.answer


class Sender:
    """Repeats requests to arm, as a client of its own kind might."""

    def __init__(self, bus):
        self._bus = bus

    def __call__(self, asked):
        now = CLOCK.now()
        self._bus.publish("/arm", arm_message(asked, now, True, "operator", ""))

    def until_answered(self, asked):
        self._bus.receive()
        sent_ns, deadline = time.monotonic_ns(), time.monotonic() + 60.0
        while time.monotonic() < deadline:
            self(asked)
            self._bus.wait(0.02)
            for received in self._bus.receive():
                state = received.message()
                if state.answered_id == asked.ask_id and received.info.publish_mono_ns > sent_ns:
                    return state
        raise AssertionError("no answer")


@contextlib.contextmanager
def sender(lab):
    with Bus(lab.folder) as bus:
        bus.subscribe("/safety/state")
        yield Sender(bus)


def test_nothing_can_be_armed_where_every_process_has_ended(lab):
    lab.start()
    lab.wait_ready()
    assert not has_ended(lab.folder)
    lab.close()
    assert has_ended(lab.folder)
    _, errors = command(lab, "car", "arm").communicate(timeout=600)
    assert "all of its nodes have ended; start it" in errors


WORKSTATION = """\
nodes:
  policy: {module: nodes.policy}
  gateway: {module: nodes.gateway, config: {imports: [/safety/state, /status/safety]}}
"""
OVER = {
    "nodes: {safety: {module: nodes.safety}}\n": "all nodes of this launch have ended; the motor controller brakes after its own timeout",
    WORKSTATION: "this host's launch has ended and cannot reach the car; run advnerf disarm on the car",
}


@pytest.mark.parametrize("resolved", OVER)
def test_an_ended_launch_is_told_and_never_asked_for_ever(tmp_path, resolved):
    """Of a workstation too: without its gateway no request leaves it."""
    run = SimpleNamespace(folder=tmp_path)
    (tmp_path / RESOLVED_NAME).write_text(resolved)
    for words in (("car", "arm"), ("car", "topic", "list"), ("car", "top")):
        asking = command(run, *words)
        output, errors = asking.communicate(timeout=600)
        assert (asking.returncode, output) == (2, "")
        assert "but all of its nodes have ended; start it" in errors
    asking = command(run, "disarm")
    output, errors = asking.communicate(timeout=600)
    assert (asking.returncode, output) == (1, "")
    last = errors.splitlines()[-1]  # a slow start of the command has a word before
    assert last == f"error: NOT CONFIRMED: {OVER[resolved]}. The car may be driving. Use the e-stop"


def test_a_disarm_ends_when_the_gateway_does_although_another_node_stays(lab):
    (lab.folder / RESOLVED_NAME).write_text(WORKSTATION)
    lab.start()
    lab.wait_ready()
    os.kill(lab.process.pid, signal.SIGSTOP)  # stays, and answers nothing
    with hold(lock_path(socket_path(lab.folder, "/status/gateway"))):
        asking = command(lab, "disarm")
        for _ in range(2):
            assert "NOT CONFIRMED: " in asking.stderr.readline()
    _, errors = asking.communicate(timeout=600)
    assert asking.returncode == 1
    assert f"NOT CONFIRMED: {OVER[WORKSTATION]}" in errors


@pytest.mark.parametrize("resolved", ["nodes: [", "[]"])
def test_a_damaged_file_of_a_run_ends_no_request_to_stop_its_car(lab, resolved):
    (lab.folder / RESOLVED_NAME).write_text(resolved)
    asking = command(lab, "disarm")
    assert "NOT CONFIRMED: " in asking.stderr.readline()
    lab.start()
    output, _ = asking.communicate(timeout=600)
    assert (asking.returncode, "CONFIRMED: not armed" in output) == (0, True)
