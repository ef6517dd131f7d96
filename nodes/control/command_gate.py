"""The gate between drive commands and the motor controller: a freshness check, and a latch.

Only a stop that arrives while the safety node reports that the car is disarmed opens the latch.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from nodes.control.stamps import COMMAND_AGE_S, stamp_problem
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.wire import MessageInfo

_IDLE_RESEND_S = 0.1
# The safety node reports ten times a second.
_REPORT_AGE_S = 0.5


@dataclass(frozen=True)
class GateSettings:
    """Settings of the gate.

    Attributes:
        command_age_limit_s: Largest age of a command since its publication, and longest pause of the motor node [s].
        brake_current_a: Brake current of a stop [A].
        brake_ramp_s: Time over which the brake current rises from a third to its full value [s].
        brake_hold_s: Duration of braking, after which the motor is released [s].
        stamp_age_limit_s: Largest age of the capture stamp of a command to move [s].
    """

    command_age_limit_s: float
    brake_current_a: float
    brake_ramp_s: float
    brake_hold_s: float
    stamp_age_limit_s: float = COMMAND_AGE_S


class GateState(Enum):
    """State of the gate."""

    LATCHED = "latched"  # obeys no command until a stop arrives while the safety node reports that the car is disarmed
    STOPPED = "stopped"  # commanded to stop; the next command to move is obeyed
    DRIVING = "driving"


@dataclass(frozen=True)
class Drive:
    """Send this speed [m/s] and steering [rad]."""

    speed_mps: float
    steering_rad: float


@dataclass(frozen=True)
class Brake:
    """Send this brake current [A]; 0 releases the motor."""

    current_a: float


class CommandGate:
    """Decides which commands reach the controller.

    Attributes:
        state: State of the gate.
        reason: Why the gate does not drive.
        refused: Number of commands that were too old, or that asked to move while the gate was latched.
    """

    def __init__(self, settings: GateSettings, mono_ns: int) -> None:
        self._settings = settings
        self._limit_ns = round(settings.command_age_limit_s * NS_PER_S)
        self._fresh_ns = mono_ns  # publication of the newest command that was obeyed
        self._ran_ns = mono_ns
        self._disarmed: MessageInfo | None = None  # the newest report of the safety node, if it says disarmed
        self._stop_began_ns = mono_ns  # a car that already rolls when this node starts is stopped first
        self._instance_id: int | None = None
        self._command = Drive(0.0, 0.0)
        self._idle_sent_ns = 0
        self.state = GateState.LATCHED
        self.reason = "waiting for the safety node"
        self.refused = 0

    def heard_safety(self, armed: bool, info: MessageInfo) -> None:
        """Note a report of the safety node."""
        self._disarmed = None if armed else info

    def command(
        self,
        speed_mps: float,
        steering_rad: float,
        info: MessageInfo,
        mono_ns: int,
        stamp_age_s: float = 0.0,
    ) -> Drive | Brake | None:
        """Handle a drive command. Returns what to send to the controller.

        Args:
            speed_mps: Commanded speed [m/s]; 0 stops.
            steering_rad: Commanded front wheel angle [rad].
            info: Transport data of the message.
            mono_ns: Current time [ns].
            stamp_age_s: Age of the command's capture stamp on this host's clock [s].
        """
        self._notice_pause(mono_ns)
        self._notice_silence(mono_ns)
        known, self._instance_id = self._instance_id, info.instance_id
        if known is not None and info.instance_id != known:
            self.latch("the safety node was restarted", mono_ns)
        if mono_ns - info.publish_mono_ns > self._limit_ns:
            self.refused += 1
            return None
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            self.latch("a command that is not finite", mono_ns)
            return self._braking(mono_ns)
        if speed_mps == 0.0:
            return self._stop(info, mono_ns)
        if self.state is GateState.LATCHED or stamp_problem(stamp_age_s, self._settings.stamp_age_limit_s):
            self.refused += 1
            return None
        self.state, self.reason = GateState.DRIVING, ""
        self._fresh_ns = info.fresh_mono_ns
        self._command = Drive(speed_mps, steering_rad)
        return self._command

    def tick(self, mono_ns: int) -> Drive | Brake | None:
        """Advance the time. Returns what to send to the controller."""
        self._notice_pause(mono_ns)
        self._notice_silence(mono_ns)
        if self.state is GateState.DRIVING:
            return self._command
        if mono_ns - self._stop_began_ns <= self._settings.brake_hold_s * NS_PER_S:
            return self._braking(mono_ns)
        if mono_ns - self._idle_sent_ns < _IDLE_RESEND_S * NS_PER_S:
            return None
        self._idle_sent_ns = mono_ns
        return Brake(0.0)

    def latch(self, reason: str, mono_ns: int) -> None:
        """Stop, and obey no command until a stop arrives while the safety node reports that the car is disarmed."""
        if self.state is GateState.DRIVING:
            self._stop_began_ns = mono_ns
        if self.state is not GateState.LATCHED:
            self.reason = reason
        self.state = GateState.LATCHED

    def brake_again(self, mono_ns: int) -> None:
        """Restart the stop, after the connection to the controller was lost."""
        self._stop_began_ns = mono_ns

    def _notice_silence(self, mono_ns: int) -> None:
        silence_ns = mono_ns - self._fresh_ns
        if self.state is not GateState.LATCHED and silence_ns > self._limit_ns:
            self.latch(f"no fresh command for {silence_ns / NS_PER_S:.2f} s", mono_ns)

    def _notice_pause(self, mono_ns: int) -> None:
        """A process that was stopped by a signal, a freezer or a debugger must not go on with what it knew before."""
        pause_ns, self._ran_ns = mono_ns - self._ran_ns, mono_ns
        if pause_ns > self._limit_ns:
            self.latch(f"the motor node was held up for {pause_ns / NS_PER_S:.2f} s", mono_ns)

    def _stop(self, info: MessageInfo, mono_ns: int) -> Brake | None:
        if self.state is GateState.LATCHED and not self._is_disarmed(info.instance_id, mono_ns):
            self.refused += 1
            return None
        self._fresh_ns = info.fresh_mono_ns
        was_driving = self.state is GateState.DRIVING
        if was_driving:
            self._stop_began_ns = mono_ns
        self.state, self.reason = GateState.STOPPED, "told to stop"
        return self._braking(mono_ns) if was_driving else None

    def _is_disarmed(self, instance_id: int, mono_ns: int) -> bool:
        report = self._disarmed
        return (
            report is not None
            and report.instance_id == instance_id
            and mono_ns - report.fresh_mono_ns <= _REPORT_AGE_S * NS_PER_S
        )

    def _braking(self, mono_ns: int) -> Brake:
        ramp_ns = self._settings.brake_ramp_s * NS_PER_S
        rise = 1.0 if ramp_ns == 0.0 else min((mono_ns - self._stop_began_ns) / ramp_ns, 1.0)
        return Brake(self._settings.brake_current_a * (1.0 + 2.0 * rise) / 3.0)
