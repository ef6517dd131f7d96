"""Damage planted in every region of a chunk: what a repair keeps, counted by an independent reader before the damage."""

import random
import struct
import zlib

import lz4.frame
import pytest
import zstandard

from nodes.bags.reader import read_info
from nodes.bags.records import ChunkHead
from nodes.bags.repair import repair
from nodes.bags.salvage import good_records
from tests.support.bag_damage import make_bags, messages_of, reachable

START_NS = 1_800_000_000_000_000_000


def message(number, size):
    """A message record of channel 1 or 2, written from the format's specification."""
    body = struct.pack("<HIQQ", 1 + number % 2, number, START_NS + number, START_NS + number)
    body += random.Random(number).randbytes(size)
    return b"\x05" + struct.pack("<Q", len(body)) + body


RECORDS = [message(number, size) for number, size in enumerate([40, 0, 300, 7, 2000, 90, 90, 1, 500, 33])]
PLAIN = b"".join(RECORDS)
STARTS = [sum(map(len, RECORDS[:number])) for number in range(len(RECORDS))]
INDEX = {start: (1 + number % 2, START_NS + number) for number, start in enumerate(STARTS)}


def salvage(records, compression="", data=None, indexed=None):
    head = ChunkHead(START_NS, START_NS + 9, len(PLAIN), zlib.crc32(PLAIN), compression, 0, 0)
    return good_records(
        head, records if data is None else data, INDEX if indexed is None else indexed, {1, 2}
    )


def whole_records(found):
    """Numbers of the original records that these bytes consist of; a changed record is an error."""
    numbers = []
    while found:
        number = next(n for n, record in enumerate(RECORDS) if found.startswith(record) and n not in numbers)
        numbers.append(number)
        found = found[len(RECORDS[number]) :]
    return numbers


def test_of_one_wrong_byte_only_its_record_is_lost():
    heads = {start + k for start in STARTS for k in range(32)}
    for at in sorted(heads | set(range(0, len(PLAIN), 11))):
        damaged = bytearray(PLAIN)
        damaged[at] ^= (0x01, 0x80, 0xFF)[at % 3]
        found, proven = salvage(bytes(damaged))
        hit = max(number for number, start in enumerate(STARTS) if start <= at)
        assert (whole_records(found), proven) == ([n for n in range(len(RECORDS)) if n != hit], True)


@pytest.mark.parametrize("filling", ["zeros", "noise"])
@pytest.mark.parametrize("listed", [True, False])
def test_before_a_burst_all_records_but_the_last_are_kept(filling, listed):
    for at in range(0, len(PLAIN) - 600, 7):
        noise = bytes(600) if filling == "zeros" else random.Random(at).randbytes(600)
        damaged = PLAIN[:at] + noise + PLAIN[at + 600 :]
        found, proven = salvage(damaged, indexed=None if listed else {})
        kept, before = (
            whole_records(found),
            [n for n, start in enumerate(STARTS) if start + len(RECORDS[n]) <= at],
        )
        assert kept == before[: len(kept)]
        assert not proven
        # A burst inside one message does not show. Any other does in the head of the next record.
        if any(at <= start < at + 600 for start in STARTS):
            assert len(kept) >= len(before) - 1


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_of_a_compressed_chunk_the_blocks_before_the_damage_are_kept(compression):
    plain = b"".join(message(number, 5000) for number in range(200))
    indexed = {5031 * number: (1 + number % 2, START_NS + number) for number in range(200)}
    pack = lz4.frame.compress if compression == "lz4" else zstandard.compress
    data = pack(plain)
    head = ChunkHead(START_NS, START_NS + 199, len(plain), zlib.crc32(plain), compression, 0, 0)
    counts = []
    for share in (0.05, 0.3, 0.6, 0.95):
        at = int(share * len(data))
        found, _ = good_records(head, data[:at], indexed, {1, 2})
        assert plain.startswith(found)
        assert len(found) % 5031 == 0
        counts.append(len(found) // 5031 / (200 * share))
    assert min(counts[1:]) > 0.4
    assert counts[-1] > 0.85


@pytest.mark.parametrize("kind", ["chunks", "lz4", "zstd"])
@pytest.mark.parametrize("width", [1, 40])
def test_a_repair_keeps_no_changed_message_without_saying_so(tmp_path, kind, width):
    content = make_bags(tmp_path / "made")[kind]
    whole = reachable(content)
    chance = random.Random(width)
    kept = []
    first, last = 8, content.rindex(b"\x0f" + struct.pack("<Q", 4))
    for number in range(24):
        at = first + (last - first) * number // 24 + chance.randrange(40)
        noise = bytes(byte ^ chance.randrange(1, 256) for byte in content[at : at + width])
        folder = tmp_path / str(number)
        folder.mkdir()
        path = folder / "bag.mcap"
        path.write_bytes(content[:at] + noise + content[at + width :])
        repair(path, force=True)
        found = messages_of(path)
        changed = [each for each in found if each not in whole]
        assert not changed or read_info(path).unchecked
        kept.append(len(found) - len(changed))
    assert sum(kept) / len(kept) > (58 if width == 1 and kind == "chunks" else 45)
