"""A recording in several files: complete parts, nothing lost or doubled between them, and none of it in the way of the bus."""

import errno
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from nodes.bags.part import PartWriter
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.repair_parts import repair_bag
from nodes.bags.writer import BagWriter, SplitLimits
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay, write_replay
from nodes.runtime.errors import BagError
from tests.support.bag_samples import START_NS, sample

POSE, IMAGE = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Image"
CORNER = Path(__file__).parents[2] / "replay" / "corner.mcap"


def fill(writer, count=400, first=0):
    """Poses and pictures, every 10 ms, each with its number as its sequence."""
    pose, image = sample(POSE, START_NS), sample(IMAGE, START_NS)
    for i in range(first, first + count):
        topic, cdr = ("/camera/image_raw", image) if i % 4 == 0 else ("/vicon/car", pose)
        writer.write(
            topic, cdr, START_NS + i * 10_000_000, START_NS + i * 10_000_000 - 1000, i, lost=int(i == 7)
        )


@pytest.mark.parametrize("limits", [SplitLimits(duration_s=0.5), SplitLimits(size_mib=0.01)])
def test_every_part_opens_alone_and_independent_readers_find_every_message_once(tmp_path, limits):
    with BagWriter(
        tmp_path / "drive", {"launch.yaml": b"x"}, {"git": "abc"}, limits=limits, compressed=True
    ) as writer:
        for i in range(8):
            fill(writer, 50, i * 50)
            while writer._finishing:
                time.sleep(0.001)
            writer.flush()
    names = sorted((path.name for path in (tmp_path / "drive").iterdir()), key=lambda name: (len(name), name))
    assert names[:-1] == [f"drive_{number}.mcap" for number in range(len(names) - 1)]
    assert len(names) > 3
    assert names[-1] == "metadata.yaml"
    store, counts, seen = get_typestore(Stores.ROS2_JAZZY), [], []
    for number, name in enumerate(names[:-1]):
        with open(tmp_path / "drive" / name, "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert reader.get_summary().statistics.attachment_count == int(number == 0)
            assert {m.name: m.metadata for m in reader.iter_metadata()}["advnerf"] == {"git": "abc"}
            numbers = [message.sequence for _, _, message in reader.iter_messages()]
        with AnyReader([tmp_path / "drive" / name], default_typestore=store) as alone:
            assert len([alone.deserialize(data, c.msgtype) for c, _, data in alone.messages()]) == len(
                numbers
            )
        counts.append(len(numbers))
        seen += numbers
    assert seen == list(range(400))
    with (
        AnyReader([tmp_path / "drive"], default_typestore=store) as reader,
        Reader(tmp_path / "drive") as direct,
    ):
        assert len(list(reader.messages())) == reader.message_count == direct.message_count == 400
        assert (direct.start_time, direct.end_time) == (START_NS, START_NS + 399 * 10_000_000 + 1)
    information = yaml.safe_load((tmp_path / "drive" / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert (
        information["relative_file_paths"] == [entry["path"] for entry in information["files"]] == names[:-1]
    )
    assert [entry["message_count"] for entry in information["files"]] == counts
    starts = np.cumsum([0, *counts[:-1]])
    for entry, first, count in zip(information["files"], starts, counts, strict=True):
        assert entry["starting_time"]["nanoseconds_since_epoch"] == START_NS + int(first) * 10_000_000
        assert entry["duration"]["nanoseconds"] == (count - 1) * 10_000_000
    info = read_info(tmp_path / "drive")
    assert {t.name: (t.count, t.lost) for t in info.topics} == {
        "/camera/image_raw": (100, 0),
        "/vicon/car": (300, 1),
    }
    assert (info.attachments, info.metadata) == (("launch.yaml",), {"git": "abc"})


def test_a_clock_that_is_set_back_begins_a_part_and_does_not_end_the_limit(tmp_path):
    pose = sample(POSE, START_NS)
    with BagWriter(tmp_path / "drive", limits=SplitLimits(duration_s=10.0)) as writer:
        for i, second in enumerate([0, 5, -3600, -3599, -3595, 20]):
            writer.write("/vicon/car", pose, START_NS + second * 10**9, START_NS, i)
            while writer._finishing:
                time.sleep(0.001)
    assert len(read_info(tmp_path / "drive").parts) == 3
    assert [m.sequence for m in read_messages(tmp_path / "drive")] == [2, 3, 4, 0, 1, 5]


def test_the_split_bag_is_replayed_and_compared_like_the_whole_one(tmp_path):
    with BagWriter(
        tmp_path / "split", read_attachments(CORNER), limits=SplitLimits(duration_s=0.2)
    ) as writer:
        for m in read_messages(CORNER):
            writer.write(m.topic, m.cdr, m.log_ns, m.publish_ns, m.sequence)
            while writer._finishing:
                time.sleep(0.001)
    assert len(read_info(tmp_path / "split").parts) > 3
    assert list(read_messages(tmp_path / "split")) == list(read_messages(CORNER))
    digests = []
    for bag in (CORNER, tmp_path / "split"):
        with Replay(bag, Choice(("compositor",)), whole=True) as replay:
            write_replay(replay, tmp_path / f"again{len(digests)}")
        digests.append(replay.summary.digest)
    assert digests[0] == digests[1]
    assert list(read_messages(tmp_path / "again0")) == list(read_messages(tmp_path / "again1"))


def test_a_slow_disk_at_the_split_does_not_hold_up_the_recorder(tmp_path, monkeypatch):
    finish, written = PartWriter.finish, threading.Event()

    def slow(part, metadata=None):
        assert written.wait(60), "all is written while the first part is not finished"
        finish(part, metadata)

    monkeypatch.setattr(PartWriter, "finish", slow)
    writer = BagWriter(tmp_path / "drive", limits=SplitLimits(duration_s=0.5))
    fill(writer, 400)
    written.set()
    writer.close()
    assert [m.sequence for m in read_messages(tmp_path / "drive")] == list(range(400))


def test_a_part_that_cannot_be_finished_is_one_clear_error_and_everything_before_is_readable(
    tmp_path, monkeypatch
):
    def no_space(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    writer = BagWriter(tmp_path / "drive", limits=SplitLimits(duration_s=0.5))
    with monkeypatch.context() as patch:
        patch.setattr("nodes.bags.part.os.fsync", no_space)
        fill(writer, 51)
        while writer._finishing:
            time.sleep(0.001)
    with pytest.raises(BagError, match="No space left on device; 51 messages up to that point are readable"):
        fill(writer, 10, 51)
    writer.close()
    assert [m.sequence for m in read_messages(tmp_path / "drive")] == list(range(51))
    assert {"drive_0.mcap", "drive_1.mcap", "metadata.yaml"} <= {
        path.name for path in (tmp_path / "drive").iterdir()
    }


# Writes a bag again and again, each time in a process that is killed in front of its n-th change to the disk.
KILLED = """
import os, signal, sys, threading, time
from pathlib import Path
sys.path[:0] = sys.argv[3:5]
from test_bag_split_write import fill
from nodes.bags.writer import BagWriter, SplitLimits

originals = {name: getattr(os, name) for name in ("write", "ftruncate", "rename", "replace", "unlink", "open", "fsync")}

def dies_at(count):
    left, lock = [count], threading.Lock()
    def wrap(original):
        def call(*arguments, **options):
            with lock:
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            return original(*arguments, **options)
        return call
    for name, original in originals.items():
        setattr(os, name, wrap(original))

for count in map(int, sys.argv[2].split(",")):
    receiver, sender = os.pipe()
    if os.fork() == 0:
        dies_at(count)
        writer = BagWriter(Path(sys.argv[1]) / str(count) / "drive", limits=SplitLimits(duration_s=0.1))
        for i in range(60):
            fill(writer, 1, i)
            originals["write"](sender, bytes([i]))
            while i % 10 == 9 and writer._finishing:
                time.sleep(1e-4)
        writer.close()
        os._exit(0)
    os.close(sender)
    os.wait()
    said = os.read(receiver, 1000)
    os.close(receiver)
    print(count, len(said), flush=True)
"""


def killed_bags(tmp_path, counts):
    """Bags of recorders that were killed at these changes to the disk, each with the number of messages it had taken."""
    here = str(Path(__file__).parent)
    command = [sys.executable, "-c", KILLED, str(tmp_path), ",".join(map(str, counts)), here, os.getcwd()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    for line in result.stdout.splitlines():
        count, taken = map(int, line.split())
        yield tmp_path / str(count) / "drive", taken


def test_wherever_a_recorder_is_killed_around_a_split_nothing_is_lost_or_doubled(tmp_path):
    store, splits = get_typestore(Stores.ROS2_JAZZY), 0
    counts = sorted(np.random.default_rng(15).choice(np.arange(12, 200), 20, replace=False).tolist())
    for bag, taken in killed_bags(tmp_path, counts):
        repaired = repair_bag(bag, keep_original=False)
        numbers = [m.sequence for m in read_messages(bag)]
        assert numbers == list(range(len(numbers)))
        assert taken <= len(numbers) <= taken + 1
        with AnyReader([bag], default_typestore=store) as reader:
            assert len(list(reader.messages())) == reader.message_count == len(numbers)
        found = []
        for part in repaired:
            with open(part.path, "rb") as file:
                found += [m.sequence for _, _, m in make_reader(file, validate_crcs=True).iter_messages()]
        assert found == numbers
        left = [path.name for path in bag.iterdir() if path.name.startswith(".") or path.suffix == ".part"]
        assert left == []
        assert all(result.was_whole for result in repair_bag(bag))
        splits += len(repaired) - 1
    assert splits > 20


# Chunks as many as pictures of a camera and a compositor come, 60 a second, in parts with as many as 256 MiB of pictures have.
STREAM = """
import os, random, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from nodes.bags.writer import BagWriter, SplitLimits
writer = BagWriter(Path(sys.argv[1]), limits=SplitLimits(size_mib=0.5), compressed=True)
message, page = bytes([0, 1, 0, 0]) + random.Random(0).randbytes(200), os.sysconf("SC_PAGE_SIZE")
for i in range(int(sys.argv[3])):
    writer.write("/vicon/car", message, 1_800_000_000_000_000_000 + i * 30_000_000, 0, i)
    writer.flush()
    if i % 100 == 0:
        print(int(Path("/proc/self/statm").read_text().split()[1]) * page, len(writer._files), flush=True)
writer.close()
"""


@pytest.mark.live  # what waits for the disk counts as memory, so that nothing else may keep the writer from it
@pytest.mark.parametrize("minutes", [8, pytest.param(30, marks=pytest.mark.slow)])
def test_memory_does_not_grow_with_the_number_of_parts(tmp_path, minutes):
    chunks = minutes * 60 * 60
    command = [sys.executable, "-c", STREAM, str(tmp_path / "bag"), os.getcwd(), str(chunks)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    rows = [tuple(map(int, line.split())) for line in result.stdout.splitlines()]
    assert rows[-1][1] >= 10  # a part grows until the one before it is on the disk
    minute = 36  # rows in a minute
    # What waits for a busy disk comes and goes; what is never given back raises the least of a minute too.
    early = min(size for size, parts in rows[3 * minute : 4 * minute])
    late = min(size for size, parts in rows[-minute:])
    assert late / early - 1.0 < 0.02
