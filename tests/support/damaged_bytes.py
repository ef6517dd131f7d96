"""Damaged copies of good inputs."""

from __future__ import annotations

import random
import struct


def mutate(random_: random.Random, good: bytes) -> bytes:
    """A damaged copy of a good input, or random bytes."""
    if random_.random() < 0.05:
        return random_.randbytes(random_.randrange(300))
    data = bytearray(good)
    for _ in range(random_.choice((1, 1, 1, 2, 4, 16))):
        at = random_.randrange(len(data) + 1)
        kind = random_.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << random_.randrange(8)
        elif kind == 1 and data:
            data[at % len(data)] = random_.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind == 2:
            del data[at : at + random_.randrange(1, 20)]
        elif kind == 3:
            data[at:at] = data[at : at + random_.randrange(1, 40)]
        elif kind == 4:
            data[at : at + 4] = struct.pack("<I", random_.choice((0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1)))
        else:
            data[at:at] = random_.randbytes(random_.randrange(1, 9))
    return bytes(data)
