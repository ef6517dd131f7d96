"""Bags that others split: read as one, in the order of time, whatever part a message or an attachment is in."""

import shutil

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from nodes.bags import reader
from nodes.bags.reader import extract_attachments, read_attachment, read_attachments, read_info, read_messages
from nodes.runtime.errors import BagError
from tests.support.bag_samples import START_NS
from tests.support.commands import advnerf
from tests.support.split_samples import foreign_metadata, foreign_part

TOPICS = ("/vicon/car", "/arm", "/policy/drive")


def split_bag(tmp_path, parts=4, each=60, chunked=True):
    """A bag whose parts overlap in time, the first topic only from the second part on; all messages in order of time."""
    rng, folder = np.random.default_rng(3), tmp_path / "theirs"
    folder.mkdir()
    everything = []
    for number in range(parts):
        topics = TOPICS[1:] if number == 0 else TOPICS
        rows = [
            (
                topics[int(rng.integers(len(topics)))],
                START_NS + (number * each + i) * 1000 + int(rng.integers(-5000, 5000)),
                i,
            )
            for i in range(each)
        ]
        # rosbags reads no file without chunks whose messages are out of order.
        rows = rows if chunked else sorted(rows, key=lambda row: row[1])
        everything += rows
        attachments = [(f"{number}.yaml", str(number).encode())] if number in (0, 2) else ()
        foreign_part(folder / f"theirs_{number}.mcap", rows, attachments, chunked)
    counts = {topic: sum(row[0] == topic for row in everything) for topic in TOPICS}
    foreign_metadata(folder, [f"theirs_{number}.mcap" for number in range(parts)], counts)
    return folder, sorted(everything, key=lambda row: row[1]), counts


@pytest.mark.parametrize("chunked", [True, False])
def test_messages_of_all_parts_come_in_order_of_time(tmp_path, chunked):
    folder, everything, counts = split_bag(tmp_path, chunked=chunked)
    with AnyReader([folder]) as theirs_reader:
        theirs = [(connection.topic, stamp) for connection, stamp, _ in theirs_reader.messages()]
    for bag in (folder, folder / "theirs_2.mcap", folder / "metadata.yaml"):
        ours = [(m.topic, m.log_ns) for m in read_messages(bag)]
        assert ours == [row[:2] for row in everything]
    assert sorted(ours) == sorted(theirs)
    assert {t.name: t.count for t in read_info(folder).topics} == counts
    offset_s = 1e-4
    late = [(m.topic, m.log_ns) for m in read_messages(folder, ["/arm"], offset_s)]
    begin_ns = everything[0][1] + 100_000
    assert late == [row[:2] for row in everything if row[0] == "/arm" and row[1] >= begin_ns]


def test_info_is_about_all_parts_and_attachments_come_from_any(tmp_path):
    folder, everything, _ = split_bag(tmp_path)
    info = read_info(folder / "theirs_0.mcap")
    assert (info.path, len(info.parts), info.messages) == (folder, 4, len(everything))
    assert info.size_bytes == sum(path.stat().st_size for path in folder.glob("*.mcap"))
    assert (info.start_ns, info.end_ns) == (everything[0][1], everything[-1][1])
    assert info.attachments == ("0.yaml", "2.yaml")
    assert read_attachment(folder, "2.yaml") == b"2"
    assert read_attachments(folder) == {"0.yaml": b"0", "2.yaml": b"2"}
    assert [path.read_bytes() for path in extract_attachments(folder, tmp_path / "out")] == [b"0", b"2"]
    with pytest.raises(BagError, match=r"it has 0\.yaml, 2\.yaml"):
        read_attachment(folder, "1.yaml")


def test_another_recording_in_the_folder_is_named(tmp_path, monkeypatch, capsys):
    folder, *_ = split_bag(tmp_path)
    for name in ("other.mcap", "theirs.db3"):
        shutil.copy(folder / "theirs_0.mcap", folder / name)
    assert not advnerf(monkeypatch, "bag", "info", str(folder))
    assert "not read, as no part of this bag: other.mcap, theirs.db3; give each" in capsys.readouterr().out
    assert read_info(folder / "other.mcap").parts == (folder / "other.mcap",)


def test_a_missing_part_is_no_shorter_recording(tmp_path):
    folder, _, _ = split_bag(tmp_path)
    (folder / "theirs_2.mcap").unlink()
    for read in (read_info, read_attachments, lambda bag: list(read_messages(bag))):
        with pytest.raises(BagError, match=r"the part theirs_2\.mcap of the bag is missing"):
            read(folder)


def test_files_are_opened_only_when_their_time_has_come(tmp_path, monkeypatch):
    folder = tmp_path / "theirs"
    folder.mkdir()
    for number, times in enumerate([[0, 1, 2, 5], [3, 4], [100]]):
        rows = [("/arm", START_NS + time, index) for index, time in enumerate(times)]
        foreign_part(folder / f"theirs_{number}.mcap", rows)
    foreign_metadata(folder, [f"theirs_{number}.mcap" for number in range(3)], {"/arm": 7})
    read_info(folder)  # whose summaries are kept
    opened, open_bag = [], reader.open_bag

    def opening(path):
        opened.append(path.stem[-1])
        return open_bag(path)

    monkeypatch.setattr(reader, "open_bag", opening)
    times = (each.log_ns - START_NS for each in read_messages(folder))
    assert [next(times) for _ in range(3)] == [0, 1, 2]
    assert opened == ["0"]
    assert list(times) == [3, 4, 5, 100]
    assert opened == ["0", "1", "2"]
