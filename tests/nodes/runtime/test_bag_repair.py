"""Bags of recorders that were killed, full disks, damaged files."""

import contextlib
import errno
import os
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nodes.bags import writer as bag_module
from nodes.bags.journal import journal_of
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.repair import repair
from nodes.bags.stamps import read_delays
from nodes.bags.writer import BagWriter
from nodes.runtime.errors import BagError
from nodes.runtime.topics import TOPICS
from tests.support.bag_samples import START_NS, sample, write_all_topics


def test_a_summary_that_lies_is_an_error_and_takes_no_memory(tmp_path):
    write_all_topics(tmp_path / "bag", rounds=1).close()
    path = tmp_path / "bag" / "bag.mcap"
    content = bytearray(path.read_bytes())
    with open(path, "rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    index = content.rindex(
        chunk.chunk_start_offset.to_bytes(8, "little") + chunk.chunk_length.to_bytes(8, "little")
    )
    start = int.from_bytes(content[-28:-20], "little")
    for wrong in (1 << 60, chunk.chunk_length + 10**9, 5):
        content[index + 8 : index + 16] = wrong.to_bytes(8, "little")
        path.write_bytes(content)
        with pytest.raises(BagError, match="the checksum of its summary"):
            list(read_messages(path))
        content[-12:-8] = zlib.crc32(content[start:-12]).to_bytes(4, "little")
        path.write_bytes(content)
        with pytest.raises(BagError, match=r"damaged|cannot be read"):
            list(read_messages(path))


def test_no_damage_makes_a_reader_do_anything_but_say_so(tmp_path):
    """Bytes changed, lengths that ask for the moon, pieces cut out and put in; seeds 0 to 59, and short files."""
    write_all_topics(tmp_path / "bag", rounds=1, attachments={"a": b"x" * 50}).close({"lost /arm": "1"})
    content = (tmp_path / "bag" / "bag.mcap").read_bytes()
    path = tmp_path / "x.mcap"

    def read_everything():
        for read in (
            read_info,
            read_attachments,
            read_delays,
            lambda bag: list(read_messages(bag)),
            repair,
            read_info,
        ):
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
    assert repair(path).messages == 11
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


RECORDER = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from nodes.bags.writer import BagWriter
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
    with pytest.raises(BagError, match=r"advnerf bag repair .* keeps all"):
        read_info(tmp_path / "bag")
    result = repair(tmp_path / "bag" / "bag.mcap")
    assert not result.was_whole
    sequences = [m.sequence for m in read_messages(tmp_path / "bag", ["/vicon/car"])]
    # Nothing that was flushed is lost, and nothing in between.
    assert sequences == list(range(len(sequences)))
    assert len(sequences) >= flushed
    with AnyReader([tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        assert len(list(reader.messages())) == result.messages
    assert repair(tmp_path / "bag" / "bag.mcap").was_whole
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
        result = repair(folder / "bag.mcap")
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


@pytest.mark.parametrize("content", [b"", b"not a bag at all"])
def test_what_is_no_bag_is_refused(tmp_path, content):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(BagError, match="expected a bag: MCAP"):
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
    stream_of["bag"] = writer._part._stream.descriptor
    monkeypatch.setattr(bag_module.os, "write", limited)
    pose = sample("geometry_msgs/msg/PoseStamped", START_NS)

    def fill():
        for i in range(10_000):
            writer.write("/vicon/car", pose, START_NS + i, START_NS + i, i)

    with pytest.raises(
        BagError, match=r"No space left on device; \d+ messages up to that point are readable"
    ):
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
