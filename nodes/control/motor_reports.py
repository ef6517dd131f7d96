"""Reports of the motor node as standard messages: odometry and diagnostics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware.motor.odometry import POSITION_VARIANCE, YAW_VARIANCE, OdometryState
from hardware.motor.vesc_replies import FirmwareVersion, Values
from hardware.motor.vesc_settings import TimeoutSettings
from nodes.runtime.messages import header, types
from nodes.runtime.requests import Answer

OK, WARN, ERROR, STALE = 0, 1, 2, 3
_HOT_C = 80.0


def odometry_message(state: OdometryState, stamp_ns: int) -> Any:
    """Make ``nav_msgs/Odometry`` from dead reckoning. Frame ``odom`` is the car's pose at the start of the node, ``car`` its rear axle."""
    half = 0.5 * state.yaw_rad
    pose = types.Pose(
        position=types.Point(x=state.x_m, y=state.y_m, z=0.0),
        orientation=types.Quaternion(x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half))),
    )
    twist = types.Twist(
        linear=types.Vector3(x=state.speed_mps, y=0.0, z=0.0),
        angular=types.Vector3(x=0.0, y=0.0, z=state.yaw_rate_radps),
    )
    covariance = np.zeros(36)
    covariance[[0, 7, 35]] = POSITION_VARIANCE, POSITION_VARIANCE, YAW_VARIANCE
    return types.Odometry(
        header=header(stamp_ns, "odom"),
        child_frame_id="car",
        pose=types.PoseWithCovariance(pose=pose, covariance=covariance),
        twist=types.TwistWithCovariance(twist=twist, covariance=np.zeros(36)),
    )


@dataclass(frozen=True)
class ControllerReport:
    """State of the controller for the diagnostics.

    Attributes:
        values: Last telemetry; None before the first.
        values_age_s: Age of the telemetry [s].
        firmware: Firmware that the controller reports.
        timeout: The controller's own time-out, as read back; None if the firmware does not report it.
        wanted_timeout: Longest accepted time-out and smallest accepted brake current.
        skipped_bytes: Number of received bytes outside of frames.
        link: Fault of the link; empty without one.
        steering: State of the steering check.
        steering_good: Whether the steering check allows arming.
        battery_warning_v: Supply voltage below which a warning is reported [V].
        answer: Answer to the last request about the steering check.
    """

    values: Values | None
    values_age_s: float
    firmware: FirmwareVersion | None
    timeout: TimeoutSettings | None
    wanted_timeout: TimeoutSettings
    skipped_bytes: int
    link: str
    steering: str
    steering_good: bool
    battery_warning_v: float
    answer: Answer


def diagnostics_message(report: ControllerReport, stamp_ns: int) -> Any:
    """Make a ``diagnostic_msgs/DiagnosticArray`` with the rows controller, battery, time-out and steering.

    The steering row also has the answer to the last request about the check: ``answered``, ``granted``, ``answer``.
    """
    hardware = str(report.firmware) if report.firmware else "VESC"
    rows = [_controller(report), _battery(report), _timeout(report), _steering(report)]
    statuses = [
        types.DiagnosticStatus(
            level=level,
            name=f"motor: {name}",
            message=text,
            hardware_id=hardware,
            values=[types.KeyValue(key=key, value=value) for key, value in values.items()],
        )
        for name, level, text, values in rows
    ]
    return types.DiagnosticArray(header=header(stamp_ns), status=statuses)


_Row = tuple[str, int, str, dict[str, str]]


def _controller(report: ControllerReport) -> _Row:
    values = report.values
    numbers = {"skipped bytes": str(report.skipped_bytes)}
    if values is None:
        return "controller", ERROR, report.link or "no telemetry yet", numbers
    numbers |= {
        "telemetry generation": values.generation,
        "erpm": f"{values.erpm:.0f}",
        "motor current [A]": f"{values.motor_current_a:.2f}",
        "fault code": str(values.fault),
        "telemetry age [s]": f"{report.values_age_s:.2f}",
    }
    if report.link:
        return "controller", ERROR, report.link, numbers
    if values.fault:
        return "controller", ERROR, f"fault: {values.fault_name}", numbers
    temperatures = [
        t for t in (values.hottest_fet_c, values.temp_motor_c, values.temp_pcb_c) if t is not None
    ]
    hottest = max(temperatures, default=0.0)
    numbers["hottest [degC]"] = f"{hottest:.1f}"
    return (
        "controller",
        WARN if hottest > _HOT_C else OK,
        f"{hottest:.0f} degC" if hottest > _HOT_C else "",
        numbers,
    )


def _battery(report: ControllerReport) -> _Row:
    values = report.values
    if values is None:
        return "battery", STALE, "no telemetry yet", {}
    numbers = {
        "voltage [V]": f"{values.v_in:.1f}",
        "current [A]": f"{values.input_current_a:.2f}",
        "used [Ah]": f"{values.used_ah:.3f}",
        "used [Wh]": f"{values.used_wh:.2f}",
    }
    low = values.v_in < report.battery_warning_v
    return (
        "battery",
        WARN if low else OK,
        f"{values.v_in:.1f} V, charge it" if low else f"{values.v_in:.1f} V",
        numbers,
    )


def _timeout(report: ControllerReport) -> _Row:
    wanted = {"expected at most": str(report.wanted_timeout)}
    if report.timeout is None:
        return (
            "time-out",
            WARN,
            "not read back: this firmware does not report it; check it in VESC Tool",
            wanted,
        )
    good = report.timeout.at_least(report.wanted_timeout)
    return "time-out", OK if good else ERROR, str(report.timeout), wanted


def _steering(report: ControllerReport) -> _Row:
    answer = report.answer
    answered = (
        {"answered": answer.ask_id, "granted": str(answer.granted), "answer": answer.text}
        if answer.ask_id
        else {}
    )
    return "steering", OK if report.steering_good else WARN, report.steering, answered
