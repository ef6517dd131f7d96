"""Routes of the ROS 2 node: one per topic and direction, with its ROS name, type and QoS. Pure configuration."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from nodes.linking.ros2.conversions import ACKERMANN, COMPRESSED, IMAGE, POSE, convertible
from nodes.runtime.errors import TopicError
from nodes.runtime.topics import may_replay
from nodes.runtime.topics import topic as topic_row

Reliability = Literal["best_effort", "reliable"]

SAFETY_DRIVE = "/safety/drive"
COMMANDS = ("/policy/drive", "/expert/drive")
"""Topics on which a driver asks the safety node to move the car."""
SENSORS = (
    "/camera/image_raw",
    "/camera/image_raw/compressed",
    "/camera/camera_info",
    "/vicon/car",
    "/vicon/board",
    "/vicon/monitor",
    "/vicon/wand",
    "/odom",
    "/diagnostics",
)
"""Topics with measurements that ROS 2 may supply. No other topic comes in: none that arms, none that stands for a person's hand."""
SHARED = ("/diagnostics",)
"""Topics that many ROS programs publish at the same time. No decision depends on them."""

_SENSOR_DATA = (IMAGE, COMPRESSED, "sensor_msgs/msg/CameraInfo")
_ROS_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
# The middleware's own limit of a DDS topic name is 255 characters.
_LONGEST_NAME = 200
_SENSOR_DEPTH, _DEPTH = 5, 10


@dataclass(frozen=True)
class Endpoint:
    """One reader or writer in ROS 2.

    Attributes:
        ros: ROS name, with a leading slash.
        typename: ROS type, for example ``sensor_msgs/msg/Image``.
        reliable: Whether the reader asks for, or the writer offers, reliable delivery.
        depth: Samples that the middleware keeps (KEEP_LAST).
    """

    ros: str
    typename: str
    reliable: bool
    depth: int


class _Route(StrictModel):
    """Common fields of both directions.

    Attributes:
        topic: Topic of the topic table.
        ros: Name in ROS; none uses the same name.
        type: Type in ROS; none uses the topic's own type. A different one is converted.
        reliability: QoS; none chooses best effort for camera data and reliable for everything else.
        depth: Samples that the middleware keeps; none chooses 5 for camera data and 10 for everything else.
        rate_hz: Largest rate; more messages are skipped and counted. None carries every message [Hz].
    """

    outward: ClassVar[bool]  # whether messages go to ROS

    topic: str
    ros: str | None = None
    type: str | None = None
    reliability: Reliability | None = None
    depth: int | None = Field(default=None, ge=1, le=100)
    rate_hz: float | None = Field(default=None, gt=0.0)

    @model_validator(mode="after")
    def _names_and_types_exist(self) -> _Route:
        try:
            topic_row(self.topic)
        except TopicError as error:
            raise ValueError(str(error)) from None
        if not _ROS_NAME.fullmatch(self.ros_name) or len(self.ros_name) > _LONGEST_NAME:
            raise ValueError(
                f"expected an absolute ROS name such as /car/image_raw for {self.topic}, got {self.ros_name!r}; correct 'ros'"
            )
        ours, theirs = self.table_type, self.ros_type
        if ours != theirs and theirs not in convertible(ours, self.outward):
            known = ", ".join((self.table_type, *convertible(ours, self.outward)))
            raise ValueError(
                f"expected a type of {known} for {self.topic}, got {self.ros_type}; correct 'type'"
            )
        return self

    @property
    def ros_name(self) -> str:
        """Name in ROS."""
        return self.ros or self.topic

    @property
    def table_type(self) -> str:
        """Type of the topic on our bus."""
        return topic_row(self.topic).type

    @property
    def ros_type(self) -> str:
        """Type in ROS."""
        return self.type or self.table_type

    @property
    def converts(self) -> bool:
        """Whether the types differ."""
        return self.ros_type != self.table_type

    @property
    def endpoint(self) -> Endpoint:
        """The ROS end of the route."""
        camera = self.ros_type in _SENSOR_DATA
        reliable = not camera if self.reliability is None else self.reliability == "reliable"
        return Endpoint(
            self.ros_name, self.ros_type, reliable, self.depth or (_SENSOR_DEPTH if camera else _DEPTH)
        )


class SendRoute(_Route):
    """A topic of ours that ROS 2 gets.

    Attributes:
        child_frame: Frame of the body, for a pose that is sent as ``tf2_msgs/msg/TFMessage``.
        frame: Frame to name instead of the message's own, for example ``map``; only with a converted type.
    """

    outward: ClassVar[bool] = True

    child_frame: str = "base_link"
    frame: str | None = None

    @model_validator(mode="after")
    def _every_command_counts(self) -> SendRoute:
        if self.topic == SAFETY_DRIVE and self.rate_hz is not None:
            raise ValueError(
                f"expected no 'rate_hz' for {SAFETY_DRIVE}, because a stop must not be skipped; remove it"
            )
        return self

    @model_validator(mode="after")
    def _frame_needs_a_conversion(self) -> SendRoute:
        if self.frame is not None and not self.converts:
            raise ValueError(
                f"expected 'frame' only where the type is converted, because other bytes pass through unchanged; remove it from {self.topic}"
            )
        return self


class TakeRoute(_Route):
    """A topic that ROS 2 supplies.

    Attributes:
        answers: For a command: the topic of ours whose messages the command must answer, by carrying their stamp. It must be
            among the topics that the node sends.
        max_age_s: For a command: largest age of the answered message when the answer arrives [s].
    """

    outward: ClassVar[bool] = False

    answers: str | None = None
    max_age_s: float = Field(default=0.15, gt=0.0, le=0.25)

    @model_validator(mode="after")
    def _may_come_in(self) -> TakeRoute:
        if self.topic not in (*COMMANDS, *SENSORS):
            raise ValueError(
                f"expected one of {', '.join((*COMMANDS, *SENSORS))} to take from ROS 2, got {self.topic};"
                " nothing else may come in, because ROS 2 has no keys"
            )
        if not may_replay(self.ros_name) and self.ros_name != self.topic:
            raise ValueError(
                f"expected a ROS name that is no topic of ours with 'replay: never', got {self.ros_name} for {self.topic};"
                " what is played there must not come in under another name"
            )
        if (self.answers is None) == self.commands:
            wanted = "'answers', for example /compositor/image" if self.commands else "no 'answers'"
            raise ValueError(f"expected {wanted} for {self.topic}, got {self.answers!r}; correct the route")
        return self

    @property
    def commands(self) -> bool:
        """Whether its messages ask to move the car."""
        return self.topic in COMMANDS


def dds_name(typename: str) -> str:
    """Name of a ROS 2 type in DDS; ``rmw_zenoh`` uses the same."""
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def check_routes(send: tuple[SendRoute, ...], take: tuple[TakeRoute, ...]) -> None:
    """Refuse routes that do not fit together, as a `ValueError`."""
    taken = [route.topic for route in take]
    if twice := {name for name in taken if taken.count(name) > 1}:
        raise ValueError(
            f"expected each topic at most once in 'take', got {', '.join(sorted(twice))} more than once"
        )
    if circle := set(taken) & {route.topic for route in send}:
        raise ValueError(
            f"expected topics either in 'send' or in 'take', got {', '.join(sorted(circle))} in both; messages would go in circles"
        )
    if echo := {route.ros_name for route in send} & {route.ros_name for route in take}:
        raise ValueError(
            f"expected different ROS names in 'send' and 'take', got {', '.join(sorted(echo))} in both"
        )
    offered = [route.topic for route in send if topic_row(route.topic).type in (IMAGE, COMPRESSED, POSE)]
    for route in take:
        if route.answers is not None and route.answers not in offered:
            raise ValueError(
                f"expected {route.topic} to answer an image or a pose that this node sends ({', '.join(offered) or 'none'}),"
                f" got {route.answers}; add it to 'send'"
            )


def needs_wheelbase(routes: tuple[_Route, ...]) -> bool:
    """Whether a route converts between steering angles and yaw rates."""
    return any(route.converts and route.table_type == ACKERMANN for route in routes)
