"""Chunk indexes that are kept on disk: the same ones, in order, in a file that readers find everything in, and without memory."""

import tracemalloc

import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import Writer

from nodes.runtime.bag import BagWriter
from nodes.runtime.bag_index_spool import SpooledIndexes


def index(number: int) -> ChunkIndex:
    return ChunkIndex(
        chunk_length=100 + number, chunk_start_offset=number << 20, compression="", compressed_size=90 + number, message_end_time=2 * number,
        message_index_length=7, message_index_offsets={1: number, 2: number + 1}, message_start_time=number, uncompressed_size=91 + number,
    )  # fmt: skip


def test_they_come_back_as_they_were_and_more_can_follow(tmp_path):
    spool, wanted = SpooledIndexes(tmp_path), [index(number) for number in range(50)]
    for each in wanted[:30]:
        spool.append(each)
    assert list(spool) == wanted[:30]
    for each in wanted[30:]:
        spool.append(each)
    assert list(spool) == wanted
    assert len(spool) == 50
    spool.close()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_loses_none(tmp_path):
    spool, wanted = SpooledIndexes(tmp_path), [index(number) for number in range(6)]
    for each in wanted[:3]:
        spool.append(each)

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, data):
            raise OSError(28, "No space left on device")

        def __getattr__(self, name):
            return getattr(self.file, name)

    spool._file = Full(spool._file)
    for each in wanted[3:]:
        spool.append(each)
    assert list(spool) == wanted


def test_memory_does_not_grow_with_the_number_of_chunks(tmp_path):
    spool = SpooledIndexes(tmp_path)
    for number in range(200):
        spool.append(index(number))
    tracemalloc.start()
    for number in range(3000):
        spool.append(index(number))
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 20_000  # kept as objects they are two megabytes


def test_the_writer_of_the_library_still_keeps_them_where_we_replace_them(tmp_path):
    with (tmp_path / "x").open("wb") as file:
        assert Writer(file)._Writer__chunk_indices == []


def test_every_message_of_a_bag_of_many_chunks_is_found_by_its_index(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for number in range(12):
            bag.write("/vicon/car", bytes([0, 1, 0, 0]) + bytes(70_000), 10 + number, 10 + number, number)
    with (tmp_path / "bag" / "bag.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) >= 12
        found = [message.log_time for _, _, message in reader.iter_messages(starting_at=15, ending_before=18)]
    assert found == pytest.approx([15, 16, 17])
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag.mcap", "metadata.yaml"]
