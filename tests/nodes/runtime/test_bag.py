import hashlib

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nodes.bags import part as bag_part
from nodes.bags.reader import extract_attachments, read_attachment, read_info, read_messages, require_readable
from nodes.bags.stamps import read_delays
from nodes.bags.writer import BagWriter
from nodes.cli import main as cli
from nodes.runtime.errors import BagError
from nodes.runtime.messages import encode, header, pose_message, type_definition, type_hash, types
from nodes.runtime.topics import TOPICS
from tests.support.bag_samples import START_NS, write_all_topics


def digest_by_topic(pairs):
    hashes = {}
    for topic, data in pairs:
        hashes.setdefault(topic, hashlib.sha256()).update(bytes(data))
    return {topic: h.hexdigest() for topic, h in hashes.items()}


def test_three_readers_agree_and_decode_every_topic(tmp_path):
    attachments = {"launch.yaml": b"name: x\n"}
    with write_all_topics(tmp_path / "bag", attachments=attachments, metadata={"git": "abc"}):
        pass
    path = tmp_path / "bag" / "bag.mcap"
    names = {*TOPICS, "/status/x"}
    with open(path, "rb") as file:
        mcap_messages = [
            (c.topic, m.data) for _, c, m in make_reader(file, validate_crcs=True).iter_messages()
        ]
    with open(path, "rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert {channel.topic for _, channel, _, _ in decoded} == names
    assert len(decoded) == 5 * len(names)
    _, _, record, pose = next(d for d in decoded if d[1].topic == "/vicon/car")
    assert pose.pose.orientation.w == 1.0
    assert (record.log_time - record.publish_time, record.sequence) == (1_000_000, 0)
    with AnyReader([tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        rosbags_messages = []
        for connection, timestamp, data in reader.messages():
            rosbags_messages.append((connection.topic, data))
            assert timestamp >= START_NS
            reader.deserialize(data, connection.msgtype)
    ours = [(m.topic, m.cdr) for m in read_messages(tmp_path / "bag")]
    assert digest_by_topic(mcap_messages) == digest_by_topic(rosbags_messages) == digest_by_topic(ours)


def test_file_is_a_rosbag2_bag(tmp_path):
    write_all_topics(tmp_path / "bag", attachments={"a.yaml": b"1"}).close({"lost /arm": "3"})
    with open(tmp_path / "bag" / "bag.mcap", "rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    image = next(c for c in summary.channels.values() if c.topic == "/camera/image_raw")
    assert image.metadata["topic_type_hash"] == type_hash("sensor_msgs/msg/Image")
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert metadata["rosbag2"]["serialized_metadata"] == text
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["message_count"] == summary.statistics.message_count == 5 * (len(TOPICS) + 1)
    assert information["relative_file_paths"] == ["bag.mcap"]
    assert information["starting_time"]["nanoseconds_since_epoch"] == START_NS
    assert "&" not in text
    assert not (tmp_path / "bag" / ".reserve").exists()


def test_info_attachments_and_selection(tmp_path):
    write_all_topics(tmp_path / "bag", attachments={"a.yaml": b"1"}, metadata={"git": "abc"}).close(
        {"lost /arm": "3"}
    )
    info = read_info(tmp_path / "bag")
    assert info.messages == 5 * (len(TOPICS) + 1)
    assert info.duration_s == pytest.approx(0.45)
    assert {t.name: t.lost for t in info.topics}["/arm"] == 3
    assert info.metadata["git"] == "abc"
    assert read_attachment(tmp_path / "bag", "a.yaml") == b"1"
    with pytest.raises(BagError, match=r"it has a\.yaml"):
        read_attachment(tmp_path / "bag", "b.yaml")
    late = list(read_messages(tmp_path / "bag", ["/arm"], start_offset_s=0.2))
    assert [m.sequence for m in late] == [2, 3, 4]
    with pytest.raises(BagError, match="has no topic /nothing; it has /arm"):
        list(read_messages(tmp_path / "bag", ["/nothing"]))
    with pytest.raises(BagError, match=r"between 0 and 0\.\d s"):
        list(read_messages(tmp_path / "bag", start_offset_s=9))
    require_readable(tmp_path / "bag", {name: row.type for name, row in TOPICS.items()})


@pytest.mark.parametrize(
    "compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4, None]
)
def test_messages_come_in_the_order_of_the_general_reader(tmp_path, compression):
    """Late messages, equal log times, small chunks that overlap, all compressions, and a file without chunks."""
    rng = np.random.default_rng(1)
    path = tmp_path / "x.mcap"
    writer = Writer(
        str(path),
        chunk_size=300,
        compression=compression or CompressionType.NONE,
        use_chunking=compression is not None,
    )
    writer.start()
    schema = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
    ids = [
        writer.register_channel(topic, "cdr", schema)
        for topic in ("/vicon/car", "/vicon/board", "/vicon/monitor")
    ]
    for i in range(500):
        time_ns = START_NS + i * 10 + int(rng.integers(-8, 9)) * 40
        writer.add_message(
            ids[int(rng.integers(3))], time_ns, bytes(rng.integers(0, 255, 20, np.uint8)), i, i
        )
    writer.finish()
    for topics, offset_s in [
        (None, 0.0),
        (["/vicon/car"], 0.0),
        (None, 2e-6),
        (["/vicon/board", "/vicon/car"], 1e-6),
    ]:
        start_ns = read_info(path).start_ns + round(offset_s * 1e9)
        with open(path, "rb") as file:
            expected = [
                (c.topic, bytes(m.data), m.log_time, m.publish_time, m.sequence)
                for _, c, m in make_reader(file).iter_messages(
                    topics, starting_at=start_ns, log_time_order=True
                )
            ]
        got = [
            (m.topic, m.cdr, m.log_ns, m.publish_ns, m.sequence)
            for m in read_messages(path, topics, offset_s)
        ]
        assert got == expected
        assert len(got) > 100


def test_attachments_are_taken_out_and_nothing_is_overwritten(tmp_path):
    attachments = {"a.yaml": b"1", "b.yaml": b"2"}
    write_all_topics(tmp_path / "bag", rounds=1, attachments=attachments).close()
    written = extract_attachments(tmp_path / "bag", tmp_path / "new" / "folder")
    assert {path.name: path.read_bytes() for path in written} == attachments
    with pytest.raises(BagError, match=r"a\.yaml exists; remove it or choose another folder with --output"):
        extract_attachments(tmp_path / "bag", tmp_path / "new" / "folder", ["a.yaml"])
    with pytest.raises(BagError, match=r"has no attachment c\.yaml; it has a\.yaml, b\.yaml"):
        extract_attachments(tmp_path / "bag", tmp_path / "other", ["c.yaml"])
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("name", ["../evil.yaml", "/tmp/evil.yaml", "..", "", "a/b", "x\0y"])
def test_a_strangers_bag_does_not_write_where_it_likes(tmp_path, name):
    write_all_topics(tmp_path / "bag", rounds=1, attachments={"ok.yaml": b"", name: b"evil"}).close()
    with pytest.raises(BagError, match="expected attachments with plain file names"):
        extract_attachments(tmp_path / "bag", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_delays_are_those_that_were_written(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i, (stamp_ms, publish_ms, log_ms) in enumerate(
            [(0, 4, 5), (20, 22, 27), (10, 13, 28), (99, 31, 32)]
        ):
            pose = encode(pose_message(np.eye(4), START_NS + stamp_ms * 1_000_000))
            writer.write(
                "/vicon/car", pose, START_NS + log_ms * 1_000_000, START_NS + publish_ms * 1_000_000, i
            )
        clock = encode(types.Clock(clock=header(START_NS).stamp))
        writer.write("/clock", clock, START_NS + 3_000_000, START_NS, 0)
    delays = read_delays(tmp_path / "bag")
    car = delays["/vicon/car"]
    assert (car.publish_ms, car.publish_worst_ms) == (2.5, 4.0)  # of 4, 2, 3 and -68
    assert (car.receive_ms, car.receive_worst_ms) == (3.0, 15.0)  # of 1, 5, 15 and 1
    assert (car.backwards, car.future) == (1, 1)
    assert (delays["/clock"].publish_ms, delays["/clock"].receive_ms) == (None, 3.0)
    assert (delays["/clock"].backwards, delays["/clock"].future) == (None, None)


def test_the_commands_say_what_was_lost_how_late_it_came_and_what_rides_along(tmp_path, capsys):
    writer = write_all_topics(tmp_path / "bag", attachments={"a.yaml": b"1"})
    writer.close({"lost /arm": "3"})
    cli.app(["bag", "info", str(tmp_path / "bag"), "--stamps"], standalone_mode=False)
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["attachments:", "a.yaml"] in printed
    (counted, timed) = (line for line in printed if line[:1] == ["/arm"])
    assert (counted[2], counted[-1]) == ("5", "3")
    assert timed == ["/arm", "4.0", "4.0", "1.0", "1.0", "0", "0"]
    cli.app(["bag", "extract", str(tmp_path / "bag"), "-o", str(tmp_path / "out")], standalone_mode=False)
    assert (tmp_path / "out" / "a.yaml").read_bytes() == b"1"


def test_existing_folder_is_not_overwritten(tmp_path):
    write_all_topics(tmp_path / "bag").close()
    with pytest.raises(BagError, match="record to another folder"):
        BagWriter(tmp_path / "bag")


def test_bag_with_another_version_of_a_type_is_not_played(tmp_path, monkeypatch):
    definition = type_definition("advnerf_msgs/msg/Arm").replace("bool arm\n", "")
    monkeypatch.setattr(bag_part, "type_hash", lambda typename: "RIHS01_00")
    monkeypatch.setattr(bag_part, "type_definition", lambda typename: definition)
    write_all_topics(tmp_path / "bag", rounds=1).close()
    with pytest.raises(
        BagError, match=r"bag\.mcap: /arm: expected the fields arm, which its advnerf_msgs/msg/Arm lacks"
    ):
        require_readable(tmp_path / "bag", {"/arm": "advnerf_msgs/msg/Arm"})
