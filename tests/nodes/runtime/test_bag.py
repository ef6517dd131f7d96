import contextlib
import errno
import hashlib
import os
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nodes import cli
from nodes.runtime import bag as bag_module
from nodes.runtime.bag import BagWriter
from nodes.runtime.bag_journal import journal_of
from nodes.runtime.bag_read import (
    extract_attachments,
    read_attachment,
    read_attachments,
    read_info,
    read_messages,
    require_our_types,
)
from nodes.runtime.bag_repair import repair
from nodes.runtime.bag_stamps import read_delays
from nodes.runtime.errors import BagError
from nodes.runtime.messages import (
    _STORE,
    camera_info_message,
    drive_message,
    encode,
    header,
    image_message,
    pose_message,
    type_hash,
    types,
)
from nodes.runtime.topics import TOPICS

START_NS = 1_800_000_000_000_000_000


def sample(typename, stamp_ns):
    """One message of every type in the topic table."""
    from advnerf_core.geometry import Pinhole

    h = header(stamp_ns, "test")
    image = np.random.default_rng(stamp_ns % 1000).integers(0, 255, (20, 30, 3), np.uint8)
    made = {
        "sensor_msgs/msg/Image": lambda: image_message(image, stamp_ns, "camera"),
        "sensor_msgs/msg/CameraInfo": lambda: camera_info_message(Pinhole(30, 20, 9, 9, 15, 10), stamp_ns, "camera"),
        "geometry_msgs/msg/PoseStamped": lambda: pose_message(np.eye(4), stamp_ns),
        "ackermann_msgs/msg/AckermannDriveStamped": lambda: drive_message(0.8, 0.1, stamp_ns),
        "advnerf_msgs/msg/AttackStamp": lambda: types.AttackStamp(header=h, attack_id="abc", drawn=True, reason=""),
        "advnerf_msgs/msg/Arm": lambda: types.Arm(header=h, arm=True, source="test", reason="because"),
        "advnerf_msgs/msg/SafetyState": lambda: types.SafetyState(
            header=h, armed=True, stopping=False, reason="", source="test", command_age_s=0.1, pose_age_s=0.01
        ),
        "advnerf_msgs/msg/MotorSent": lambda: types.MotorSent(
            header=h, serial_write_mono_ns=1, serial_write_real_ns=2, speed_mps=0.8, steering_rad=0.1, erpm=3691.0,
            servo=0.5, brake_current_a=0.0, braking=False, reason="", peer="twin",
        ),
        "advnerf_msgs/msg/VescState": lambda: types.VescState(
            header=h, speed_mps=0.8, erpm=3691.0, duty=0.1, input_voltage_v=12.0, motor_current_a=1.0,
            input_current_a=0.5, mosfet_temperature_c=30.0, fault=0, fault_text="",
        ),
        "advnerf_msgs/msg/AttackRequest": lambda: types.AttackRequest(
            header=h, request_id="a", request="horizon: 1", source=""
        ),
        "advnerf_msgs/msg/AttackCancel": lambda: types.AttackCancel(header=h, request_id="", reason="enough"),
        "advnerf_msgs/msg/AttackProgress": lambda: types.AttackProgress(
            header=h, request_id="a", state="searching", text="", seed=0, evaluation=1, evaluations=2, loss_m=-1.0,
            total_cte_m=1.0, best_total_cte_m=1.0, seconds=0.1, attack_id="",
        ),
        "advnerf_msgs/msg/FileChunk": lambda: types.FileChunk(
            header=h, name="a", sha256="ab", size_bytes=3, index=0, count=1, data=np.arange(3, dtype=np.uint8)
        ),
        "advnerf_msgs/msg/NodeStatus": lambda: types.NodeStatus(
            header=h, node="x", pid=1, state="active", text="", subscriptions=["/arm"], publications=[],
            subscribers=np.zeros(0, np.uint32), counter_names=["n"], counter_values=np.array([1.0]),
        ),
    }  # fmt: skip
    return encode(made[typename]() if typename in made else nothing(typename))


def nothing(typename):
    """A message of any type with zeros, empty texts and empty sequences."""
    values = {}
    for name, (kind, what) in _STORE.fielddefs[typename][1]:
        if kind.name == "BASE":
            values[name] = {"string": "", "bool": False}.get(what[0], 0.0 if "float" in what[0] else 0)
        elif kind.name == "NAME":
            values[name] = nothing(what)
        else:
            (element, of), length = what
            plain = element.name == "BASE" and of[0] != "string"
            values[name] = np.zeros(length if kind.name == "ARRAY" else 0, of[0]) if plain else []
    return getattr(types, typename.rsplit("/", 1)[-1])(**values)


def write_all_topics(folder, rounds=5, **options):
    writer = BagWriter(folder, **options)
    for i in range(rounds):
        for k, row in enumerate([*TOPICS.values()]):
            t = START_NS + i * 100_000_000 + k * 1_000_000
            writer.write(row.name, sample(row.type, t - 5_000_000), t, t - 1_000_000, i)
        t = START_NS + i * 100_000_000 + 50_000_000
        writer.write("/status/x", sample("advnerf_msgs/msg/NodeStatus", t), t, t, i)
    return writer


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
        mcap_messages = [(c.topic, m.data) for _, c, m in make_reader(file, validate_crcs=True).iter_messages()]
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
    write_all_topics(tmp_path / "bag", attachments={"a.yaml": b"1"}, metadata={"git": "abc"}).close({"lost /arm": "3"})
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
    require_our_types(tmp_path / "bag", list(TOPICS))


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4, None])
def test_messages_come_in_the_order_of_the_general_reader(tmp_path, compression):
    """Late messages, equal log times, small chunks that overlap, all compressions, and a file without chunks."""
    rng = np.random.default_rng(1)
    path = tmp_path / "x.mcap"
    writer = Writer(
        str(path), chunk_size=300, compression=compression or CompressionType.NONE, use_chunking=compression is not None
    )
    writer.start()
    schema = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
    ids = [writer.register_channel(topic, "cdr", schema) for topic in ("/vicon/car", "/vicon/board", "/vicon/monitor")]
    for i in range(500):
        time_ns = START_NS + i * 10 + int(rng.integers(-8, 9)) * 40
        writer.add_message(ids[int(rng.integers(3))], time_ns, bytes(rng.integers(0, 255, 20, np.uint8)), i, i)
    writer.finish()
    for topics, offset_s in [(None, 0.0), (["/vicon/car"], 0.0), (None, 2e-6), (["/vicon/board", "/vicon/car"], 1e-6)]:
        start_ns = read_info(path).start_ns + round(offset_s * 1e9)
        with open(path, "rb") as file:
            expected = [
                (c.topic, bytes(m.data), m.log_time, m.publish_time, m.sequence)
                for _, c, m in make_reader(file).iter_messages(topics, starting_at=start_ns, log_time_order=True)
            ]
        got = [(m.topic, m.cdr, m.log_ns, m.publish_ns, m.sequence) for m in read_messages(path, topics, offset_s)]
        assert got == expected
        assert len(got) > 100


def test_a_summary_that_lies_is_an_error_and_takes_no_memory(tmp_path):
    write_all_topics(tmp_path / "bag", rounds=1).close()
    path = tmp_path / "bag" / "bag.mcap"
    content = bytearray(path.read_bytes())
    with open(path, "rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    index = content.rindex(chunk.chunk_start_offset.to_bytes(8, "little") + chunk.chunk_length.to_bytes(8, "little"))
    for wrong in (1 << 60, chunk.chunk_length + 10**9, 5):
        content[index + 8 : index + 16] = wrong.to_bytes(8, "little")
        path.write_bytes(content)
        with pytest.raises(BagError, match=r"damaged|cannot be read"):
            list(read_messages(path))


def test_no_damage_makes_a_reader_do_anything_but_say_so(tmp_path):
    """Bytes changed, lengths that ask for the moon, pieces cut out and put in; seeds 0 to 59, and short files."""
    write_all_topics(tmp_path / "bag", rounds=1, attachments={"a": b"x" * 50}).close({"lost /arm": "1"})
    content = (tmp_path / "bag" / "bag.mcap").read_bytes()
    path = tmp_path / "x.mcap"

    def read_everything():
        for read in (read_info, read_attachments, read_delays, lambda bag: list(read_messages(bag)), repair, read_info):
            with contextlib.suppress(BagError):
                read(path)

    for seed in range(60):
        rng, damaged = np.random.default_rng(seed), bytearray(content)
        for _ in range(int(rng.integers(1, 6))):
            at = int(rng.integers(0, len(damaged)))
            change = rng.integers(0, 4)
            if change == 0:
                damaged[at] ^= int(rng.integers(1, 256))
            elif change == 1:
                damaged[at : at + 8] = int(rng.choice([2**63 - 1, 2**40, 0])).to_bytes(8, "little")
            elif change == 2:
                del damaged[at : at + int(rng.integers(1, 60))]
            else:
                damaged[at:at] = rng.bytes(int(rng.integers(1, 20)))
        path.write_bytes(damaged)
        read_everything()
    for length in range(0, 60, 7):
        path.write_bytes(content[:length])
        read_everything()


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
    with pytest.raises(BagError, match="has no plain file name"):
        extract_attachments(tmp_path / "bag", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_delays_are_those_that_were_written(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i, (stamp_ms, publish_ms, log_ms) in enumerate([(0, 4, 5), (20, 22, 27), (10, 13, 28), (99, 31, 32)]):
            pose = encode(pose_message(np.eye(4), START_NS + stamp_ms * 1_000_000))
            writer.write("/vicon/car", pose, START_NS + log_ms * 1_000_000, START_NS + publish_ms * 1_000_000, i)
        clock = encode(types.Clock(clock=header(START_NS).stamp))
        writer.write("/clock", clock, START_NS + 3_000_000, START_NS, 0)
    delays = read_delays(tmp_path / "bag")
    car = delays["/vicon/car"]
    assert (car.publish_ms, car.publish_worst_ms) == (2.5, 4.0)  # of 4, 2, 3 and -68
    assert (car.receive_ms, car.receive_worst_ms) == (3.0, 15.0)  # of 1, 5, 15 and 1
    assert (car.backwards, car.future) == (1, 1)
    assert (delays["/clock"].publish_ms, delays["/clock"].receive_ms) == (None, 3.0)


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


def journal_bag(tmp_path, count=10):
    """A bag whose writer vanished with its last messages in no chunk."""
    writer = BagWriter(tmp_path / "bag")
    writer.write("/camera/image_raw", bytes(100_000), START_NS, START_NS, 0)
    for i in range(count):
        writer.write("/vicon/car", bytes([i] * 50), START_NS + 1 + i, START_NS + i, i + (i > 4) * 3)
    writer._let_go()
    return writer.path


def test_repair_takes_the_unfinished_chunk_from_the_journal(tmp_path):
    path = journal_bag(tmp_path)
    assert b"vicon/car" not in path.read_bytes()
    assert repair(path.parent).messages == 11
    kept = list(read_messages(path, ["/vicon/car"]))
    assert [(m.cdr[0], m.log_ns - START_NS, m.publish_ns - START_NS) for m in kept] == [
        (i, 1 + i, i) for i in range(10)
    ]
    # The recorder could not say what it lost; the sequence numbers do.
    assert {t.name: t.lost for t in read_info(path).topics} == {"/camera/image_raw": 0, "/vicon/car": 3}
    with open(path, "rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages(["/vicon/car"]))) == 10
    assert not journal_of(path).exists()


@pytest.mark.parametrize("cut", [1, 30, 60, 200])
def test_journal_cut_anywhere_gives_the_messages_before_the_cut(tmp_path, cut):
    path = journal_bag(tmp_path)
    journal = journal_of(path)
    content = journal.read_bytes()
    entry = (len(content) - 16) // 10
    journal.write_bytes(content[:-cut])
    assert repair(path).messages == 11 - (cut + entry - 1) // entry


def test_journal_of_a_chunk_that_is_in_the_bag_is_not_taken_twice(tmp_path):
    """The recorder died, or a repair was stopped, between writing the chunk and emptying the journal."""
    path = journal_bag(tmp_path)
    journal = journal_of(path).read_bytes()
    repair(path)
    content = path.read_bytes()
    journal_of(path).write_bytes(journal)
    path.write_bytes(content[: content.rindex(b"rosbag2") - 40])
    assert repair(path).messages == 11


def test_damaged_journal_is_cut_where_the_damage_is(tmp_path):
    path = journal_bag(tmp_path)
    content = bytearray(journal_of(path).read_bytes())
    content[len(content) // 2] ^= 1
    journal_of(path).write_bytes(content)
    assert 1 < repair(path).messages < 11


def test_existing_folder_is_not_overwritten(tmp_path):
    write_all_topics(tmp_path / "bag").close()
    with pytest.raises(BagError, match="record to another folder"):
        BagWriter(tmp_path / "bag")


RECORDER = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from nodes.runtime.bag import BagWriter
writer, pose = BagWriter(Path(sys.argv[1])), bytes(120)
image = bytes(190_000)
last_flush = time.monotonic()
for i in range(100_000):
    t = time.time_ns()
    writer.write("/vicon/car", pose, t, t, i)
    if i % 10 == 0:
        writer.write("/camera/image_raw", image, t, t, i // 10)
    if time.monotonic() - last_flush > 0.02:
        writer.flush()
        last_flush = time.monotonic()
        print(i, flush=True)
    time.sleep(0.001)
"""


def test_bag_of_a_killed_recorder_is_whole_after_repair(tmp_path):
    command = [sys.executable, "-c", RECORDER, str(tmp_path / "bag"), os.getcwd()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    process.stdout.readline()
    time.sleep(0.4)
    process.kill()
    flushed = int(process.communicate()[0].split()[-1])
    with pytest.raises(BagError, match="make it whole with: advnerf bag repair"):
        read_info(tmp_path / "bag")
    result = repair(tmp_path / "bag")
    assert not result.was_whole
    sequences = [m.sequence for m in read_messages(tmp_path / "bag", ["/vicon/car"])]
    # Nothing that was flushed is lost, and nothing in between.
    assert sequences == list(range(len(sequences)))
    assert len(sequences) >= flushed
    with AnyReader([tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        assert len(list(reader.messages())) == result.messages
    assert repair(tmp_path / "bag").was_whole
    assert not (tmp_path / "bag" / ".reserve").exists()


def test_repair_wherever_the_file_was_cut(tmp_path):
    write_all_topics(tmp_path / "whole", rounds=40, attachments={"a": b"x" * 100}).close()
    content = (tmp_path / "whole" / "whole.mcap").read_bytes()
    with open(tmp_path / "whole" / "whole.mcap", "rb") as file:
        summary = make_reader(file).get_summary()
    assert len(summary.chunk_indexes) >= 2
    chunk = summary.chunk_indexes[-1]
    chunk_end = chunk.chunk_start_offset + chunk.chunk_length
    everything = 40 * (len(TOPICS) + 1)
    # In a chunk, right after one, in its index, in the metadata behind it, in the summary, in the last magic.
    for cut, complete in [
        (chunk.chunk_start_offset + 50, False),
        (chunk_end, True),
        (chunk_end + 40, True),
        (chunk_end + chunk.message_index_length + 30, True),
        (len(content) - 200, True),
        (len(content) - 3, True),
    ]:
        folder = tmp_path / f"cut{cut}"
        folder.mkdir()
        (folder / "bag.mcap").write_bytes(content[:cut])
        result = repair(folder)
        assert (result.messages == everything) is complete
        assert result.messages > everything / 2
        with open(folder / "bag.mcap", "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert sum(1 for _ in reader.iter_messages()) == result.messages
            assert next(iter(reader.iter_attachments())).data == b"x" * 100
        with open(folder / "bag.mcap", "rb") as file:
            assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > result.messages
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            assert reader.message_count == result.messages
            assert len(list(reader.messages())) == result.messages


def test_damaged_chunk_ends_what_is_kept(tmp_path):
    write_all_topics(tmp_path / "bag", rounds=40).close()
    path = tmp_path / "bag" / "bag.mcap"
    with open(path, "rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[-1]
    content = bytearray(path.read_bytes())[:-20]
    content[chunk.chunk_start_offset + 500] ^= 0xFF
    path.write_bytes(content)
    result = repair(tmp_path / "bag")
    assert 0 < result.messages < 40 * (len(TOPICS) + 1)
    assert len(list(read_messages(tmp_path / "bag"))) == result.messages


@pytest.mark.parametrize("content", [b"", b"not a bag at all"])
def test_what_is_no_bag_is_refused(tmp_path, content):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(BagError, match="expected an MCAP file"):
        repair(tmp_path / "x.mcap")
    with pytest.raises(BagError, match="expected a bag folder"):
        read_info(tmp_path / "nothing")


def test_full_disk_is_one_clear_error_and_the_part_before_is_readable(tmp_path, monkeypatch):
    capacity, write = 150_000, os.write
    stream_of = {}

    def limited(descriptor, data):
        """A disk that takes 150 kB."""
        size = os.fstat(descriptor).st_size
        if descriptor == stream_of.get("bag") and size + len(data) > capacity:
            write(descriptor, bytes(data)[: capacity - size])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data)

    writer = BagWriter(tmp_path / "bag")
    stream_of["bag"] = writer._stream.descriptor
    monkeypatch.setattr(bag_module.os, "write", limited)
    pose = sample("geometry_msgs/msg/PoseStamped", START_NS)

    def fill():
        for i in range(10_000):
            writer.write("/vicon/car", pose, START_NS + i, START_NS + i, i)

    with pytest.raises(BagError, match=r"No space left on device; \d+ messages up to then are readable"):
        fill()
    writer.close()
    kept = [m.sequence for m in read_messages(tmp_path / "bag")]
    assert kept == list(range(len(kept)))
    assert len(kept) > 300


def test_disk_full_from_the_beginning_leaves_nothing(tmp_path, monkeypatch):
    def no_space(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(bag_module.os, "posix_fallocate", no_space)
    with pytest.raises(BagError, match="No space left on device; it needs 8 MiB"):
        BagWriter(tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_bag_with_another_version_of_a_type_is_not_played(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_module, "type_hash", lambda typename: "RIHS01_00")
    write_all_topics(tmp_path / "bag", rounds=1).close()
    with pytest.raises(BagError, match="leave it out with --topics"):
        require_our_types(tmp_path / "bag", ["/arm"])
