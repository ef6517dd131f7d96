"""Does ``advnerf verify`` find what somebody changed in the published results? ``python -m benchmarks.planted_changes [SET]``.

One change at a time is planted into a copy of them, in a repository of its own whose first commit has the registrations and whose second
has everything else. Most changes renew digests, numbers and pages with the project's own code. Some can be seen in the history alone,
and two by a second party alone, who has a clone of the true history or measures again. `benchmarks.planting.kinds` lists them.
"""

from __future__ import annotations

import argparse
import random
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory

from advnerf_core.documents import read_json
from advnerf_core.files import sha256_of
from advnerf_core.report.evidence.page import picture_of
from benchmarks.kept_rows import computed_again
from benchmarks.page_numbers import write_list
from benchmarks.planting.detecting import Found, find
from benchmarks.planting.kinds import KINDS
from benchmarks.planting.simulated import NAME, write_simulated_set
from benchmarks.planting.world import World, copy_published
from benchmarks.results import REPOSITORY, LedgerRow, read_rows, record_row, write_pages

_RECORDED, _TARGET_PERCENT = 1000, 95.0


@dataclass
class Counts:
    """What became of planted changes, by kind.

    Attributes:
        planted: How many there were.
        by_files: Found by the files alone.
        missed: Found by neither files nor history.
    """

    planted: Counter[str] = field(default_factory=Counter)
    by_files: Counter[str] = field(default_factory=Counter)
    missed: Counter[str] = field(default_factory=Counter)

    def add(self, other: Counts) -> None:
        """Add those of other changes."""
        self.planted += other.planted
        self.by_files += other.by_files
        self.missed += other.missed


def main() -> None:
    """Plant, count and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", nargs="?", default="", help="a published set; else one of simulated drives")
    parser.add_argument("--changes", type=int, default=_RECORDED)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes, each with a copy of its own")
    options = parser.parse_args()
    began = time.perf_counter()
    parts = [range(options.changes)[job :: options.jobs] for job in range(options.jobs)]
    counts = Counts()
    with ProcessPoolExecutor(options.jobs) as pool:
        for part in pool.map(_part, repeat(options.set), parts, repeat(options.seed)):
            counts.add(part)
    found = options.changes - counts.missed.total()
    print(
        f"{found} of {options.changes} found in {time.perf_counter() - began:.0f} s, {counts.by_files.total()} of them by the files alone"
    )
    for kind, count in counts.planted.items():
        print(f"{kind}: {count} planted, {counts.by_files[kind]} by files, {counts.missed[kind]} missed")
    if options.changes == _RECORDED:
        _record(options.set, counts, found)


def _part(name: str, numbers: Sequence[int], seed: int) -> Counts:
    """Some of the changes, in a copy of their own."""
    with TemporaryDirectory() as work:
        world = published_world(Path(work), name) if name else simulated_world(Path(work))
        return planted(world, numbers, seed)


def _record(name: str, counts: Counts, found: int) -> None:
    percent = 100.0 * found / _RECORDED
    command = "python -m benchmarks.planted_changes" + f" {name}" * bool(name)
    which = f"the set {name}" if name else "a set of simulated drives"
    missed = ", ".join(f"{count} x {kind}" for kind, count in counts.missed.items() if count) or "none"
    others = sorted(
        kind for kind, count in counts.missed.items() if count and KINDS[kind].seen_by != "second party"
    )
    note = f"{_RECORDED} changes of {len(KINDS)} kinds, {counts.by_files.total()} found by the files alone; missed: {missed}"
    note += "; only a second party can see these" if found < _RECORDED and not others else ""
    record_row(f"planted changes found by verify, {which}", round(percent, 1), "%", f">= {_TARGET_PERCENT:g} %", percent >= _TARGET_PERCENT, command, note)  # fmt: skip


def planted(world: World, numbers: Sequence[int], seed: int = 0) -> Counts:
    """Plant changes one at a time, all kinds in turn by their numbers.

    Raises:
        RuntimeError: The copy has problems before anything was changed.
    """
    picture = sha256_of(world.published / picture_of(world.name))
    if clean := find(world, picture):
        raise RuntimeError(f"expected a copy without problems, got {(*clean.files, *clean.history)[0]}")
    kinds, counts = list(KINDS), Counts()
    for done, number in enumerate(numbers, 1):
        kind = kinds[number % len(kinds)]
        world.rng.seed(f"{seed} {number}")
        KINDS[kind].plant(world)
        counts.planted[kind] += 1
        try:
            found = find(world, picture)
        except Exception:  # a crash names nothing: it counts as missed
            traceback.print_exc()
            found = Found((), ())
        counts.by_files[kind] += bool(found.files)
        counts.missed[kind] += not found
        world.restore()
        if not done % 100:
            print(f"{done} of {len(numbers)}, missed: {dict(+counts.missed) or None}", flush=True)
    return counts


def published_world(work: Path, name: str) -> World:
    """A copy of all that is published here."""
    root = work / "repository"
    copy_published(REPOSITORY, root)
    return _begun(root, name, computed_again([row["command"] for row in read_rows()]))


def simulated_world(work: Path, searches: int = 6, starts: int = 5) -> World:
    """A set of simulated drives, with three rows of a ledger."""
    root = work / "repository"
    write_simulated_set(root / "docs" / "results" / NAME, searches, starts)
    again = [LedgerRow("a kept row", 0.5, "m", ">= 0.4 m", True, f"python -m benchmarks.gap {NAME}")]
    once = [
        LedgerRow(
            "a missed row", 20.0, "dB", ">= 26 dB", False, "python -m benchmarks.fox", "too few photos"
        ),
        LedgerRow("a row", 3.0, "x", ">= 2 x", True, "python -m benchmarks.floors", "on two cores"),
    ]
    for row in (*again, *once):
        row.record(root / "docs" / "results.json", root / "docs" / "results.md")
    return _begun(root, NAME, again)


def _begun(root: Path, name: str, again: Sequence[LedgerRow]) -> World:
    """A world whose README tells a result of its set."""
    world = World(root, name, random.Random(0), again)
    readme = root / "README.md"
    if not readme.exists():
        readme.write_text("# A project\n\n")
    world.write_readme()
    rows = read_json(world.ledger)
    write_pages(rows, world.ledger.with_suffix(".md"), world.published)
    write_list(root / "docs", rows)
    world.begin()
    return world


if __name__ == "__main__":
    main()
