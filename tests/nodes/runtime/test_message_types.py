"""Types made when they are asked for are those that rosbags makes of all its definitions."""

import dataclasses
import subprocess
import sys

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nodes.runtime.message_types import MSG_FOLDER, MessageTypes
from tests.support.live.processes import REPOSITORY


@pytest.fixture(scope="module")
def everything():
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in MSG_FOLDER.glob("*/msg/*.msg"):
        store.register(get_types_from_msg(file.read_text(), f"{file.parent.parent.name}/msg/{file.stem}"))
    return store


def test_each_type_has_the_fields_definition_and_hash_of_rosbags(everything):
    for typename in everything.types:
        ours = MessageTypes(1000)
        assert ours.has(typename)
        assert ours.fielddefs[typename] == everything.fielddefs[typename]
        assert ours.generate_msgdef(typename, ros_version=2) == everything.generate_msgdef(
            typename, ros_version=2
        )
        assert ours.hash_rihs01(typename) == everything.hash_rihs01(typename)
        names = [field.name for field in dataclasses.fields(everything.types[typename])]
        assert [field.name for field in dataclasses.fields(ours.types[typename])] == names
    assert not ours.has("std_msgs/msg/../../escape")
    assert not ours.has("std_msgs/msg/Nothing")


@pytest.mark.parametrize("little_endian", [True, False])
def test_bytes_are_those_of_rosbags(everything, little_endian):
    ours = MessageTypes(1000)
    assert ours.has("nav_msgs/msg/Path")  # one of rosbags' own
    assert ours.has("std_msgs/msg/Header")  # one of ours
    time = ours.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = ours.types["std_msgs/msg/Header"](stamp=time, frame_id="world")
    path = ours.types["nav_msgs/msg/Path"](header=header, poses=[])
    data = bytes(ours.serialize_cdr(path, "nav_msgs/msg/Path", little_endian=little_endian))
    assert data == everything.serialize_cdr(path, "nav_msgs/msg/Path", little_endian=little_endian)
    assert ours.deserialize_cdr(data, "nav_msgs/msg/Path") == path


def test_a_node_makes_none_that_it_does_not_need():
    code = "import sys, nodes.safety; print([name for name in sys.modules if 'stores.ros2' in name])"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, text=True, capture_output=True)
    assert done.stdout == "[]\n", done.stderr
