import hashlib
from dataclasses import replace

import numpy as np
import pytest

from nodes.runtime.messages import decode, encode
from nodes.runtime.transfer import CHUNK_BYTES, LARGEST_BYTES, Assembler, chunk_messages

pytestmark = pytest.mark.live

TYPE = "advnerf_msgs/msg/FileChunk"


def content(size, seed=0):
    return np.random.default_rng(seed).bytes(size)


def over_the_wire(messages):
    return [decode(TYPE, encode(message)) for message in messages]


def put(assembler, chunks, instance_id=1):
    """What comes out of pieces: the files, and the troubles."""
    results = [assembler.add(chunk, instance_id) for chunk in chunks]
    return [file for file, _ in results if file is not None], [trouble for _, trouble in results if trouble]


@pytest.mark.parametrize("size", [1, CHUNK_BYTES - 1, CHUNK_BYTES, CHUNK_BYTES + 1, 3 * CHUNK_BYTES])
def test_a_file_arrives_as_it_was(size):
    data = content(size)
    chunks = over_the_wire(chunk_messages(data, "a", 5))
    assert len(chunks) == -(-size // CHUNK_BYTES)
    assembler = Assembler()
    (file,), troubles = put(assembler, chunks)
    assert (file.content, file.name, file.sha256, troubles) == (
        data,
        "a",
        hashlib.sha256(data).hexdigest(),
        [],
    )
    assert not assembler.receiving
    assert len(put(assembler, chunks)[0]) == 1


def test_nothing_and_too_much_are_not_sent():
    for size in (0, LARGEST_BYTES + 1):
        with pytest.raises(ValueError, match="expected a file of 1 to"):
            chunk_messages(bytes(size), "a", 0)


CHUNKS = over_the_wire(chunk_messages(content(3 * CHUNK_BYTES + 7), "a", 0))
OTHERS = over_the_wire(chunk_messages(content(2 * CHUNK_BYTES, 1), "b", 0))


@pytest.mark.parametrize(
    "chunks",
    [
        [CHUNKS[0], CHUNKS[2], CHUNKS[1], CHUNKS[3]],
        [CHUNKS[0], CHUNKS[1], CHUNKS[3]],
        [CHUNKS[0], CHUNKS[0], CHUNKS[1], CHUNKS[3]],
        [CHUNKS[0], OTHERS[1], CHUNKS[1], CHUNKS[2], CHUNKS[3]],
        [CHUNKS[0], CHUNKS[1], replace(CHUNKS[2], data=CHUNKS[2].data ^ 1), CHUNKS[3]],
        [CHUNKS[0], CHUNKS[1], replace(CHUNKS[2], data=CHUNKS[2].data[:-1]), CHUNKS[3]],
        [replace(CHUNKS[0], size_bytes=2**40)],
        [replace(CHUNKS[0], count=2**31)],
        [replace(CHUNKS[0], size_bytes=0, count=0)],
    ],
)
def test_a_broken_transfer_gives_nothing_says_why_and_the_next_one_is_whole(chunks):
    assembler = Assembler()
    files, troubles = put(assembler, chunks)
    assert files == []
    assert troubles
    files, _ = put(assembler, CHUNKS)
    assert len(files) == 1


def test_a_restarted_sender_begins_again():
    assembler = Assembler()
    assert put(assembler, CHUNKS[:2], instance_id=1) == ([], [])
    files, troubles = put(assembler, CHUNKS, instance_id=2)
    assert len(files) == 1
    assert len(troubles) == 1


def test_a_late_listener_waits_for_the_beginning():
    assembler = Assembler()
    assert put(assembler, CHUNKS[1:]) == ([], [])
    assert len(put(assembler, CHUNKS)[0]) == 1
