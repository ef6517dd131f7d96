"""Changes of type between our topics and those that ROS 2 tools expect. Pure.

Everything else passes through as the bytes that it was received in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from nodes.runtime.messages import message_class, types
from nodes.runtime.node import ACTIVE, FAULT, READY

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
_ATTACK, _SAFETY, _STATUS = (
    "advnerf_msgs/msg/AttackStamp",
    "advnerf_msgs/msg/SafetyState",
    "advnerf_msgs/msg/NodeStatus",
)
# Levels of diagnostic_msgs/DiagnosticStatus.
_OK, _WARN, _ERROR = 0, 1, 2
_LEVELS = {ACTIVE: _OK, READY: _OK, FAULT: _ERROR}
_LARGEST_FLOAT32 = 3.4028234e38


@dataclass(frozen=True)
class Setting:
    """Context of a conversion besides the message.

    Attributes:
        wheelbase_m: Distance of the axles [m].
        child_frame: Frame of the body in a transform.
        frame: Frame to name as the parent; none keeps the message's own.
    """

    wheelbase_m: float = 0.0
    child_frame: str = "base_link"
    frame: str | None = None


Conversion = Callable[[Any, Setting], Any]


def twist_from_ackermann(message: Any, setting: Setting) -> Any:
    """Convert speed and steering angle to speed and yaw rate: ``yaw_rate = speed tan(steering) / wheelbase``."""
    speed_mps, steering_rad = float(message.drive.speed), float(message.drive.steering_angle)
    linear = types.Vector3(x=speed_mps, y=0.0, z=0.0)
    angular = types.Vector3(x=0.0, y=0.0, z=speed_mps * math.tan(steering_rad) / setting.wheelbase_m)
    return types.TwistStamped(
        header=_header(message, setting), twist=types.Twist(linear=linear, angular=angular)
    )


def ackermann_from_twist(message: Any, setting: Setting) -> Any:
    """Convert speed and yaw rate to speed and steering angle: ``steering = atan(wheelbase yaw_rate / speed)``.

    At rest the wheels point straight on, because no steering angle turns a car that stands. Values that are not finite stay so: the
    safety node must see them.
    """
    speed_mps, yaw_radps = float(message.twist.linear.x), float(message.twist.angular.z)
    if speed_mps == 0.0:
        steering_rad = 0.0 if math.isfinite(yaw_radps) else math.nan
    else:
        steering_rad = math.atan(setting.wheelbase_m * yaw_radps / speed_mps)
    drive = types.AckermannDrive(
        steering_angle=steering_rad,
        steering_angle_velocity=0.0,
        speed=_float32(speed_mps),
        acceleration=0.0,
        jerk=0.0,
    )
    return types.AckermannDriveStamped(header=message.header, drive=drive)


def tf_from_pose(message: Any, setting: Setting) -> Any:
    """Convert a pose to the transform from its parent frame to ``child_frame``."""
    return _transforms(message, message.pose, setting)


def tf_from_odometry(message: Any, setting: Setting) -> Any:
    """Convert odometry to the transform from its parent frame to ``child_frame``."""
    return _transforms(message, message.pose.pose, setting)


def pose_from_odometry(message: Any, setting: Setting) -> Any:
    """Keep the pose of an odometry message."""
    del setting  # the message's own frame stays
    return types.PoseStamped(header=message.header, pose=message.pose.pose)


def diagnostics_from_attack(message: Any, setting: Setting) -> Any:
    """Tell which attack the image with this stamp contains."""
    values = {"attack_id": message.attack_id, "drawn": str(bool(message.drawn)).lower()}
    return _diagnostics(message, setting, "attack", _OK, message.reason, values)


def diagnostics_from_safety(message: Any, setting: Setting) -> Any:
    """Tell whether the car is armed, by whom, and why not; a disarmed car is a warning."""
    values = {"armed": str(bool(message.armed)).lower(), "source": message.source}
    return _diagnostics(
        message, setting, "safety", _OK if message.armed else _WARN, message.reason or "armed", values
    )


def diagnostics_from_status(message: Any, setting: Setting) -> Any:
    """Tell the state of a node and its counters."""
    counters = zip(message.counter_names, message.counter_values, strict=False)
    values = {"state": message.state, **{name: f"{value:g}" for name, value in counters}}
    return _diagnostics(
        message, setting, message.node, _LEVELS.get(message.state, _WARN), message.text, values
    )


_OUTWARD: dict[tuple[str, str], Conversion] = {
    (ACKERMANN, TWIST): twist_from_ackermann,
    (POSE, TF): tf_from_pose,
    (ODOMETRY, TF): tf_from_odometry,
    (_ATTACK, DIAGNOSTICS): diagnostics_from_attack,
    (_SAFETY, DIAGNOSTICS): diagnostics_from_safety,
    (_STATUS, DIAGNOSTICS): diagnostics_from_status,
}
_INWARD: dict[tuple[str, str], Conversion] = {
    (ACKERMANN, TWIST): ackermann_from_twist,
    (POSE, ODOMETRY): pose_from_odometry,
}


def convertible(table_type: str, outward: bool) -> Sequence[str]:
    """ROS types that a topic of a type can be sent as (``outward``) or made from."""
    return [theirs for ours, theirs in (_OUTWARD if outward else _INWARD) if ours == table_type]


def conversion(table_type: str, ros_type: str, outward: bool) -> Conversion:
    """The conversion between a topic's type and a type in ROS."""
    return (_OUTWARD if outward else _INWARD)[table_type, ros_type]


def _header(message: Any, setting: Setting) -> Any:
    own = message.header
    return own if setting.frame is None else types.Header(stamp=own.stamp, frame_id=setting.frame)


def _transforms(message: Any, pose: Any, setting: Setting) -> Any:
    at = pose.position
    transform = types.Transform(translation=types.Vector3(x=at.x, y=at.y, z=at.z), rotation=pose.orientation)
    stamped = types.TransformStamped(
        header=_header(message, setting), child_frame_id=setting.child_frame, transform=transform
    )
    return message_class(TF)(transforms=[stamped])


def _diagnostics(
    message: Any, setting: Setting, name: str, level: int, text: str, values: dict[str, str]
) -> Any:
    status = types.DiagnosticStatus(
        level=level,
        name=f"advnerf: {name}",
        message=text,
        hardware_id="",
        values=[types.KeyValue(key=key, value=value) for key, value in values.items()],
    )
    return types.DiagnosticArray(header=_header(message, setting), status=[status])


def _float32(value: float) -> float:
    """Keep a number within float32, or make it infinite, because encoding a larger one fails."""
    return math.copysign(math.inf, value) if abs(value) > _LARGEST_FLOAT32 else value
