"""Which routes the ROS 2 node accepts: nothing that arms, nothing without an age, no circles."""

import pytest
from pydantic import ValidationError

from nodes.linking.ros2.routes import COMMANDS, SENSORS, SendRoute, TakeRoute
from nodes.ros2 import Ros2Config, require_local
from nodes.runtime.errors import ConfigError, SecurityError
from nodes.runtime.topics import TOPICS

IMAGE = {"topic": "/compositor/image", "ros": "/image_raw"}
COMMAND = {"topic": "/policy/drive", "ros": "/cmd", "answers": "/compositor/image"}
TWIST = {**COMMAND, "type": "geometry_msgs/msg/TwistStamped"}


@pytest.mark.parametrize("topic", sorted(set(TOPICS) - {*COMMANDS, *SENSORS}))
def test_nothing_but_commands_and_measurements_comes_in(topic):
    with pytest.raises(ValidationError, match="to take from ROS 2"):
        TakeRoute(topic=topic)


def test_what_arms_or_stands_for_a_hand_is_not_among_what_comes_in():
    kinds = {TOPICS[topic].type.rsplit("/", 1)[1] for topic in (*COMMANDS, *SENSORS)}
    assert not kinds & {"Arm", "Teleop", "SafetyState", "MotorSent", "VescState", "NodeStatus", "ClockOffset"}
    assert "/safety/drive" not in COMMANDS


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({}, "at least one route"),
        ({"send": [IMAGE], "take": [{**COMMAND, "answers": None}]}, "expected 'answers'"),
        (
            {"send": [IMAGE], "take": [{"topic": "/odom", "answers": "/compositor/image"}]},
            "expected no 'answers'",
        ),
        ({"send": [], "take": [COMMAND]}, "to answer an image or a pose that this node sends"),
        ({"send": [{"topic": "/odom"}], "take": [{**COMMAND, "answers": "/odom"}]}, "add it to 'send'"),
        ({"send": [IMAGE], "take": [COMMAND, COMMAND]}, "at most once"),
        ({"send": [{"topic": "/odom"}], "take": [{"topic": "/odom", "ros": "/odom2"}]}, "go in circles"),
        ({"send": [IMAGE], "take": [{**COMMAND, "ros": "/image_raw"}]}, "different ROS names"),
        ({"send": [IMAGE], "take": [TWIST]}, "expected 'vehicle'"),
        ({"send": [{**IMAGE, "ros": "image"}]}, "absolute ROS name"),
        ({"send": [{**IMAGE, "ros": "/a b"}]}, "absolute ROS name"),
        ({"send": [{**IMAGE, "type": "std_msgs/msg/String"}]}, "expected a type of sensor_msgs/msg/Image"),
        ({"send": [{**IMAGE, "frame": "map"}]}, "only where the type is converted"),
        ({"send": [{"topic": "/safety/drive", "rate_hz": 5.0}]}, "a stop must not be skipped"),
        ({"send": [{"topic": "/nonsense"}]}, "unknown topic"),
        ({"send": [IMAGE], "domain_id": 233}, "less than or equal to 232"),
        ({"send": [IMAGE], "interface": "<x/>"}, "interface"),
        ({"send": [IMAGE], "take": [{**COMMAND, "max_age_s": 1.0}]}, "less than or equal to 0.25"),
    ],
)
def test_routes_that_do_not_fit_are_refused(config, message):
    with pytest.raises(ValidationError, match=message):
        Ros2Config.model_validate(config)


def test_quality_of_service_is_that_of_ros_tools():
    image = SendRoute(**IMAGE).endpoint
    assert (image.ros, image.typename, image.reliable, image.depth) == (
        "/image_raw",
        "sensor_msgs/msg/Image",
        False,
        5,
    )
    command = TakeRoute(**TWIST).endpoint
    assert (command.typename, command.reliable, command.depth) == ("geometry_msgs/msg/TwistStamped", True, 10)
    assert SendRoute(**IMAGE, reliability="reliable", depth=1).endpoint.reliable


def test_other_computers_need_consent_and_may_only_send_commands():
    open_config = Ros2Config.model_validate({"interface": "eth0", "send": [IMAGE], "take": [COMMAND]})
    with pytest.raises(SecurityError, match="every computer on that network"):
        require_local(open_config, local=False)
    require_local(open_config, local=True)
    require_local(open_config.model_copy(update={"open_to_network": True}), local=False)
    measured = Ros2Config.model_validate(
        {"interface": "eth0", "open_to_network": True, "take": [{"topic": "/vicon/car"}]}
    )
    with pytest.raises(ConfigError, match="needs a clock that is compared with ours"):
        require_local(measured, local=False)
