"""The table of topics: publisher, type, rate and queue of each. Bus, recorder, CLI and tests use it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from nodes.runtime.errors import TopicError

STATUS_PREFIX = "/status/"
STATUS_RATE_HZ = 5.0


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    Attributes:
        name: Name with a leading slash.
        type: ROS 2 type, for example ``sensor_msgs/msg/Image``.
        rate_hz: Nominal rate [Hz]; None for occasional messages.
        queue: Number of messages that a receiver keeps. 1 keeps only the newest; older ones are dropped and counted.
        max_age_s: Age since publication beyond which a receiver must not use a message [s]; None if age does not matter.
        publisher: Role of the node that publishes the topic.
        senders: Number of processes per host that may publish the topic at the same time.
        receivers: Number of processes per host that may receive the topic at the same time, for a topic that any number of processes
            may send; 0 for all other topics. A request to stop the car must not have to wait for a free endpoint.
    """

    name: str
    type: str
    rate_hz: float | None
    queue: int
    max_age_s: float | None
    publisher: str
    senders: int = 1
    receivers: int = 0

    @property
    def latest(self) -> bool:
        """Whether receivers keep only the newest message."""
        return self.queue == 1


_ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
_ROWS = (
    Topic("/camera/image_raw", "sensor_msgs/msg/Image", 10.0, 1, 0.2, "camera"),
    Topic("/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", 10.0, 1, 0.2, "camera"),
    Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", 10.0, 1, None, "camera"),
    Topic("/vicon/car", "geometry_msgs/msg/PoseStamped", 100.0, 200, 0.1, "vicon"),
    Topic("/vicon/board", "geometry_msgs/msg/PoseStamped", 100.0, 200, 0.1, "vicon"),
    Topic("/vicon/monitor", "geometry_msgs/msg/PoseStamped", 100.0, 200, 0.1, "vicon"),
    Topic("/vicon/wand", "geometry_msgs/msg/PoseStamped", 100.0, 200, 0.1, "vicon"),
    Topic("/compositor/image", "sensor_msgs/msg/Image", 10.0, 1, 0.2, "compositor"),
    Topic("/compositor/attack", "advnerf_msgs/msg/AttackStamp", 10.0, 50, None, "compositor"),
    Topic("/monitor/attack", "advnerf_msgs/msg/AttackStamp", 5.0, 50, None, "monitor"),
    Topic("/monitor/shown", "advnerf_msgs/msg/DisplayShown", 5.0, 50, None, "monitor"),
    Topic("/policy/drive", _ACKERMANN, 10.0, 1, 0.25, "policy"),
    Topic("/policy/counterfactual", "advnerf_msgs/msg/Counterfactual", 10.0, 20, None, "counterfactual"),
    Topic("/expert/drive", _ACKERMANN, 20.0, 1, 0.25, "expert"),
    Topic("/expert/state", "advnerf_msgs/msg/ExpertState", 20.0, 20, None, "expert"),
    Topic("/teleop/state", "advnerf_msgs/msg/Teleop", 20.0, 1, 0.2, "teleop"),
    Topic("/safety/drive", _ACKERMANN, 10.0, 1, 0.25, "safety"),
    Topic("/safety/state", "advnerf_msgs/msg/SafetyState", 10.0, 20, 0.5, "safety"),
    Topic("/clock/offset", "advnerf_msgs/msg/ClockOffset", 5.0, 20, 1.0, "gateway"),
    Topic("/arm", "advnerf_msgs/msg/Arm", None, 20, None, "operator", receivers=8),
    Topic("/operator/act", "advnerf_msgs/msg/OperatorAct", None, 50, None, "page"),
    Topic("/twin/reset", "geometry_msgs/msg/PoseStamped", None, 5, None, "operator", senders=2),
    Topic("/attack/request", "advnerf_msgs/msg/AttackRequest", None, 5, None, "operator"),
    Topic("/attack/cancel", "advnerf_msgs/msg/AttackCancel", None, 5, None, "operator"),
    Topic("/attack/progress", "advnerf_msgs/msg/AttackProgress", 1.0, 50, None, "attack"),
    Topic("/attack/texture", "sensor_msgs/msg/Image", None, 1, None, "attack"),
    Topic("/attack/preview", "sensor_msgs/msg/Image", None, 1, None, "attack"),
    Topic("/attack/file", "advnerf_msgs/msg/FileChunk", None, 300, None, "attack", senders=2),
    Topic("/attack/switch", "advnerf_msgs/msg/AttackSwitch", 2.0, 1, None, "page"),
    Topic("/motor/sent", "advnerf_msgs/msg/MotorSent", 20.0, 200, None, "motor"),
    Topic("/motor/check", "advnerf_msgs/msg/SteeringCheck", None, 5, None, "operator"),
    Topic("/odom", "nav_msgs/msg/Odometry", 20.0, 50, 0.5, "motor"),
    Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 1.0, 20, None, "motor"),
    Topic("/motor/state", "advnerf_msgs/msg/VescState", 20.0, 50, 0.5, "motor"),
    Topic("/clock", "rosgraph_msgs/msg/Clock", 40.0, 1, None, "player"),
    Topic("/player/control", "advnerf_msgs/msg/PlayerControl", None, 20, None, "operator"),
    Topic("/player/state", "advnerf_msgs/msg/PlayerState", None, 20, None, "player"),
)
TOPICS: dict[str, Topic] = {row.name: row for row in _ROWS}
"""The rows of the table by name; every node also has a status topic, ``/status/<node>``."""
_NODE_NAME = re.compile(r"[a-z][a-z0-9_]{0,23}")


def status_topic(node: str) -> str:
    """Topic on which a node reports its status."""
    if not _NODE_NAME.fullmatch(node):
        raise TopicError(f"expected a node name of at most 24 letters a-z, digits and _, got {node!r}")
    return STATUS_PREFIX + node


def type_of_topic(name: str) -> str | None:
    """Type of a topic; None if the topic is not in the table."""
    try:
        return topic(name).type
    except TopicError:
        return None


def topic(name: str) -> Topic:
    """Row of a topic. Every node also has a status topic, which is not in the table."""
    if row := TOPICS.get(name):
        return row
    if name.startswith(STATUS_PREFIX):
        node = name.removeprefix(STATUS_PREFIX)
        return Topic(status_topic(node), "advnerf_msgs/msg/NodeStatus", STATUS_RATE_HZ, 1, 1.0, node)
    raise TopicError(f"unknown topic {name!r}; known are {', '.join(TOPICS)}, {STATUS_PREFIX}<node>")
