"""Bags that others wrote: by the mcap library, by rosbags in MCAP, SQLite and ROS 1, and the samples of rosbag2 itself."""

import bz2
import contextlib
import gzip
import re
import sqlite3
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1
from rosbags.rosbag2.writer import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zstandard import ZstdCompressor

from advnerf_core.driving.metrics import Horizon
from advnerf_core.geometry import make_transform, rotation_from_quaternion
from nodes.bags.images import image_messages, image_topic
from nodes.bags.message_definitions import as_our_message, parse_definition
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.repair_parts import repair_bag
from nodes.bags.stamps import read_delays
from nodes.bags.time_gaps import read_steps_back
from nodes.lab.trials.evaluation import trajectory
from nodes.runtime.errors import BagError, MessageError
from nodes.runtime.messages import (
    decode,
    encode,
    image_message,
    pose_matrix,
    pose_message,
    stamp_ns,
    type_definition,
    types,
)
from nodes.runtime.pictures import rgb_image
from tests.support.commands import advnerf
from tests.support.foreign_samples import (
    COMPRESSED,
    COUNT,
    HUMBLE,
    IMAGE,
    ROS1_STORE,
    START_NS,
    STEP_NS,
    WRITERS,
    Make,
    drive,
    rgb_at,
    state_at,
    write_mcap,
    write_ros1,
    write_rosbag2,
)

pytestmark = pytest.mark.live

LOGS = Path(__file__).parents[4] / "shared/data/logs/rosbag2"
POSES = [
    f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "TransformStamped", "PoseWithCovarianceStamped")
]
EVERY_WRITER = pytest.mark.parametrize("writer", WRITERS)


@EVERY_WRITER
def test_a_foreign_bag_opens_with_its_topics_types_counts_and_times(tmp_path, writer):
    bag = WRITERS[writer](tmp_path / "drive")
    info = read_info(bag)
    assert [(t.name, t.type, t.count, t.lost) for t in info.topics] == [
        ("/camera/image_raw", IMAGE, COUNT, None),
        ("/chatter", "std_msgs/msg/String", COUNT, None),
        ("/vicon/car", "geometry_msgs/msg/PoseStamped", COUNT, None),
    ]
    assert (info.start_ns, info.end_ns) == (START_NS, START_NS + (COUNT - 1) * STEP_NS + 2_000_000)
    messages = list(read_messages(bag))
    assert len(messages) == 3 * COUNT
    assert [m.log_ns for m in messages] == sorted(m.log_ns for m in messages)
    assert read_attachments(bag) == {}
    assert read_info(bag.parent if bag.is_file() else bag).messages == 3 * COUNT
    delays = read_delays(bag)
    assert set(delays) == {"/camera/image_raw", "/chatter", "/vicon/car"}
    for topic in (
        "/camera/image_raw",
        "/vicon/car",
    ):  # stamps are 5 ms before `drive` begins to write a round
        assert delays[topic].publish_worst_ms == pytest.approx(5.0, abs=2.5)
        assert (delays[topic].backwards, delays[topic].future) == (0, 0)
    assert (delays["/chatter"].publish_ms, delays["/chatter"].future) == (None, None)
    assert (delays["/chatter"].receive_ms is None) == (
        bag.suffix in {".db3", ".bag"} or any(bag.glob("*.db3"))
    )
    late = list(read_messages(bag, ["/vicon/car"], start_offset_s=0.25))
    assert [m.log_ns for m in late] == [START_NS + k * STEP_NS for k in range(3, COUNT)]
    with pytest.raises(BagError, match="has no topic /odom; it has /camera/image_raw, /chatter, /vicon/car"):
        list(read_messages(bag, ["/odom"]))


@EVERY_WRITER
def test_stamps_count_on_topics_of_any_name(tmp_path, writer):
    bag = WRITERS[writer](tmp_path / "drive", image_topic="/front/image")
    found = read_delays(bag)["/front/image"]
    assert found.publish_worst_ms == pytest.approx(5.0, abs=2.5)
    assert (found.backwards, found.future) == (0, 0)


@EVERY_WRITER
@pytest.mark.parametrize("pose_type", [*POSES, "nav_msgs/msg/Odometry"])
def test_every_type_with_a_pose_is_a_pose(tmp_path, writer, pose_type):
    bag = WRITERS[writer](tmp_path / "drive", pose_type=pose_type)
    messages = [decode("geometry_msgs/msg/PoseStamped", m.cdr) for m in read_messages(bag, ["/vicon/car"])]
    assert len(messages) == COUNT
    for index, message in enumerate(messages):
        position, q = state_at(index)
        np.testing.assert_allclose(
            pose_matrix(message), make_transform(rotation_from_quaternion(q), position), atol=1e-12
        )
        assert (stamp_ns(message), message.header.frame_id) == (
            START_NS + index * STEP_NS - 5_000_000,
            "world",
        )


@EVERY_WRITER
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_pictures_have_their_colours(tmp_path, writer, encoding):
    bag = WRITERS[writer](tmp_path / "drive", encoding=encoding)
    images = list(image_messages(bag, image_topic(bag)))
    assert len(images) == COUNT
    for index, image in enumerate(images):
        expected = rgb_at(index)
        if encoding == "mono8":
            expected = np.repeat(expected[..., 1:2], 3, axis=2)
        np.testing.assert_array_equal(rgb_image(image, "test"), expected)


@EVERY_WRITER
@pytest.mark.parametrize("topic", ["/camera/image_raw", "/camera/image_raw/compressed", "/front/image"])
def test_compressed_pictures_stand_for_images(tmp_path, writer, topic):
    bag = WRITERS[writer](tmp_path / "drive", image_type=COMPRESSED, image_topic=topic)
    found = topic if topic == "/front/image" else image_topic(bag)
    for index, image in enumerate(image_messages(bag, found)):
        assert (image.encoding, stamp_ns(image)) == ("rgb8", START_NS + index * STEP_NS - 5_000_000)
        np.testing.assert_array_equal(rgb_image(image, "test"), rgb_at(index))


def test_a_foreign_bag_is_evaluated(tmp_path):
    bag = write_ros1(tmp_path / "drive", pose_type="geometry_msgs/msg/TransformStamped")
    states = trajectory(bag, START_NS, Horizon(ticks=3, dt_s=0.1))
    # The stamp is 5 ms before the log time, so the ticks lie a twentieth of a step behind.
    np.testing.assert_allclose(states[:3, 0], 0.2 * (np.arange(3) + 0.05) - 0.5, atol=1e-6)
    np.testing.assert_allclose(states[:3, 2], 0.05 * (np.arange(3) + 0.05), atol=1e-6)


@EVERY_WRITER
def test_a_type_that_cannot_stand_for_ours_is_named_with_what_can(tmp_path, writer):
    def drive_with_text(folder):
        return WRITERS[writer](folder, image_topic="/vicon/board")

    bag = drive_with_text(tmp_path / "drive")
    with pytest.raises(BagError) as caught:
        list(read_messages(bag, ["/vicon/board"]))
    text = str(caught.value)
    assert (
        f"/vicon/board is {IMAGE}, expected geometry_msgs/msg/PoseStamped (or geometry_msgs/msg/TransformStamped, "
        in text
    )
    assert "\n" not in text
    assert len(list(read_messages(bag, ["/vicon/board"], as_recorded=True))) == COUNT


def test_a_topic_can_be_read_as_another_type_than_the_table_says(tmp_path):
    bag = write_mcap(tmp_path / "drive")
    with pytest.raises(
        BagError, match=r"/chatter is std_msgs/msg/String, expected sensor_msgs/msg/Image \(or "
    ):
        list(image_messages(bag, "/chatter"))
    assert decode("std_msgs/msg/String", next(read_messages(bag, ["/chatter"])).cdr).data == "word 0"


def add_topic(
    path, topic, typename, definition, language, cdr, encoding="cdr", log_times=(START_NS,), **options
):
    writer = McapWriter(str(path), **options)
    writer.start()
    schema = writer.register_schema(typename, language, definition)
    channel = writer.register_channel(topic, encoding, schema)
    for log_ns in log_times:
        writer.add_message(channel, log_time=log_ns, publish_time=log_ns, data=cdr)
    writer.finish()
    return path


def test_a_definition_with_other_fields_is_followed(tmp_path):
    """ROS 1 header, fields in another order and in capitals, one more at the end: our decoder would read nonsense."""
    text = """std_msgs/Header header
float64[9] K
uint32 width
uint32 height
string distortion_model
float64[] D
float64[9] R
float64[12] P
uint32 binning_y
uint32 binning_x
sensor_msgs/RegionOfInterest roi
string vendor
================================================================================
MSG: std_msgs/Header
uint32 seq
builtin_interfaces/Time stamp
string frame_id
"""
    name = "sensor_msgs/msg/CameraInfo"
    store = get_typestore(Stores.EMPTY)
    for needed in ("builtin_interfaces/msg/Time", "sensor_msgs/msg/RegionOfInterest"):
        store.register({needed: HUMBLE.fielddefs[needed]})
    store.register(get_types_from_msg(text, name))
    time = store.types["builtin_interfaces/msg/Time"](5, 7)
    window = store.types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True)
    message = store.types[name](
        header=store.types["std_msgs/msg/Header"](3, time, "cam"),
        K=np.arange(9.0),
        width=30,
        height=20,
        distortion_model="plumb_bob",
        D=np.arange(5.0),
        R=np.eye(3).reshape(-1),
        P=np.arange(12.0),
        binning_y=6,
        binning_x=8,
        roi=window,
        vendor="x",
    )
    for endian in (True, False):
        cdr = bytes(store.serialize_cdr(message, name, little_endian=endian))
        path = add_topic(
            tmp_path / f"{endian}.mcap", "/camera/camera_info", name, text.encode(), "ros2msg", cdr
        )
        (got,) = (decode(name, m.cdr) for m in read_messages(path, ["/camera/camera_info"]))
        assert (got.width, got.height, got.binning_x, got.binning_y) == (30, 20, 8, 6)
        assert (got.header.stamp.nanosec, got.header.frame_id, got.roi.do_rectify) == (7, "cam", True)
        np.testing.assert_array_equal(got.k, np.arange(9.0))
        np.testing.assert_array_equal(got.d, np.arange(5.0))


ROS1_TRANSFORM = b"""# This expresses a transform from coordinate frame header.frame_id
Header header
string child_frame_id # the frame id of the child frame
Transform transform

================================================================================
MSG: std_msgs/Header
# Standard metadata for higher-level stamped data types.
uint32 seq
#Two-integer timestamp that is expressed as:
time stamp
string frame_id

================================================================================
MSG: geometry_msgs/Transform
Vector3 translation
Quaternion rotation

================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def test_a_bag_of_ros_1_that_was_converted_to_mcap_is_read(tmp_path):
    """``mcap convert`` keeps the bytes, the short names and the definitions of ROS 1."""
    raw = struct.pack("<IIII5sI3s7d", 7, 11, 12, 5, b"world", 3, b"car", 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    path = tmp_path / "a.mcap"
    add_topic(path, "/vicon/car", "geometry_msgs/TransformStamped", ROS1_TRANSFORM, "ros1msg", raw, "ros1")
    assert [t.type for t in read_info(path).topics] == ["geometry_msgs/msg/TransformStamped"]
    (got,) = (decode(POSES[0], m.cdr) for m in read_messages(path, ["/vicon/car"]))
    assert (stamp_ns(got), got.header.frame_id) == (11_000_000_012, "world")
    np.testing.assert_array_equal(pose_matrix(got)[:3, 3], [1.0, 2.0, 3.0])


def test_a_definition_in_idl_is_followed(tmp_path):
    text = """================================================================================
IDL: geometry_msgs/msg/PoseStamped
module geometry_msgs { module msg { struct PoseStamped {
  geometry_msgs::msg::Pose pose; std_msgs::msg::Header header; }; }; };
"""
    name = "geometry_msgs/msg/PoseStamped"
    T = make_transform(np.eye(3), [1.0, 2.0, 3.0])
    ours = pose_message(T, 8, "world")
    # The pose comes first here: seven numbers, then the header.
    numbers = struct.pack("<7d", 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    head = struct.pack("<iII6s", 0, 8, 6, b"world\0")
    path = add_topic(
        tmp_path / "a.mcap", "/vicon/car", name, text.encode(), "ros2idl", b"\0\1\0\0" + numbers + head
    )
    assert [m.cdr for m in read_messages(path, ["/vicon/car"])] == [encode(ours)]


@pytest.mark.parametrize(
    ("definition", "language", "encoding", "message"),
    [
        (
            b"this is; no definition",
            "ros2msg",
            "cdr",
            "/vicon/car: cannot read the definition of geometry_msgs/msg/PoseStamped",
        ),
        (b"{}", "jsonschema", "cdr", "its language is 'jsonschema'; ros2msg and ros2idl are read"),
        (b"{}", "jsonschema", "json", "/vicon/car is stored as 'json', expected cdr or ros1"),
        (
            b"std_msgs/Header header\n",
            "ros2msg",
            "cdr",
            "expected the fields pose, which its geometry_msgs/msg/PoseStamped lacks",
        ),
        (
            b"std_msgs/Header header\nnowhere_msgs/Pose pose\n",
            "ros2msg",
            "cdr",
            "needs nowhere_msgs/msg/Pose, which the bag does not define",
        ),
        (
            b"std_msgs/Header header\nstring pose\n",
            "ros2msg",
            "cdr",
            "expected the fields pose, which its geometry_msgs/msg/PoseStamped lacks",
        ),
    ],
)
def test_a_definition_that_cannot_be_used_is_one_line(tmp_path, definition, language, encoding, message):
    path = tmp_path / "a.mcap"
    add_topic(
        path, "/vicon/car", POSES[0], definition, language, encode(pose_message(np.eye(4), 5)), encoding
    )
    with pytest.raises((BagError, MessageError)) as caught:
        list(read_messages(path, ["/vicon/car"]))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_that_do_not_fit_their_definition_are_one_line_that_names_the_topic(tmp_path):
    definition = type_definition(POSES[0]).replace(
        "std_msgs/Header header", "std_msgs/Header header\nuint8[] more", 1
    )
    good = encode(pose_message(np.eye(4), 5))
    for number, bad in enumerate(
        (b"", good[:20], b"\1\2" + good[2:], good[:24] + b"\xff" * 60, good + bytes(90))
    ):
        path = add_topic(
            tmp_path / f"{number}.mcap", "/vicon/car", POSES[0], definition.encode(), "ros2msg", bad
        )
        with pytest.raises(
            MessageError, match=rf"{number}\.mcap: /vicon/car: expected {POSES[0]} in {len(bad)} bytes"
        ):
            list(read_messages(path, ["/vicon/car"]))


def test_a_definition_that_contains_itself_is_one_line(tmp_path):
    text = type_definition(POSES[0]).replace(
        "geometry_msgs/Point position", "geometry_msgs/Point position\ngeometry_msgs/Pose again"
    )
    path = add_topic(
        tmp_path / "a.mcap", "/vicon/car", POSES[0], text.encode(), "ros2msg", b"\0\1\0\0" + bytes(400)
    )
    with pytest.raises((BagError, MessageError), match="/vicon/car"):
        list(read_messages(path, ["/vicon/car"]))


@pytest.mark.parametrize("chunked", [True, False])
def test_a_message_with_a_log_time_of_zero_is_read(tmp_path, chunked):
    times = [0, *(START_NS + k * STEP_NS for k in range(5))]
    cdr, definition = encode(pose_message(np.eye(4), 5)), type_definition(POSES[0]).encode()
    path = tmp_path / "a.mcap"
    add_topic(path, "/vicon/car", POSES[0], definition, "ros2msg", cdr, log_times=times, use_chunking=chunked)
    messages = list(read_messages(path))
    assert [m.log_ns for m in messages] == times
    assert read_info(path).messages == len(messages)


def test_messages_that_rosbag2_compressed_are_unpacked(tmp_path):
    bag = write_rosbag2(tmp_path / "drive", StoragePlugin.SQLITE3)
    with sqlite3.connect(bag / "drive.db3") as database:
        for key, data in database.execute("SELECT id, data FROM messages").fetchall():
            packed = ZstdCompressor().compress(data)
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (packed, key))
    got = [pose_matrix(decode(POSES[0], m.cdr))[0, 3] for m in read_messages(bag, ["/vicon/car"])]
    np.testing.assert_allclose(got, 0.2 * np.arange(COUNT) - 0.5)


def test_a_clock_that_was_set_back_is_named_in_sqlite_too(tmp_path, monkeypatch, capsys):
    bag = write_rosbag2(tmp_path / "drive", StoragePlugin.SQLITE3)
    assert read_steps_back(bag) == ()
    with sqlite3.connect(bag / "drive.db3") as database:
        database.execute("UPDATE messages SET timestamp = timestamp - 10000000000 WHERE id > 9")
    (step,) = read_steps_back(bag)
    assert re.fullmatch(r"log time goes back by (10|9) s after message 9 as recorded", step)
    assert not advnerf(monkeypatch, "bag", "info", str(bag))
    assert f"{step}: the recorder's clock was set back" in capsys.readouterr().out


@pytest.mark.parametrize("back_ms", [400, 1000, 3000])
def test_poses_without_numbers_whose_clock_was_set_back_are_not_evaluated(tmp_path, back_ms):
    """SQLite has no numbers of the publisher: the order in which the messages were written tells it."""
    bag = write_rosbag2(tmp_path / "drive", StoragePlugin.SQLITE3)
    trajectory(bag, START_NS, Horizon(ticks=3, dt_s=0.1))
    with sqlite3.connect(bag / "drive.db3") as database:
        shift = f"UPDATE messages SET timestamp = timestamp - {back_ms * 10**6} WHERE id > 9"
        database.execute(shift)
    said = r"in the order of the drive, got log times that go back by [\d.]+ s as they were written; the recorder's clock was set back"
    with pytest.raises(BagError, match=said):
        trajectory(bag, START_NS, Horizon(ticks=3, dt_s=0.1))


@pytest.mark.parametrize(
    ("form", "cure"),
    [
        ("ros1", r"rosbag reindex \S+drive\.bag"),
        ("sqlite", r"sqlite3 \S+ \.recover \| sqlite3 .* ros2 bag reindex"),
    ],
)
def test_a_bag_of_another_format_that_was_cut_is_told_what_rebuilds_it(
    tmp_path, monkeypatch, capsys, form, cure
):
    if form == "ros1":
        file = write_ros1(tmp_path / "drive")
    else:
        file = write_rosbag2(tmp_path / "drive", StoragePlugin.SQLITE3) / "drive.db3"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for command in ("info", "repair"):
        assert advnerf(monkeypatch, "bag", command, str(file))
        error = capsys.readouterr().err
        assert re.search(f"cannot be read: .*; .*{cure}", error)
        assert "rosbags-convert" not in error


def split_sqlite(folder):
    """One bag in three files, as rosbag2 splits it."""
    whole = write_rosbag2(folder.with_name("whole"), StoragePlugin.SQLITE3)
    folder.mkdir()
    data = (whole / "whole.db3").read_bytes()
    for part in range(3):
        path = folder / f"{folder.name}_{part}.db3"
        path.write_bytes(data)
        first, last = START_NS + 2 * part * STEP_NS, START_NS + 2 * (part + 1) * STEP_NS
        with sqlite3.connect(path) as database:
            database.execute("DELETE FROM messages WHERE timestamp < ? OR timestamp >= ?", (first, last))
    return folder


def test_several_sqlite_files_are_one_bag(tmp_path):
    bag = split_sqlite(tmp_path / "drive")
    assert (read_info(bag).messages, len(read_info(bag).parts)) == (3 * COUNT, 3)
    messages = list(read_messages(bag, ["/vicon/car"]))
    assert [m.log_ns for m in messages] == [START_NS + k * STEP_NS for k in range(COUNT)]
    assert read_info(bag / "drive_1.db3").messages == 3 * COUNT


def test_two_publishers_of_one_topic_are_one_topic(tmp_path):
    store = ROS1_STORE
    path = tmp_path / "two.bag"
    with rosbag1.Writer(path) as writer:
        for caller in ("/one", "/two"):
            connection = writer.add_connection("/vicon/car", POSES[0], typestore=store, callerid=caller)
            for _index, (_, typename, message, log_ns) in enumerate(drive(Make(store))):
                if typename == POSES[0]:
                    writer.write(
                        connection, log_ns + (caller == "/two"), store.serialize_ros1(message, typename)
                    )
    (topic,) = read_info(path).topics
    assert (topic.name, topic.count) == ("/vicon/car", 2 * COUNT)
    assert len(list(read_messages(path, ["/vicon/car"]))) == 2 * COUNT


TAIL = "expected a bag: MCAP (.mcap), rosbag2 in SQLite (.db3), or ROS 1 (.bag)"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty (0 bytes); " + TAIL),
        (b"time,steering\n0.1,0.2\n", "is a text file; " + TAIL),
        ("Übung\n".encode() * 200, "is a text file; " + TAIL),
        (b"#ROSBAG V1.2\n" + bytes(50), "is a ROS 1 bag of an old version; "),
        (gzip.compress(b"x"), "is a file compressed with gzip; "),
        (bz2.compress(b"x"), "is a file compressed with bzip2; "),
        (ZstdCompressor().compress(b"x" * 99), "zstd -d"),
        (b"\x89PNG\r\n\x1a\n" + bytes(30), "is a PNG picture; " + TAIL),
        (bytes(5000), "is full of zeros: its disk was full or lost power"),
        (bytes(range(255, 0, -1)), "is a file of unknown format (it begins with ff fe fd fc"),
    ],
)
@pytest.mark.parametrize("name", ["bag.mcap", "bag.db3"])
def test_a_file_that_is_no_bag_is_named_for_what_it_is(tmp_path, content, said, name):
    path = tmp_path / name
    path.write_bytes(content)
    for use in (read_info, lambda p: list(read_messages(p)), read_attachments, repair_bag):
        with pytest.raises(BagError) as caught:
            use(path)
        assert said in str(caught.value)
        assert "\n" not in str(caught.value)
        assert "recorder was killed" not in str(caught.value)
    assert path.read_bytes() == content
    if content:
        with pytest.raises(BagError, match="is"):
            read_info(tmp_path)


def test_a_zip_archive_and_a_folder_without_a_bag_are_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.mcap", "w") as archive:
        archive.writestr("x", "y")
    with pytest.raises(BagError, match="is a ZIP archive"):
        read_info(tmp_path / "a.mcap")
    folder = tmp_path / "folder"
    (folder / "images").mkdir(parents=True)
    (folder / "notes.txt").write_text("x")
    with pytest.raises(
        BagError, match=r"folder is a folder without a bag: it has images/, notes\.txt; expected"
    ):
        read_info(folder)


@pytest.mark.parametrize(
    ("writer", "said"), [("rosbags-sqlite3", "rosbag2 in SQLite"), ("ros1", "ROS 1 bag")]
)
def test_what_needs_an_mcap_says_how_to_get_one_and_changes_nothing(tmp_path, writer, said):
    bag = WRITERS[writer](tmp_path / "drive")
    before = {file: file.read_bytes() for file in (tmp_path / "drive").iterdir()}
    with pytest.raises(
        BagError,
        match=rf"is {said}; only MCAP bags can be repaired\. Convert it first: rosbags-convert --src ",
    ):
        repair_bag(bag)
    assert {file: file.read_bytes() for file in (tmp_path / "drive").iterdir()} == before


@pytest.mark.parametrize(("writer", "name"), [("rosbags-sqlite3", "drive.db3"), ("ros1", "drive.bag")])
def test_a_damaged_foreign_bag_is_one_line(tmp_path, writer, name):
    WRITERS[writer](tmp_path / "drive")
    path = tmp_path / "drive" / name
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for k in range(60):
        data = bytearray(whole)
        at = int(rng.integers(16, len(data)))
        if k % 2:
            del data[at:]
        else:
            data[at : at + 40] = rng.integers(0, 256, 40, np.uint8).tobytes()
        path.write_bytes(bytes(data))
        try:
            for _ in read_messages(path, ["/vicon/car"]):
                pass
        except (BagError, MessageError) as error:
            assert "\n" not in str(error)  # noqa: PT017 - either is right, another exception is not


def test_what_is_left_in_a_write_ahead_log_is_not_passed_over(tmp_path):
    bag = write_rosbag2(tmp_path / "drive", StoragePlugin.SQLITE3) / "drive.db3"
    database = sqlite3.connect(bag)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("DELETE FROM messages WHERE id = 1")
    database.commit()
    with pytest.raises(BagError, match=r"the newest messages are in drive\.db3-wal; add them with: sqlite3"):
        read_info(bag)
    database.close()
    assert read_info(bag).messages == 3 * COUNT - 1


@pytest.mark.skipif(not LOGS.is_dir(), reason="the sample bags of rosbag2 are not there")
def test_the_samples_of_rosbag2_are_read_whole():
    for name, count in (("talker.mcap", 20), ("talker.db3", 20), ("topics_and_services.db3", 13)):
        path = LOGS / name
        assert read_info(path).messages == len(list(read_messages(path))) == count
    words = [[m.cdr for m in read_messages(LOGS / f"talker.{end}", ["/topic"])] for end in ("mcap", "db3")]
    assert words[0] == words[1]
    assert decode("std_msgs/msg/String", words[0][0]).data.startswith("Hello, world!")


def test_our_own_bytes_are_not_touched(tmp_path):
    """A definition that is ours, in whatever words, costs nothing and changes nothing."""
    cdr = encode(image_message(rgb_at(0), 5, "camera", "rgb8"))
    path = add_topic(
        tmp_path / "a.mcap", "/camera/image_raw", IMAGE, type_definition(IMAGE).encode(), "ros2msg", cdr
    )
    assert [m.cdr for m in read_messages(path)] == [cdr]
    assert types.Image is type(decode(IMAGE, cdr))


def test_damaged_definitions_and_messages_are_a_message_or_one_error():
    """Definitions come from strangers: nothing in them may end in another exception, or ask for more memory than there are bytes."""
    rng = np.random.default_rng(5)
    samples = [
        (POSES[0], encode(pose_message(np.eye(4), 5))),
        (IMAGE, encode(image_message(rgb_at(0, 8, 6), 5, "camera"))),
    ]
    good = 0
    for k in range(300):
        typename, cdr = samples[k % 2]
        text, data = bytearray(type_definition(typename).encode()), bytearray(cdr)
        for _ in range(k % 3):
            text[rng.integers(0, len(text))] = rng.choice(list(b"[]<=1 9\n/aZ#"))
        for _ in range(k // 3 % 3):
            data[rng.integers(4, min(len(data), 120))] = rng.integers(0, 256)
        with contextlib.suppress(MessageError):
            definition = parse_definition(typename, text.decode(), "ros2msg")
            if not definition.missing(typename):
                encode(as_our_message(definition.read(bytes(data)), typename))
                good += 1
    assert 50 < good < 300
