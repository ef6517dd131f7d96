"""Damaged bags: what readers notice, what a repair keeps, and that it never destroys."""

import random
import resource
import signal
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from typer.testing import CliRunner

from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.repair import repair
from nodes.bags.repair_parts import repair_bag
from nodes.bags.writer import BagWriter, SplitLimits
from nodes.cli.main import app
from nodes.runtime.errors import BagError
from nodes.runtime.messages import encode, pose_message
from tests.support.bag_damage import (
    COVERED,
    KINDS,
    Numbers,
    covered,
    cut_once,
    flip_once,
    make_bags,
    messages_of,
    reachable,
)
from tests.support.bag_samples import START_NS, write_all_topics
from tests.support.waiting import wait_for


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    return make_bags(tmp_path_factory.mktemp("bags"))


@pytest.fixture
def write(tmp_path):
    """A file of a new folder with this content."""

    def make(content, name="bag"):
        path = tmp_path / name / "bag.mcap"
        path.parent.mkdir()
        path.write_bytes(content)
        return path

    return make


def chunks_of(content):
    """Offset and length of every chunk record."""
    found, at = [], 8
    while content[at] != 0x0F:
        (length,) = struct.unpack_from("<Q", content, at + 1)
        if content[at] == 0x06:
            found.append((at, 9 + length))
        at += 9 + length
    return found


def flipped(content, at, bit=0):
    damaged = bytearray(content)
    damaged[at] ^= 1 << bit
    return bytes(damaged)


@pytest.mark.parametrize("first", KINDS)
def test_a_second_recording_behind_the_first_is_told_and_not_dropped(first, bags, write):
    other = bags["ours"]
    path = write(bags[first] + other)
    for tried in (lambda: read_info(path), lambda: repair(path)):
        with pytest.raises(BagError, match=r"damaged|another recording at byte"):
            tried()
    assert path.read_bytes() == bags[first] + other
    done = repair(path, force=True)
    assert done.messages == 60
    assert done.cut_bytes >= len(other)
    assert f"another recording at byte {len(bags[first])}" in " ".join(done.losses)
    assert messages_of(path) == reachable(bags[first])


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_read_as_an_independent_reader_reads_it(kind, bags, write):
    path = write(bags[kind])
    assert messages_of(path) == reachable(bags[kind])
    assert len(messages_of(path)) == 60
    assert repair(path).was_whole
    assert path.read_bytes() == bags[kind]
    assert (read_info(path).unchecked != "") is (kind in ("no chunks", "mixed", "no checksums"))


@pytest.mark.parametrize("kind", KINDS)
def test_wherever_a_file_is_cut_its_messages_stay_and_so_does_the_file(kind, bags, tmp_path):
    draw = random.Random(kind)
    for number in range(20):
        cut_once(bags[kind], draw.randrange(8, len(bags[kind])), tmp_path, number)


@pytest.mark.parametrize("kind", COVERED)
def test_no_flipped_bit_changes_a_number_silently(kind, bags, write, tmp_path):
    good = Numbers.of(write(bags[kind]))
    draw = random.Random(kind)
    places = [at for part in covered(bags[kind]) for at in part]
    for number in range(20):
        noticed, _ = flip_once(bags[kind], draw.choice(places), draw.randrange(8), good, tmp_path, number)
        assert noticed


def test_a_truncated_file_without_chunks_keeps_its_messages(bags, write):
    """rosbag2's preset `fastwrite`: such a file was emptied, and the exit code was 0."""
    content = bags["no chunks"][:-2000]
    path = write(content)
    info = CliRunner().invoke(app, ["bag", "info", str(path)])
    assert info.exit_code == 2
    assert f"advnerf bag repair {path} keeps all {len(reachable(content))} intact messages" in info.stderr
    result = repair(path)
    assert result.messages == len(reachable(content)) > 40
    assert result.kept.read_bytes() == content
    with open(path, "rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == result.messages
    assert "outside chunks" in read_info(path).unchecked


def test_a_bad_chunk_is_named_and_what_follows_is_kept_only_when_asked_for(bags, write):
    content = bags["chunks"]
    chunks = chunks_of(content)
    at, length = chunks[2]
    damaged = flipped(content, at + length - 30)
    path = write(damaged)
    with pytest.raises(
        BagError, match=rf"{path} is damaged: the chunk at byte {at} \(log times \d+ to \d+ ns, 0\.\d+ to"
    ):
        messages_of(path)
    with pytest.raises(
        BagError, match=r"after the first message; /vicon/board, /vicon/car\): its checksum is [0-9a-f]{8}"
    ):
        messages_of(path)
    # A topic that has no message in the damaged chunk, and a time after it, are read.
    after = next(read_messages(path, start_offset_s=1.0))
    assert after.log_ns >= START_NS + 1_000_000_000
    with pytest.raises(
        BagError, match="messages would be lost that are not at the end of an unfinished recording"
    ):
        repair(path)
    assert path.read_bytes() == damaged
    assert sorted(file.name for file in path.parent.iterdir()) == ["bag.mcap"]
    result = repair(path, force=True)
    whole, kept = reachable(content), messages_of(path)
    lost = [message for message in whole if message not in kept]
    assert kept == [message for message in whole if message in kept]
    assert 0 < len(lost) < 60 / len(chunks) * 3
    assert sum(topic.before - topic.after for topic in result.topics) == len(lost)
    assert result.kept.read_bytes() == damaged
    assert read_attachments(path) == read_attachments(write(content, "good"))
    assert read_info(path).unchecked == ""


def test_the_chunk_with_all_definitions_may_be_the_bad_one(bags, write):
    content = bags["zstd"]
    at, length = chunks_of(content)[0]
    path = write(flipped(content, at + length - 9))
    repair(path, force=True)
    kept = messages_of(path)
    assert kept == reachable(content)[-len(kept) :]
    assert {topic.type for topic in read_info(path).topics} == {"geometry_msgs/msg/PoseStamped"}
    with open(path, "rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(kept)
    # Without a summary their names are gone, the messages are not.
    path = write(flipped(content, at + length - 9)[:-500], "cut")
    repair(path, force=True)
    assert {topic.name for topic in read_info(path).topics} == {"/unnamed_channel_1", "/unnamed_channel_2"}
    assert [message[1:] for message in messages_of(path)] == [message[1:] for message in kept]


@pytest.mark.parametrize("place", [0, 1, 2, 3, 8, 9, 17, 25, 37, 41, 48])
@pytest.mark.parametrize("kind", ["chunks", "lz4"])
def test_damage_to_the_head_of_a_chunk_loses_nothing(kind, place, bags, write):
    """Opcode, length, times, size, compression: no checksum covers them, that of the content tells what they must be."""
    content = bags[kind]
    at, _ = chunks_of(content)[2]
    path = write(flipped(content, at + place, bit=4))
    try:
        result = repair(path)
    except BagError:
        # The place of its data cannot be told any more.
        assert place >= 37
        return
    assert messages_of(path) == reachable(content)
    assert repair(path).was_whole
    assert not result.losses


@pytest.mark.parametrize("kind", ["chunks", "no chunks", "mixed"])
def test_whatever_byte_is_damaged_repair_keeps_the_rest_or_refuses(kind, bags, write):
    """Also in bytes that no checksum covers: without --force no message is lost."""
    content, draw = bags[kind], random.Random(kind)
    for number in range(75):
        at = draw.randrange(8, len(content))
        path = write(flipped(content, at, draw.randrange(8)), str(number))
        before = path.read_bytes()
        try:
            result = repair(path)
        except BagError:
            assert path.read_bytes() == before
            repair(path, force=True)
            assert len(messages_of(path)) >= 30
        else:
            assert result.messages == 60, (number, at)


def test_a_length_that_is_wrong_loses_one_message_not_the_rest(bags, write):
    content = bags["no chunks"]
    at = content.index(encode(pose_message_of(20))) - 31
    assert content[at] == 0x05
    for bad in (b"\xff\xff\x00\x00", b"\x01\x00\x00\x00", b"\x00\x00\xff\x7f"):
        path = write(content[: at + 1] + bad + content[at + 5 :], bad.hex())
        with pytest.raises(BagError, match=r"damaged|lists 60 messages"):
            messages_of(path)
        repair(path, force=True)
        assert len(messages_of(path)) in (58, 59)


def pose_message_of(index):
    T = np.eye(4)
    T[:2, 3] = 0.08 * index, 0.3 * np.sin(index)
    return pose_message(T, START_NS + index * 20_000_000)


def test_a_flipped_bit_in_each_pose_is_an_error_of_evaluate(tmp_path):
    """21 flips changed a total cross-track error from 8.693 to 8.232 m without a word."""
    from nodes.lab.trials.evaluation import trajectory

    write_all_topics(tmp_path / "bag", rounds=40).close()
    path = tmp_path / "bag" / "bag.mcap"
    content = bytearray(path.read_bytes())
    at, length = chunks_of(content)[1]
    content[at + length // 2] ^= 0x10
    path.write_bytes(content)
    from advnerf_core.driving.metrics import Horizon

    with pytest.raises(BagError, match=f"chunk at byte {at}"):
        trajectory(path, START_NS, Horizon(20))


def test_damaged_attachment_and_summary_are_named(bags, write):
    content = bags["ours"]
    at = content.index(b"speed_mps")
    path = write(flipped(content, at))
    with pytest.raises(BagError, match=r"attachment a\.yaml at byte"):
        read_attachments(path)
    with pytest.raises(BagError, match="is not repaired"):
        repair(path)
    assert repair(path, force=True).messages == 60
    path = write(flipped(content, len(content) - 100), "summary")
    with pytest.raises(BagError, match="checksum of its summary"):
        read_info(path)
    assert repair(path).messages == 60
    assert read_attachments(path)


def test_metadata_is_covered_where_all_data_have_a_checksum(bags, write):
    content = bags["all data"]
    path = write(flipped(content, content.index(b"somebody")))
    with pytest.raises(BagError, match="the checksum of its data"):
        messages_of(path)


def test_repair_never_overwrites_what_it_kept_before(bags, write):
    path = write(bags["chunks"][:-1000])
    first = repair(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    second = repair(path)
    assert [first.kept.name, second.kept.name] == ["bag.mcap.damaged", "bag.mcap.damaged.2"]
    assert first.kept.read_bytes() == bags["chunks"][:-1000]
    path.write_bytes(whole[:-30])
    assert repair(path, keep_original=False).kept is None
    assert not (path.parent / "bag.mcap.damaged.3").exists()


SLOW_REPAIR = """
import os, sys
from pathlib import Path
from nodes.bags import repair as bag_repair
replace, link = Path.replace, os.link
def at(step):
    if sys.argv[2] == step:
        os.kill(os.getpid(), 9)
copy = bag_repair._copy
def slow(old, new, part):
    copy(old, new, part)
    new.flush()
    at("copy")
bag_repair._copy = slow
def linked(*arguments):
    at("before link")
    link(*arguments)
    at("after link")
os.link = linked
def replaced(self, target):
    replace(self, target)
    at("replaced")
Path.replace = replaced
bag_repair.repair(Path(sys.argv[1]))
"""


@pytest.mark.parametrize("step", ["copy", "before link", "after link", "replaced"])
def test_a_repair_that_is_killed_leaves_the_file(step, bags, write):
    content = bags["chunks"][:-1000]
    path = write(content)
    done = subprocess.run([sys.executable, "-c", SLOW_REPAIR, str(path), step], check=False)
    assert done.returncode == -signal.SIGKILL
    names = [file for file in path.parent.iterdir() if file.read_bytes() == content]
    assert names
    if step != "replaced":
        assert path in names
        assert repair(path).kept.read_bytes() == content
    assert messages_of(path) == reachable(content)
    assert sorted(f.name for f in path.parent.iterdir() if "damaged" in f.name or "repair" in f.name) == [
        "bag.mcap.damaged"
    ]


def test_a_full_disk_leaves_the_file(bags, write):
    content = bags["chunks"][:-1000]
    path = write(content)
    code = "import sys; from nodes.bags.repair import repair; from pathlib import Path; repair(Path(sys.argv[1]))"

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) // 2, len(content) // 2))

    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], preexec_fn=limit, capture_output=True, text=True, check=False
    )
    assert "cannot repair" in done.stderr
    assert "the file is unchanged" in done.stderr
    assert [file.name for file in path.parent.iterdir()] == ["bag.mcap"]
    assert path.read_bytes() == content


def test_a_file_that_is_being_written_is_left_alone(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/vicon/car", b"x" * 100, START_NS, START_NS, 0)
        writer.flush()
        with pytest.raises(BagError, match="is being written at this moment"):
            repair(writer.path)
        with pytest.raises(BagError, match="is being written at this moment"):
            read_info(writer.path)
    assert repair(writer.path).was_whole


def test_a_file_that_its_recorder_finishes_while_it_is_read_was_not_left_unfinished(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    writer.write("/vicon/car", b"x" * 100, START_NS, START_NS, 0)
    writer.flush()
    threading.Timer(0.2, writer.close).start()  # a reader asks for half a second whether it is still written

    def read():
        try:
            return read_info(writer.path)
        except BagError as error:
            if "is being written at this moment" not in str(error):
                raise
            return None

    assert wait_for(read, "the end of the recording").messages == 1


def test_a_copy_of_the_file_that_a_starting_process_has_for_a_moment_is_no_writer(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/vicon/car", b"x" * 100, START_NS, START_NS, 0)
    inherited = writer.path.open("ab")
    threading.Timer(0.1, inherited.close).start()
    assert repair(writer.path).was_whole
    assert inherited.closed


def test_zeros_behind_the_last_record_are_left_out(bags, write):
    """What a file system leaves after a power cut."""
    chunks = chunks_of(bags["chunks"])
    content = bags["chunks"][: chunks[3][0]] + bytes(5000)
    path = write(content)
    result = repair(path)
    assert result.messages == len(reachable(content))
    assert "5000 zeros" in result.losses[0]


def test_what_cannot_be_told_from_noise_is_not_thrown_away(bags, write):
    content = bags["chunks"][:300] + random.Random(1).randbytes(100_000)
    path = write(content)
    with pytest.raises(BagError, match="is not repaired"):
        repair(path)
    assert path.read_bytes() == content


def test_a_compression_that_is_not_known_is_no_damage(bags, write):
    content = bags["zstd"].replace(b"zstd", b"zzip")
    path = write(content[:-1000])
    for force in (False, True):
        with pytest.raises(BagError, match="got 'zzip'"):
            repair(path, force=force)
    assert path.read_bytes() == content[:-1000]


def test_the_command_says_what_was_before_and_after(bags, write):
    run = CliRunner().invoke
    at, length = chunks_of(bags["chunks"])[2]
    path = write(flipped(bags["chunks"], at + length - 30))
    info = run(app, ["bag", "info", str(path)])
    assert info.exit_code == 2
    assert "repair --force" in info.stderr
    refused = run(app, ["bag", "repair", str(path)])
    assert refused.exit_code != 0
    done = run(app, ["bag", "repair", "--force", str(path)])
    assert done.exit_code == 0
    assert f"a chunk at byte {at}" in done.stdout
    assert "messages before" in done.stdout
    assert "40" in done.stdout
    assert "bag.mcap.damaged" in done.stdout
    again = run(app, ["bag", "repair", str(path)])
    assert "is intact" in again.stdout
    assert "nothing was changed" in again.stdout
    assert "checked: all messages match" in run(app, ["bag", "info", str(path)]).stdout
    loose = write(bags["no chunks"], "loose")
    assert "unchecked: 60 of its messages are outside chunks" in run(app, ["bag", "info", str(loose)]).stdout


def test_journal_is_kept_with_the_file_as_it_was(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    for i in range(10):
        writer.write("/vicon/car", bytes([i] * 50), START_NS + i, START_NS + i, i)
    path = writer.path
    writer._let_go()
    result = repair(path)
    assert result.messages == 10
    assert (path.parent / "bag.mcap.damaged.journal").exists()


def test_a_bag_of_a_stranger_that_was_repaired_says_nothing_of_losses(bags, write):
    path = write(bags["no chunks"][:-2000])
    repair(path)
    assert {topic.lost for topic in read_info(path).topics} == {None}


def test_what_is_read_from_a_bag_without_checksums_is_said_to_be_unchecked(bags, write, capsys):
    for name, said in (("no chunks", True), ("no checksums", True), ("chunks", False), ("all data", False)):
        path = write(bags[name], name)
        next(read_messages(path))
        assert ("unchecked" in capsys.readouterr().err) is said


def test_a_part_of_a_split_bag_is_repaired_by_itself_and_the_list_follows(tmp_path):
    limits = SplitLimits(duration_s=0.1)
    with BagWriter(tmp_path / "bag", limits=limits) as writer:
        for i in range(40):
            stamp_ns = START_NS + i * 10_000_000
            writer.write("/vicon/car", encode(pose_message(np.eye(4), stamp_ns)), stamp_ns, stamp_ns, i)
            time.sleep(0.005)
    parts = read_info(tmp_path / "bag").parts
    assert len(parts) > 1
    content = parts[0].read_bytes()
    at, length = chunks_of(content)[0]
    parts[0].write_bytes(flipped(content, at + length - 20))
    with pytest.raises(BagError, match=f"{parts[0]} is damaged: the chunk at byte {at}"):
        list(read_messages(tmp_path / "bag"))
    done = repair_bag(tmp_path / "bag", force=True)
    assert [part.was_whole for part in done] == [False] + [True] * (len(parts) - 1)
    left = len(list(read_messages(tmp_path / "bag")))
    assert 0 < left < 40
    listed = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert listed["message_count"] == left
    assert "message_count: 40" in (tmp_path / "bag" / "metadata.yaml.damaged").read_text()
