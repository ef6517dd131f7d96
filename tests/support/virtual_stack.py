"""The safety node and the motor node with everything around them, on clocks that the test moves: milliseconds of work per second.

The motor node's driver and the controller's firmware are the real ones, joined by bytes in memory.
"""

from __future__ import annotations

from typing import Any

from advnerf_core.geometry import planar_pose
from calibration.schema import VehicleCalibration, load_calibration
from hardware.emulators.vesc_firmware import VescEmulatorConfig, VescFirmware, WireEvent
from hardware.motor.vesc import Vesc
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.control.arming_gates import ClockGate, HandGate
from nodes.motor import MotorConfig, MotorNode
from nodes.runtime.arm_requests import arm_message
from nodes.runtime.clock import Now
from nodes.runtime.messages import camera_info_message, drive_message, header, pose_message, types
from nodes.runtime.node import MessageInfo, Out
from nodes.runtime.requests import RequestIdentity
from nodes.safety import SafetyConfig, SafetyNode
from tests.support.messages import filled
from tests.support.stack import CALIBRATION, TIMEOUT

MS, S = 10**6, 10**9
REAL_NS = 1_900_000_000 * S
STEP_MS = 20
ROOM, VEHICLE = CALIBRATION / "room.yaml", CALIBRATION / "vehicle.yaml"
NODES = ("camera", "vicon", "policy", "motor")
START_M = (-1.1, -2.0)
MOVES = ("SET_RPM", "SET_SERVO_POS")
SAFETY, MOTOR, STRANGER = 1, 2, 99


class _Wire:
    """A serial port whose other end is the firmware."""

    def __init__(self, stack: VirtualStack) -> None:
        self._stack, self._replies = stack, b""

    @property
    def in_waiting(self) -> int:
        return len(self._replies)

    def write(self, data: bytes) -> None:
        replies, events = self._stack.firmware.receive(data, self._stack.mono_ns)
        self._replies += replies
        self._stack.events += events

    def fileno(self) -> int:
        return -1

    def read(self, count: int) -> bytes:
        data, self._replies = self._replies[:count], self._replies[count:]
        return data

    def close(self) -> None:
        pass


class _WiredVesc(Vesc):
    """The driver on such a port."""

    stack: VirtualStack

    def open(self) -> None:
        self._serial = self._wire = _Wire(self.stack)  # type: ignore[assignment]

    def _put(self, fd: int, data: bytes) -> None:
        self._wire.write(data)


class VirtualStack:
    """A car whose camera, motion capture and policy are well until the test says otherwise.

    Args:
        monkeypatch: Gives the driver this stack's clock.
        hold: Whether the car may only move while a button is held.
        speed_mps: What the policy commands.
        drivers: Nodes that may command the car.
        peers: Hosts whose clock offset must be known.
        hardware_name: Name that the controller's firmware reports.

    Attributes:
        hand: What the button does; None without a teleop node.
        silent: Publishers that say nothing.
        real_off_ns: What each publisher's real-time clock is ahead of ours, by publisher [ns].
        reason: Last reason of the safety node.
        events: What the firmware read.
    """

    def __init__(
        self,
        monkeypatch: Any,
        hold: bool = False,
        speed_mps: float = 0.8,
        drivers: tuple[str, ...] = ("policy",),
        peers: tuple[str, ...] = (),
        hardware_name: str = "60",
    ) -> None:
        self.mono_ns, self.real_ns, self.asleep_ns = 50 * S, REAL_NS, 7 * S
        self.speed_mps, self.hand = speed_mps, "idle" if hold else None
        self.silent: set[str] = set()
        self.real_off_ns: dict[str, int] = {}
        self.events: list[WireEvent] = []
        self.reason, self.armed, self._ticks = "", False, 0
        self._motor_outs: list[Out] = []
        monkeypatch.setattr("hardware.motor.vesc.time", self)
        self.car = TwinVehicle(CarConfig())
        self.car.reset(*START_M, 0.0)
        self.firmware = VescFirmware(VescEmulatorConfig(hardware_name=hardware_name, **TIMEOUT), self.car)
        self.config = SafetyConfig(room=ROOM, vehicle=VEHICLE, nodes=NODES, drivers=drivers)
        vehicle = load_calibration(VehicleCalibration, VEHICLE)
        room = self.config.limits(_room())
        self.safety = SafetyNode(
            room,
            self.config.poses(vehicle),
            self.config.stall(),
            HandGate(hold, self.config.teleop_age_limit_s),
            ClockGate(peers=peers),
        )
        motor = MotorConfig(port="memory", calibration=VEHICLE, steering_check="never")

        def make() -> Vesc:
            vesc = _WiredVesc("memory", vehicle.vehicle_gains, vehicle.drive_limits, motor.brake_current_a)
            vesc.stack = self
            return vesc

        self.motor = MotorNode(motor, make, vehicle.wheelbase_m, self.mono_ns, lambda: False)

    # What the driver reads in place of the module time.

    def monotonic(self) -> float:
        return self.mono_ns / S

    def monotonic_ns(self) -> int:
        return self.mono_ns

    def time_ns(self) -> int:
        return self.real_ns

    def sleep(self, duration_s: float) -> None:
        raise AssertionError("the driver must not sleep")

    @property
    def now(self) -> Now:
        return Now(self.mono_ns, self.real_ns, self.asleep_ns)

    def wait(self, duration_ms: int) -> None:
        """Let time pass without any process running: a frozen computer, whose clocks go on."""
        self.mono_ns += duration_ms * MS
        self.real_ns += duration_ms * MS

    def run(self, duration_ms: int) -> VirtualStack:
        """Let everything run."""
        for _ in range(duration_ms // STEP_MS):
            self.wait(STEP_MS)
            self._ticks += 1
            self.car.advance(STEP_MS / 1e3)
            self.events += self.firmware.check_timeout(self.mono_ns)
            self._world()
            if "motor" not in self.silent:
                self._take(self.motor.tick(self.now), MOTOR)
            if self._ticks % 10 == 0 and "motor" not in self.silent:
                self.say("/status/motor", self._status("motor", *self.motor.status()), MOTOR)
            if "safety" not in self.silent:
                self._take(self.safety.tick(self.now), SAFETY)
        return self

    def arm(self, source: str = "operator") -> VirtualStack:
        """Ask the safety node to arm, as the command does."""
        self.wait(1)
        self.say("/arm", arm_message(RequestIdentity.at(self.now), self.now, True, source, "test"), 7)
        return self

    def moves(self, since_ns: int = 0) -> list[WireEvent]:
        """Commands that drive or steer: zero rpm is not among them."""
        return [
            e
            for e in self.events
            if e.mono_ns >= since_ns and e.name in MOVES and (e.value or e.name != "SET_RPM")
        ]

    def say(self, topic: str, message: Any, instance: int, published_ns: int | None = None) -> None:
        """Deliver a message to the nodes that subscribe to its topic.

        Args:
            topic: Its topic.
            message: The message.
            instance: Who publishes it.
            published_ns: When, monotonic clock; None is now [ns].
        """
        published_ns = self.mono_ns if published_ns is None else published_ns
        info = MessageInfo(published_ns, self.mono_ns, 0, b"", self.real_ns, self.real_ns, instance)
        if topic in self.motor.subscriptions:
            self._take(self.motor.handle(topic, message, info, self.now), MOTOR)
        if topic in self.safety.subscriptions and "safety" not in self.silent:
            self._take(self.safety.handle(topic, message, info, self.now), SAFETY)

    def _take(self, outs: list[Out], instance: int) -> None:
        for topic, message in outs:
            if topic == "/safety/state":
                self.armed, self.reason = bool(message.armed), str(message.reason)
            self.say(topic, message, instance)

    def stamp_ns(self, who: str, age_ms: int) -> int:
        """Stamp of what a publisher captured a moment ago, by its own clock."""
        return self.real_ns - age_ms * MS + self.real_off_ns.get(who, 0)

    def _world(self) -> None:
        state = self.car.state
        if "vicon" not in self.silent:
            pose = planar_pose(state.x_m, state.y_m, state.yaw_rad)
            self.say("/vicon/car", pose_message(pose, self.stamp_ns("vicon", 5)), 3)
        if self._ticks % 5 == 0:
            if "camera" not in self.silent:
                self.say("/camera/camera_info", _camera_info(self.stamp_ns("camera", 30)), 4)
            if "policy" not in self.silent:
                drive = drive_message(self.speed_mps, 0.1, self.stamp_ns("camera", 50))
                self.say("/policy/drive", drive, 5)
        if self._ticks % 10 == 0:
            for name, instance in (("camera", 4), ("vicon", 3), ("policy", 5)):
                if name not in self.silent:
                    self.say(f"/status/{name}", self._status(name, "active", ""), instance)
        if self.hand is not None and self._ticks % 3 == 0 and "teleop" not in self.silent:
            self.say("/teleop/state", teleop_message(self.hand, self.stamp_ns("teleop", 0)), 6)

    def _status(self, name: str, state: str, text: str) -> Any:
        return status_message(name, state, text, self.real_ns)


def status_message(name: str, state: str, text: str, stamp_ns: int) -> Any:
    """The status of a node."""
    return filled(types.NodeStatus, header=header(stamp_ns), node=name, pid=1, state=state, text=text)


def teleop_message(mode: str, stamp_ns: int, speed_mps: float = 0.0, estop: bool = False) -> Any:
    """What a hand says."""
    return types.Teleop(
        header=header(stamp_ns),
        mode=mode,
        estop=estop,
        speed_mps=speed_mps,
        steering_rad=0.1 if speed_mps else 0.0,
        device="test",
    )


def _room() -> Any:
    from calibration.schema import RoomCalibration

    return load_calibration(RoomCalibration, ROOM)


def _camera_info(stamp_ns: int) -> Any:
    from advnerf_core.geometry import Pinhole

    return camera_info_message(Pinhole(30, 20, 9, 9, 15, 10), stamp_ns, "camera")
