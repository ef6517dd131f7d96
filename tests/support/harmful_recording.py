"""A recording of every topic that would do most harm if it were played to a car."""

from __future__ import annotations

from typing import Any

from advnerf_core.geometry import planar_pose
from nodes.runtime.messages import decode, drive_message, encode, header, pose_message, types
from nodes.runtime.topics import TOPICS
from tests.support.bag_samples import sample
from tests.support.messages import filled
from tests.support.safety_reports import state_message
from tests.support.virtual_stack import status_message, teleop_message

STATUS = "/status/camera"
EVERY = (*TOPICS, STATUS)


def type_of(topic: str) -> str:
    """Type of a topic."""
    return "advnerf_msgs/msg/NodeStatus" if topic == STATUS else TOPICS[topic].type


def recorded(topic: str, index: int, at_ns: int) -> bytes:
    """CDR bytes of what would do most harm: a hand that presses and drives, requests to arm, commands."""
    h = header(at_ns, "car")
    pressed = "human" if index % 10 >= 3 else "idle"
    words = ("start", "confirm", "start")
    made = {
        "/teleop/state": lambda: teleop_message(pressed, at_ns, 0.8),
        "/arm": lambda: types.Arm(
            header=h, arm=True, source="operator", reason="", ask_id=f"a{index // 5}", age_ns=0
        ),
        "/motor/check": lambda: types.SteeringCheck(
            header=h, action=words[index % 3], source="", ask_id=f"c{index}"
        ),
        "/clock/offset": lambda: filled(types.ClockOffset, header=h, peer="b"),
        "/motor/sent": lambda: _sent(at_ns),
        "/safety/drive": lambda: drive_message(0.8 if index % 10 >= 3 else 0.0, 0.1, at_ns),
        "/safety/state": lambda: state_message(at_ns, armed=index % 10 >= 3),
        "/vicon/car": lambda: pose_message(planar_pose(-1.1 + 0.03 * index, -2.0, 0.0), at_ns),
        STATUS: lambda: status_message("camera", "active", "", at_ns),
    }
    if topic in made:
        return encode(made[topic]())
    return sample(type_of(topic), at_ns)


def _sent(at_ns: int) -> Any:
    message = decode("advnerf_msgs/msg/MotorSent", sample("advnerf_msgs/msg/MotorSent", at_ns))
    message.peer = "TWIN firmware 5.02"
    return message
