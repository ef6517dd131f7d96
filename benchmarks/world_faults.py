"""Does a world in another process ever end as a result when it fails? ``python -m benchmarks.world_faults`` (200 faults, about four minutes).

A real process serves a small simulator and misbehaves once at a random moment of a drive: it is killed, hangs, is late, sends garbage, another
version, or lies about the size of a picture, about depth, or about where it or the car is. What counts is that the drive ends with the
named error that fits, that the process is gone, and that the next drive is the same as before.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.results import record_row
from tests.support.remote.faults import FAULTS, drive, faulty_world, suffer

COMMAND = "python -m benchmarks.world_faults"
SEED, COUNT = 20261123, 200


def plan(count: int, seed: int = SEED) -> list[tuple[str, str, int]]:
    """Kinds in random order, each about equally often, with the call in which it happens and how many such calls go well before."""
    rng, kinds = random.Random(seed), list(FAULTS)
    order: list[str] = []
    while len(order) < count:
        order += rng.sample(kinds, len(kinds))
    return [(kind, rng.choice(FAULTS[kind][0]), rng.randrange(5)) for kind in order[:count]]


def wrong_ends(faults: list[tuple[str, str, int]]) -> Counter[str]:
    """How often each kind of fault ended as something else than its named error, left its process, or spoiled the next drive."""
    wrong: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="advnerf-faults-") as name:
        folder = Path(name)
        with faulty_world(folder) as world:
            whole = drive(world)
            for kind, call, after in faults:
                error, gone = suffer(world, folder, call, kind, after)
                if type(error) is not FAULTS[kind][1] or not gone or drive(world) != whole:
                    wrong[kind] += 1
                    print(
                        f"{kind} in {call}: {type(error).__name__}: {error}; process gone: {gone}", flush=True
                    )
    return wrong


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="another number of faults is not recorded")
    count = parser.parse_args().count
    began = time.monotonic()
    wrong = wrong_ends(plan(count))
    named = count - wrong.total()
    print(
        f"{named} of {count} faults end as their named error, {time.monotonic() - began:.0f} s; wrong: {dict(wrong) or 'none'}"
    )
    if count == COUNT:
        note = f"{len(FAULTS)} kinds at random moments of a drive; wrong: {dict(wrong) or 'none'}"
        record_row(
            "faults of a foreign world's process that end as a named error",
            named,
            f"of {count}",
            f"{count}",
            not wrong,
            COMMAND,
            note,
        )


if __name__ == "__main__":
    main()
