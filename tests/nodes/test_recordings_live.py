"""Recordings, hands and stopped processes on real sockets: the safety and the motor node as processes, a controller behind a pty."""

import signal
import subprocess
import sys
import threading
import time

import pytest

from advnerf_core.geometry import planar_pose
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.bags.writer import BagWriter
from nodes.linking.keys import DRIVE, KeyFolder
from nodes.runtime.bus import Bus
from nodes.runtime.messages import drive_message, pose_message
from tests.support.harmful_recording import EVERY, recorded
from tests.support.stack import CALIBRATION, REPOSITORY, TIMEOUT
from tests.support.virtual_stack import teleop_message
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

HOUR_NS = 3600 * 10**9
PORTS = (5790, 5791)
# Published by the car of this test, so that no player could.
OCCUPIED = ("/vicon/car", "/policy/drive", "/diagnostics", "/motor/state", "/odom")


class Car:
    """A run folder with a car that is measured and commanded, and a hand that the test moves.

    Attributes:
        hand: Mode of the button; None without a teleop node.
        hand_age_ns: What the stamps of the hand are older than now [ns].
    """

    def __init__(self, folder):
        self.folder, self.hand, self.hand_age_ns = folder, None, 0
        self.armed, self.motor, self._processes, self._stopping = False, "", {}, False
        self.emulator = VescEmulator(
            VescEmulatorConfig(hardware_name="60", **TIMEOUT), TwinVehicle(CarConfig()), folder / "vesc"
        )
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        with Bus(self.folder) as bus:
            bus.subscribe("/safety/state")
            bus.subscribe("/status/motor")
            while not self._stopping:
                now_ns = time.time_ns()
                bus.publish("/vicon/car", pose_message(planar_pose(-1.1, -2.0, 0.0), now_ns))
                bus.publish("/policy/drive", drive_message(0.25, 0.1, now_ns))
                if self.hand is not None:
                    bus.publish("/teleop/state", teleop_message(self.hand, now_ns - self.hand_age_ns))
                bus.wait(0.02)
                time.sleep(0.01)
                for received in bus.receive():
                    if received.topic == "/safety/state":
                        self.armed = bool(received.message().armed)
                    else:
                        self.motor = str(received.message().text)

    def start(self, name, *settings, folder=None):
        arguments = [argument for setting in settings for argument in ("--set", setting)]
        command = [sys.executable, "-m", f"nodes.{name}", "--folder", str(folder or self.folder), *arguments]
        self._processes[str(folder), name] = subprocess.Popen(command, cwd=REPOSITORY)
        return self._processes[str(folder), name]

    def start_nodes(self):
        vehicle = CALIBRATION / "vehicle.yaml"
        self.safety = self.start(
            "safety",
            f"room={CALIBRATION / 'room.yaml'}",
            f"vehicle={vehicle}",
            "nodes=[motor]",
            "teleop=hold",
        )
        self.driver = self.start(
            "motor", f"port={self.folder / 'vesc'}", f"calibration={vehicle}", "steering_check=never"
        )
        wait_for(lambda: "own time-out" in self.motor, "the motor node to be ready")
        return self

    def moves(self, since_ns=0):
        return [e for e in self.emulator.events(since_ns) if e.name in ("SET_RPM", "SET_SERVO_POS")]

    def press(self):
        """Let go, and hold the button until the car drives."""
        self.hand, since_ns = "idle", time.monotonic_ns()
        time.sleep(0.5)
        self.hand = "autonomy"

        def drives():
            if not self.armed and time.monotonic_ns() - since_ns > 10**9 and self.hand == "autonomy":
                self.hand = "idle"  # a loaded machine stopped it; a person would press again
                time.sleep(0.3)
                self.hand = "autonomy"
                time.sleep(0.3)
            return self.moves(since_ns)

        wait_for(drives, "the car to drive")

    def close(self):
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self._processes.values():
            process.wait(120)
        self._stopping = True
        self._thread.join()
        self.emulator.close()


@pytest.fixture
def car(tmp_path):
    (tmp_path / "car").mkdir()
    car = Car(tmp_path / "car")
    try:
        yield car
    finally:
        car.close()


def played(folder, bag, *settings):
    command = [sys.executable, "-m", "nodes.player", "--folder", str(folder), "--set", f"bag={bag}"]
    for setting in ("rate=4", "wait_for=[]", *settings):
        command += ["--set", setting]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)


def stranger(folder, topic, age_ns, duration_s):
    """Publish a recording of a topic with the times of now, as a player of somebody else's would."""
    with Bus(folder) as bus:
        bus.publisher(topic)
        time.sleep(0.3)
        for index in range(round(25 * duration_s)):
            bus.publish(topic, recorded(topic, index, time.time_ns() - age_ns))
            time.sleep(0.04)


def test_a_recording_of_a_hand_drives_nothing_in_real_processes(car, tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for index in range(50):
            at_ns = time.time_ns() - HOUR_NS + index * 40_000_000
            for topic in EVERY:
                if topic not in OCCUPIED:
                    writer.write(topic, recorded(topic, index, at_ns), at_ns, at_ns, index)
    car.start_nodes()
    plain = played(car.folder, tmp_path / "bag")
    assert plain.returncode == 0, plain.stderr
    for settings in (
        ["topics=[/teleop/state]"],
        ["remap={/teleop/state: /teleop/state}"],
        ["topics=[/twin/reset]", "remap={/twin/reset: /vicon/board}"],
        ["topics=[/vicon/board]", "remap={/vicon/board: /twin/reset}"],
    ):
        refused = played(car.folder, tmp_path / "bag", *settings)
        assert refused.returncode == 2
        assert "a recording must not move or arm a car" in refused.stderr
        assert refused.stderr.count("\n") == 1
    for age_ns in (HOUR_NS, -HOUR_NS):
        stranger(car.folder, "/teleop/state", age_ns, 2.0)
    assert not car.moves()
    stranger(car.folder, "/teleop/state", 0, 2.0)  # a hand of now does drive
    assert car.moves()


def test_a_recording_of_a_hand_does_not_cross_to_another_host(car, tmp_path):
    keys = {name: KeyFolder(tmp_path / f"keys_{name}") for name in ("robot", "workstation")}
    public = {name: folder.new(name) for name, folder in keys.items()}
    keys["workstation"].add("robot", public["robot"])
    keys["robot"].add("workstation", public["workstation"])
    keys["robot"].allow("workstation", DRIVE)
    ports = (f"watch_port={PORTS[0]}", f"drive_port={PORTS[1]}")
    there = tmp_path / "workstation"
    there.mkdir()
    car.start_nodes()
    robot = (f"keys={keys['robot'].path}", "listen=127.0.0.1", "imports=[/teleop/state]")
    car.start("gateway", *robot, *ports)
    workstation = (f"keys={keys['workstation'].path}", "key=workstation", "connect=127.0.0.1")
    car.start("gateway", *workstation, "exports=[/teleop/state]", *ports, folder=there)
    for age_ns in (HOUR_NS, -HOUR_NS):
        stranger(there, "/teleop/state", age_ns, 2.0)
    assert not car.moves()

    def drives():
        stranger(there, "/teleop/state", 0, 2.0)
        return car.moves()

    wait_for(drives, "a hand of now on the other host to drive")


@pytest.mark.parametrize("stopped", [("motor",), ("safety",), ("motor", "safety")])
def test_processes_that_are_stopped_and_go_on_do_not_drive_on(car, stopped):
    """SIGSTOP, as a freezer or a debugger sends it, for longer than the command limit."""
    car.start_nodes().press()
    processes = [car.driver if name == "motor" else car.safety for name in stopped]
    for process in processes:
        process.send_signal(signal.SIGSTOP)
    time.sleep(1.0)
    since_ns = time.monotonic_ns()
    for process in processes:
        process.send_signal(signal.SIGCONT)
    wait_for(lambda: not car.armed, "the safety node to say that the car is disarmed")
    time.sleep(0.5)  # the button is still held
    # One decision that was made before the stop may still leave; the next turn of the loop brakes.
    late = [event for event in car.moves(since_ns) if event.mono_ns - since_ns > 200_000_000]
    assert not late
    assert not car.armed
    car.press()
