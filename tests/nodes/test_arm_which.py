"""Which launch is armed, and that a stop never asks: real safety processes, launches that other terminals have started."""

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from nodes.runtime.locks import hold
from tests.nodes.test_arm_live import Lab

pytestmark = pytest.mark.live


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A user with no launches, and a place for those that the test starts."""
    for name in ("XDG_RUNTIME_DIR", "TMPDIR"):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name))
    desk = Desk(tmp_path)
    yield desk
    desk.close()


class Desk:
    """Starts runs that look like launches from a folder of their own."""

    def __init__(self, folder):
        self.folder, self._labs, self._locks = folder, [], []

    def launch(self, name, cwd, motor=None, safety=True):
        """A running launch: its lock, its card, its resolved file, a safety node and what stands for the other nodes."""
        run_dir = self.folder / name
        run_dir.mkdir()
        nodes = {"motor": {"module": "nodes.motor", "config": motor}} if motor else {}
        nodes |= {"twin": {"module": "nodes.twin"}} if name == "twin" else {}
        (run_dir / "launch.resolved.yaml").write_text(yaml.safe_dump({"name": name, "nodes": nodes}))
        self._locks.append(hold(run_dir / "launch.lock"))
        cards = self.folder / "XDG_RUNTIME_DIR" / "advnerf" / "active"
        cards.mkdir(parents=True, exist_ok=True)
        card = {"name": name, "run_dir": str(run_dir), "pid": os.getpid(), "cwd": str(cwd)}
        (cards / f"{name}.json").write_text(json.dumps(card))
        lab = Lab(run_dir)
        self._labs.append(lab)
        if safety:
            lab.start()
            lab.wait_ready()
        return lab

    def advnerf(self, *words, cwd=None, stdin=subprocess.DEVNULL):
        return subprocess.Popen(
            [sys.executable, "-m", "nodes.cli", *words],
            cwd=cwd or self.folder,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def close(self):
        for lab in self._labs:
            lab.close()
        for lock in self._locks:
            lock.close()


def confirmed(line, name):
    return line.startswith(f"{name} in ") and ": CONFIRMED: not armed: disarmed by operator" in line


def test_disarm_stops_all_launches_and_names_each(desk):
    desk.launch("one", desk.folder)
    desk.launch("two", "/elsewhere")
    output, errors = (asking := desk.advnerf("disarm")).communicate(timeout=600)
    assert asking.returncode == 0, errors
    first, second = sorted(output.splitlines())
    assert confirmed(first, "one")
    assert confirmed(second, "two")


def test_a_launch_that_hangs_delays_no_other_stop_and_is_not_confirmed(desk):
    desk.launch("well", desk.folder)
    hung = desk.launch("hung", desk.folder)
    os.kill(hung.process.pid, signal.SIGSTOP)
    asking = desk.advnerf("disarm")
    assert confirmed(asking.stdout.readline(), "well")
    late = asking.stderr.readline()
    while "nothing is known yet" in late:  # a slow computer
        late = asking.stderr.readline()
    assert late.startswith("error: hung in ")
    assert "NOT CONFIRMED: no answer from the safety node for 0." in late
    os.kill(hung.process.pid, signal.SIGCONT)
    output, _ = asking.communicate(timeout=600)
    assert asking.returncode == 0
    assert confirmed(output, "hung")


def test_a_launch_whose_sockets_cannot_be_used_does_not_keep_the_others_from_stopping(desk):
    desk.launch("well", desk.folder)
    broken = desk.launch("broken", desk.folder, safety=False)
    broken.close()
    bus = broken.folder / "bus"
    bus.rename(bus.with_name("gone"))
    bus.write_text("no folder")
    output, errors = (asking := desk.advnerf("disarm")).communicate(timeout=600)
    assert asking.returncode == 1
    assert confirmed(output, "well")
    assert "error: broken in " in errors
    assert "NOT CONFIRMED: " in errors


def test_a_stop_without_a_launch_is_not_confirmed(desk):
    output, errors = (asking := desk.advnerf("disarm")).communicate(timeout=600)
    assert (asking.returncode, output) == (2, "")
    assert "NOT CONFIRMED: found no running launch of user" in errors


def test_a_launch_of_this_folder_is_named_and_armed(desk):
    motor = {"port": str(desk.folder / "twin" / "vesc"), "calibration": "calibration/twin/vehicle.yaml"}
    lab = desk.launch("twin", desk.folder, motor)
    output, errors = (asking := desk.advnerf("car", "arm")).communicate(timeout=600)
    assert (asking.returncode, errors) == (0, "")
    car = "the simulated car, calibration/twin/vehicle.yaml"
    assert output.splitlines() == [f"twin in {lab.folder}: {car}", "armed by operator"]


@pytest.mark.parametrize(
    ("launches", "why"),
    [
        ([("one", "/elsewhere")], "because it was not started in this folder; name it with --folder"),
        ([("one", None), ("two", None)], "because 2 launches are running; name it with --folder"),
    ],
)
def test_without_a_terminal_a_launch_that_is_not_plain_is_refused(desk, launches, why):
    real = {"port": "/dev/serial/by-id/vesc", "calibration": "car/vehicle.yaml"}
    for name, cwd in launches:
        desk.launch(name, cwd or desk.folder, real, safety=False)
    output, errors = (asking := desk.advnerf("car", "arm")).communicate(timeout=600)
    assert asking.returncode == 2
    assert why in errors
    assert output.count("a REAL car at /dev/serial/by-id/vesc, car/vehicle.yaml") == len(launches)


@pytest.mark.parametrize(
    ("names", "typed", "armed"),
    [(["one"], "y\n", "one"), (["one"], "n\n", ""), (["one", "two"], "3\n2\n", "two")],
)
def test_in_a_terminal_the_person_decides(desk, names, typed, armed):
    labs = {name: desk.launch(name, "/elsewhere", safety=name == armed) for name in names}
    terminal, other_end = pty.openpty()
    asking = desk.advnerf("car", "arm", stdin=other_end)
    os.close(other_end)
    os.write(terminal, typed.encode())
    output, _ = asking.communicate(timeout=600)
    os.close(terminal)
    assert (asking.returncode == 0) == bool(armed), output
    assert ("armed by operator" in output) == bool(armed)
    for name, lab in labs.items():
        if (
            name == armed
        ):  # a recorder may join after the command has ended: the safety node says what it was asked
            lab.wait_state(lambda state: state.answered_id and state.granted, "a request that was granted")
        else:
            assert lab.recorded == []


def test_without_a_launch_the_way_to_start_one_is_told(desk):
    _, errors = desk.advnerf("car", "arm").communicate(timeout=600)
    assert "expected a running launch, found none; start one with advnerf launch FILE" in errors
