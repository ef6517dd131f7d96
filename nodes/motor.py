"""The motor node: sends drive commands to the VESC, and stops the car unless it keeps receiving fresh commands.

It obeys only commands younger than a limit. If commands stop, are not finite, or come from a restarted safety node, it brakes and
latches: it then ignores every command to move until it receives a stop while the safety node reports that the car is disarmed. So a
process that dies, hangs or resumes cannot make the car move without a new arming. The same holds after a suspend of the computer, a
step of its clock, or a pause of this process.

The node is not ready, and the car cannot be armed, until the controller has sent telemetry and reported a short enough time-out (if
its firmware can), and the front wheels were confirmed to turn.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from advnerf_core.strict import LagS, StrictModel
from calibration.schema import VehicleCalibration, load_calibration
from hardware.errors import HardwareError, ProtocolError
from hardware.motor.limits import Sent
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_replies import Values
from hardware.motor.vesc_settings import TimeoutSettings
from nodes.control.command_gate import Brake, CommandGate, Drive, GateSettings, GateState
from nodes.control.motor_reports import diagnostics_message
from nodes.control.motor_watch import ControllerWatch
from nodes.control.stamps import COMMAND_AGE_S, REQUEST_AGE_S, ClockWatch, stamp_age_s, stamp_problem
from nodes.control.steering_check import CheckSettings
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import header, stamp_ns, types
from nodes.runtime.node import ACTIVE, FAULT, READY, STARTING, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.twin_port import is_twins_port

_TICK_RATE_HZ = 50.0
_RETRY_S = 0.5
_POLL_S = 0.04
_DIAGNOSTICS_S = 1.0


class MotorConfig(StrictModel):
    """Configuration of the motor node.

    Attributes:
        port: Serial device; ``<run_dir>/vesc`` for the twin.
        calibration: Vehicle calibration file: gains and limits.
        command_age_limit_s: Largest age of a command since its publication, and longest pause of this process [s].
        stamp_age_limit_s: Largest age of the image or the pose that a command to move is based on [s].
        brake_current_a: Brake current of a stop [A].
        brake_ramp_s: Time over which the brake current rises from a third to its full value [s].
        brake_hold_s: Duration of braking, after which the motor is released [s].
        link_timeout_s: Time without an answer of the controller after which the link is faulty [s].
        controller_timeout_ms: Longest accepted command time-out of the controller [ms].
        controller_brake_current_a: Smallest accepted brake current of the controller after its time-out [A].
        steering_check: Whether the steering check is needed before arming: ``required``, ``unless_twin`` or ``never``.
        steering_angle_rad: Front wheel angle of the steering check [rad].
        steering_hold_s: Time for which each side is held in the check [s].
        battery_warning_v: Supply voltage below which the diagnostics warn [V].
    """

    port: str
    calibration: Path
    command_age_limit_s: float = Field(default=0.22, gt=0.0, le=0.25)
    stamp_age_limit_s: float = Field(default=COMMAND_AGE_S, gt=0.0, le=0.55)
    brake_current_a: float = Field(default=20.0, ge=1.0, le=60.0)
    brake_ramp_s: float = Field(default=0.1, ge=0.0, le=0.5)
    brake_hold_s: float = Field(default=1.0, ge=0.5, le=60.0)
    link_timeout_s: LagS = Field(default=0.2, gt=0.0)
    controller_timeout_ms: int = Field(default=250, gt=0, le=5000)
    controller_brake_current_a: float = Field(default=20.0, ge=0.0)
    steering_check: Literal["required", "unless_twin", "never"] = "unless_twin"
    steering_angle_rad: float = Field(default=0.2, gt=0.0, le=0.4)
    steering_hold_s: float = Field(default=4.0, ge=1.0)
    battery_warning_v: float = Field(default=13.2, ge=0.0)


class MotorNode(Node):
    """Connects the command gate with the controller, and reports the commands that were sent.

    Args:
        make_vesc: Makes a driver that is not open yet.
        wheelbase_m: Distance between the axles, for odometry [m].
        mono_ns: Monotonic time at the start [ns].
        on_twins_port: Returns whether the port is the one that the twin of this run has made.
    """

    opens = "the motor controller"
    subscriptions = ("/safety/drive", "/safety/state", "/motor/check", "/vicon/car")
    publications = ("/motor/sent", "/motor/state", "/odom", "/diagnostics")
    tick_rate_hz = _TICK_RATE_HZ

    def __init__(
        self,
        config: MotorConfig,
        make_vesc: Callable[[], Vesc],
        wheelbase_m: float,
        mono_ns: int,
        on_twins_port: Callable[[], bool],
    ) -> None:
        self._config, self._on_twins_port = config, on_twins_port
        self._clock_watch = ClockWatch()
        self._vesc = make_vesc()
        wanted = TimeoutSettings(config.controller_timeout_ms, config.controller_brake_current_a)
        shown = CheckSettings(wheelbase_m, config.steering_angle_rad, config.steering_hold_s)
        self._watch = ControllerWatch(wanted, config.steering_check, shown)
        self._diagnosed_ns = 0
        settings = GateSettings(
            config.command_age_limit_s,
            config.brake_current_a,
            config.brake_ramp_s,
            config.brake_hold_s,
            config.stamp_age_limit_s,
        )
        self._gate = CommandGate(settings, mono_ns)
        self._link_error = "not connected yet"
        self._linked_once = False
        self._retry_ns = 0
        self._polled_ns = 0
        self._origin_stamp_ns = 0

    @classmethod
    def build(cls, config: MotorConfig, context: NodeContext) -> MotorNode:
        """Build the node. The first tick opens the port, and later ticks reopen it after a disconnection."""
        car = load_calibration(VehicleCalibration, config.calibration)
        limits = car.drive_limits
        if limits.current_max_a < config.brake_current_a:
            raise ConfigError(
                f"expected limits.current_max_a of {config.calibration} of at least brake_current_a, {config.brake_current_a:g} A, got "
                f"{limits.current_max_a:g} A, which would weaken every stop; correct either"
            )

        def make() -> Vesc:
            return Vesc(config.port, car.vehicle_gains, limits, config.brake_current_a)

        on_twins_port = partial(is_twins_port, context.run_dir, config.port)
        return cls(config, make, car.wheelbase_m, context.clock.now().mono_ns, on_twins_port)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Execute or refuse a command, or note a report of the safety node, or a pose during the steering check."""
        self._watch_clocks(now)
        age_s = stamp_age_s(stamp_ns(message), now.real_ns)
        if topic == "/safety/state":
            self._gate.heard_safety(bool(message.armed), info)
            return []
        if topic == "/vicon/car":
            if not stamp_problem(age_s, self._config.stamp_age_limit_s):
                self._watch.see(message, now.mono_ns)
            return []
        if topic == "/motor/check":
            self._watch.obey(message, self._refusal(age_s), now.mono_ns)
            return self._diagnostics(now, at_once=True)
        drive = message.drive
        action = self._gate.command(float(drive.speed), float(drive.steering_angle), info, now.mono_ns, age_s)
        # The safety node waits for this node's status before it arms; a launch file may have left it out there.
        if isinstance(action, Drive) and (missing := self._watch.missing()):
            self._gate.latch(missing, now.mono_ns)
            action = self._gate.tick(now.mono_ns)
        if isinstance(action, Drive):
            self._origin_stamp_ns = stamp_ns(message)
        return self._act(action, now, first=True)

    def tick(self, now: Now) -> list[Out]:
        """Continue the last command, stop if it is stale, read telemetry, and reconnect if needed."""
        self._watch_clocks(now)
        if not self._vesc.is_open:
            self._connect(now)
        self._watch.check.tick(now.mono_ns)
        self._show_wheels(now)
        # Repeat the last command only until the limiter has reached it. Repeating it for ever would keep the car driving after a failure.
        action = self._gate.tick(now.mono_ns)
        outs = (
            [] if isinstance(action, Drive) and self._reached(action) else self._act(action, now, first=False)
        )
        return outs + self._telemetry(now) + self._diagnostics(now)

    def status(self) -> tuple[str, str]:
        """Report a fault if the link is broken or commands stopped; active while driving."""
        if self._link_error:
            return (FAULT if self._linked_once else STARTING), self._link_error
        if missing := self._watch.missing():
            return STARTING, missing
        peer = self._watch.text()
        if self._gate.state is GateState.DRIVING:
            return ACTIVE, peer
        if self._gate.state is GateState.STOPPED:
            return READY, peer
        waiting = self._gate.reason.startswith("waiting")
        return (STARTING if waiting else FAULT), f"latched: {self._gate.reason}"

    def counters(self) -> dict[str, float]:
        """Report refused commands."""
        return {"commands_refused": self._gate.refused}

    def close(self) -> None:
        """Brake until the car stands, then release the motor and close the port."""
        self._vesc.close()

    def _watch_clocks(self, now: Now) -> None:
        if problem := self._clock_watch.problem(now):
            self._gate.latch(problem, now.mono_ns)

    def _refusal(self, age_s: float) -> str:
        """Why no request about the steering check can be executed; empty if it can."""
        if self._gate.state is GateState.DRIVING:
            return "the car drives; disarm first"
        if not self._vesc.is_open:
            return f"no controller: {self._link_error}"
        problem = stamp_problem(age_s, REQUEST_AGE_S)
        return f"the request does not count: {problem}" if problem else ""

    def _show_wheels(self, now: Now) -> None:
        steering_rad = self._watch.check.steering_rad(now.mono_ns)
        if steering_rad is None or self._link_error or self._gate.state is GateState.DRIVING:
            return
        try:
            self._vesc.steer(steering_rad)
        except HardwareError as error:
            self._lose(error, now)

    def _connect(self, now: Now) -> None:
        if now.mono_ns < self._retry_ns:
            return
        self._retry_ns = now.mono_ns + round(_RETRY_S * NS_PER_S)
        try:
            self._vesc.open()
            firmware = self._vesc.identify(timeout_s=0.2)
        except (HardwareError, ProtocolError) as error:
            self._vesc.abandon()
            self._link_error = str(error)
            return
        self._link_error, self._linked_once = "", True
        self._watch.connected(firmware, self._on_twins_port())
        # After a connection, the car is stopped first, in any case.
        self._gate.brake_again(now.mono_ns)

    def _lose(self, error: Exception, now: Now) -> None:
        self._vesc.abandon()
        self._link_error = str(error)
        self._gate.latch(f"link fault: {error}", now.mono_ns)

    def _reached(self, action: Drive) -> bool:
        setpoint, limits = self._vesc.limiter.setpoint, self._vesc.limiter.limits
        speed = min(max(action.speed_mps, limits.speed_min_mps), limits.speed_max_mps)
        steering = min(max(action.steering_rad, limits.steering_min_rad), limits.steering_max_rad)
        return setpoint.speed_mps == speed and setpoint.steering_rad == steering

    def _act(self, action: Drive | Brake | None, now: Now, first: bool) -> list[Out]:
        if action is None or not self._vesc.is_open:
            return []
        try:
            if isinstance(action, Drive):
                sent = self._vesc.drive(action.speed_mps, action.steering_rad)
            elif action.current_a > 0.0:
                sent = self._vesc.brake(action.current_a)
            else:
                sent = self._vesc.release()
        except HardwareError as error:
            self._lose(error, now)
            return []
        # One report per command, with the first write, which latency is measured to. The following slewing is not reported.
        return [self._report(sent)] if first or not isinstance(action, Drive) else []

    def _report(self, sent: Sent) -> Out:
        driving = self._gate.state is GateState.DRIVING
        origin_ns = self._origin_stamp_ns if driving else sent.write_real_ns
        message = types.MotorSent(
            header=header(origin_ns, "car"),
            serial_write_mono_ns=sent.write_mono_ns,
            serial_write_real_ns=sent.write_real_ns,
            speed_mps=sent.speed_mps,
            steering_rad=sent.steering_rad,
            erpm=sent.erpm,
            servo=sent.servo,
            brake_current_a=sent.brake_current_a or 0.0,
            braking=not driving,
            reason=self._gate.reason,
            peer=self._watch.peer,
        )
        return Out("/motor/sent", message)

    def _telemetry(self, now: Now) -> list[Out]:
        if not self._vesc.is_open:
            return []
        try:
            replies = self._vesc.receive()
            if now.mono_ns - self._polled_ns >= _POLL_S * NS_PER_S:
                self._polled_ns = now.mono_ns
                self._watch.poll(self._vesc)
        except ProtocolError as error:
            self._watch.settings_unreadable()
            self._link_error = str(error)
            self._gate.latch(f"link fault: {error}", now.mono_ns)
            return []
        except HardwareError as error:
            self._lose(error, now)
            return []
        silence_s = (now.mono_ns - self._vesc.last_reply_mono_ns) / NS_PER_S
        if silence_s > self._config.link_timeout_s:
            # The port is still open, so try to brake.
            self._link_error = f"the VESC at {self._config.port} has not answered for {silence_s:.2f} s"
            self._gate.latch(f"link fault: {self._link_error}", now.mono_ns)
        elif self._link_error:
            self._link_error = ""
            self._gate.brake_again(now.mono_ns)
        states = [
            Out("/motor/state", self._state(reply, now)) for reply in replies if isinstance(reply, Values)
        ]
        return states + [out for reply in replies for out in self._watch.hear(reply, self._vesc, now)]

    def _diagnostics(self, now: Now, at_once: bool = False) -> list[Out]:
        if not at_once and now.mono_ns - self._diagnosed_ns < _DIAGNOSTICS_S * NS_PER_S:
            return []
        self._diagnosed_ns = now.mono_ns
        report = self._watch.report(self._vesc, self._link_error, self._config.battery_warning_v, now)
        return [Out("/diagnostics", diagnostics_message(report, now.real_ns))]

    def _state(self, values: Values, now: Now) -> Any:
        if values.fault:
            self._gate.latch(f"the VESC reports a fault: {values.fault_name}", now.mono_ns)
        return types.VescState(
            header=header(now.real_ns, "car"),
            speed_mps=self._vesc.gains.speed_mps(values.erpm),
            erpm=values.erpm,
            duty=values.duty,
            input_voltage_v=values.v_in,
            motor_current_a=values.motor_current_a,
            input_current_a=values.input_current_a,
            mosfet_temperature_c=values.hottest_fet_c or 0.0,
            fault=values.fault,
            fault_text=values.fault_name if values.fault else "",
        )


if __name__ == "__main__":
    raise SystemExit(run_node_main(MotorConfig, MotorNode.build))
