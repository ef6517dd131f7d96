"""State of the motor controller (telemetry, settings, steering check), and whether it allows arming."""

from __future__ import annotations

from typing import Any

from advnerf_core.geometry import yaw_of
from hardware.motor.odometry import Odometry
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_replies import FirmwareVersion, Values
from hardware.motor.vesc_settings import AppConfiguration, TimeoutSettings
from nodes.control.motor_reports import ControllerReport, odometry_message
from nodes.control.steering_check import CheckSettings, SteeringCheck
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.messages import finite_pose
from nodes.runtime.node import Out
from nodes.runtime.requests import Answer, AnswerMemory
from nodes.runtime.twin_port import is_twin, peer_text

# Number of requests for the settings before the controller counts as one that does not report them.
_SETTINGS_ASKS = 3


class ControllerWatch:
    """Collects the reports of a controller.

    Args:
        wanted: Longest accepted time-out and smallest accepted brake current of the controller.
        steering_check: ``required``, ``unless_twin`` or ``never``.
        shown: Settings of the steering check.

    Attributes:
        check: The steering check.
        values: Last telemetry; None before the first.
        timeout: Time-out as read back; None if the controller does not report it.
        answers: Answers to requests about the check.
        peer: Identity of the controller; `is_twin` tells whether it is the twin of this run.
    """

    def __init__(self, wanted: TimeoutSettings, steering_check: str, shown: CheckSettings) -> None:
        self.check = SteeringCheck(shown)
        self.answers = AnswerMemory()
        self.values: Values | None = None
        self.timeout: TimeoutSettings | None = None
        self._wanted = wanted
        self._policy = steering_check
        self._odometry = Odometry(shown.wheelbase_m)
        self.peer = ""
        self._firmware: FirmwareVersion | None = None
        self._checked_with: FirmwareVersion | None = None
        self._swapped = False
        self._asks_left = _SETTINGS_ASKS

    def connected(self, firmware: FirmwareVersion, on_twins_port: bool) -> None:
        """Note that a controller answered. Earlier reports are discarded until it repeats them.

        Args:
            firmware: Firmware version in its answer.
            on_twins_port: Whether the port is the one that the twin of this run has made.
        """
        self.values = self.timeout = None
        self.peer = peer_text(str(firmware), firmware.hardware_name, on_twins_port)
        self._firmware, self._asks_left = firmware, _SETTINGS_ASKS
        if self._checked_with not in (None, firmware):
            self._swapped = True
            self.check.forget(f"{self._checked_with} was replaced by {firmware}")
        elif self._swapped:
            self.check.forget(f"{firmware} is back, after another controller was in its place")

    def poll(self, vesc: Vesc) -> None:
        """Request telemetry, and the settings until they are known."""
        if self.timeout is None and self._asks_left:
            self._asks_left -= 1
            vesc.request_app_configuration()
        vesc.request_values()

    def settings_unreadable(self) -> None:
        """Note that the settings cannot be parsed, so that they are not requested again."""
        self._asks_left = 0

    def hear(self, reply: Any, vesc: Vesc, now: Now) -> list[Out]:
        """Note a reply. Returns odometry if the reply is telemetry."""
        if isinstance(reply, AppConfiguration):
            self.timeout = reply.timeout
        if not isinstance(reply, Values):
            return []
        self.values = reply
        speed, steering = vesc.gains.speed_mps(reply.erpm), vesc.gains.steering_rad(vesc.servo)
        state = self._odometry.update(speed, steering, vesc.last_reply_mono_ns)
        return [Out("/odom", odometry_message(state, now.real_ns))]

    def start_check(self, mono_ns: int) -> None:
        """Start the steering check."""
        self._checked_with, self._swapped = self._firmware, False
        self.check.start(mono_ns)

    def obey(self, message: Any, refusal: str, mono_ns: int) -> None:
        """Execute a request about the steering check once. A repeat gets the same answer.

        Args:
            message: A ``SteeringCheck``.
            refusal: Why no request can be executed now; empty if it can.
            mono_ns: Monotonic time [ns].
        """
        ask_id, action = str(message.ask_id), str(message.action)
        if self.answers.repeat(ask_id):
            return
        if action not in ("start", "confirm", "deny"):
            refusal = f"expected start, confirm or deny, got {action[:40]!r}"
        elif not refusal and action != "start" and not self.check.awaits_answer(mono_ns):
            refusal = "no steering check is waiting for an answer; start one"
        if not refusal and action == "start":
            self.start_check(mono_ns)
        elif not refusal:
            self.check.answer(action == "confirm", str(message.source), mono_ns)
        self.answers.give(Answer(ask_id, not refusal, refusal or self.check.text))

    def see(self, message: Any, mono_ns: int) -> None:
        """Note a pose of the car during the steering check."""
        if not self.check.showing:
            return
        if (T := finite_pose(message)) is not None:
            self.check.pose(float(T[0, 3]), float(T[1, 3]), yaw_of(T), mono_ns)

    @property
    def steering_good(self) -> bool:
        """Whether the steering check allows arming."""
        exempt = self._policy == "never" or (self._policy == "unless_twin" and is_twin(self.peer))
        # A check that is running or has failed prevents arming on every car.
        return self.check.passed or (exempt and self._checked_with is None)

    def missing(self) -> str:
        """Return why the car cannot be armed; empty if it can."""
        if self.values is None:
            return "no telemetry yet"
        if self.timeout is None and self._asks_left:
            return "reading the controller's settings"
        if self.timeout is not None and not self.timeout.at_least(self._wanted):
            return (
                f"expected a time-out of the controller of at most {self._wanted.timeout_ms} ms with at least"
                f" {self._wanted.brake_current_a:g} A, it is {self.timeout}; stop the launch and run advnerf car motor set-timeout"
            )
        return "" if self.steering_good else self.check.text

    def text(self) -> str:
        """Describe the controller in one line."""
        if self.timeout is None:
            return f"{self._firmware}, own time-out not read back (this firmware does not report it; check it in VESC Tool)"
        return f"{self._firmware}, own time-out {self.timeout}"

    def report(self, vesc: Vesc, link: str, battery_warning_v: float, now: Now) -> ControllerReport:
        """Collect the report for the diagnostics."""
        age_s = (now.mono_ns - vesc.last_reply_mono_ns) / NS_PER_S
        return ControllerReport(
            self.values,
            age_s,
            self._firmware,
            self.timeout,
            self._wanted,
            vesc.skipped_bytes,
            link,
            self.check.text,
            self.steering_good,
            battery_warning_v,
            self.answers.last,
        )
