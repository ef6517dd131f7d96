"""How far are the main rates from what this machine allows? Measured times beside floors of memory and arithmetic, in one run.

First the machine: bandwidth in a row, lines of 64 bytes at random, and multiply-adds (`benchmarks.machine_floors`). Then the parts of a
tick of the surrogate, of a training step, and the hash encoding, each with what it must do at least (`benchmarks.least_work`). The scene
is the simulated lab, learned for a thousand steps.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import advnerf_core as advnerf_core  # isort: skip  # before torch, as in the commands
import torch

from advnerf_core.parallel import thread_count
from benchmarks import machine_floors
from benchmarks.floor_parts import WHOLE, WHOLE_TICKS, Part, encoding_parts, tick_parts, training_parts
from benchmarks.machine_floors import Floors, of_one_thread
from benchmarks.results import record_row
from benchmarks.timing import seconds_in_turns
from benchmarks.training_step import photograph_lab, prepare

COMMAND = "python -m benchmarks.floors"
UNIT = "x the floor"
_LARGE_BYTES = 1 << 28  # a table beyond the cache
_WHOLE_LINE, _WHOLE_WANTED = f"floor: {WHOLE}, 200x66, one 64^3 object", 2.0


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        points: Of the hash encoding.
        rays: Of the training step.
        steps: Steps of training before.
        photographs: Of the lab.
        resolution: Voxels along a side of the object.
        megabytes: Of each array of the triad.
        repeats: Timed runs of each part, in turns; medians count.
    """

    points: int = 1 << 17
    rays: int = 1024
    steps: int = 1000
    photographs: int = 80
    resolution: int = 64
    megabytes: int = 128
    repeats: int = 9


SMALL = Sizes(1 << 13, 256, 24, 6, 16, 4, 2)


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--small", action="store_true", help="tiny sizes, to check the command; not recorded")
    arguments = parser.parse_args()
    for line, value, unit, note in measure(SMALL if arguments.small else Sizes()):
        print(f"{line}: {value:.3g} {unit}; {note}", flush=True)
        if not arguments.small:
            wanted = _WHOLE_WANTED if line == _WHOLE_LINE else None
            target = "printed" if wanted is None else f"<= {wanted:g} x"
            record_row(line, value, unit, target, None if wanted is None else value <= wanted, COMMAND, note)


def measure(sizes: Sizes) -> list[tuple[str, float, str, str]]:
    """Rows: line, value, unit, note. The machine comes first."""
    images, field = photograph_lab(sizes.photographs)
    batch, stepper, _ = prepare(images, field, sizes.steps, sizes.rays)
    parts = [
        *tick_parts(batch, sizes.resolution),
        *training_parts(batch, stepper),
        *encoding_parts(17, sizes.points),
        *encoding_parts(19, sizes.points),
    ]
    tables = {table for part in parts for table in part.work.lines} | {_LARGE_BYTES}
    floors = machine_floors.measure(tuple(tables), sizes.megabytes, sizes.repeats)
    taken = seconds_in_turns({part.name: part.run for part in parts}, sizes.repeats)
    rows = [part_row(part, taken[part.name], floors) for part in parts if part.name != WHOLE]
    return [*machine_rows(floors, sizes), *rows, _whole_row(parts, taken, floors, sizes)]


def _whole_row(
    parts: list[Part], taken: dict[str, float], floors: Floors, sizes: Sizes
) -> tuple[str, float, str, str]:
    """A tick with its gradient against the policy's forward pass on one thread and the least work of what it renders."""
    policy = next(part for part in parts if part.name == "tick, policy")
    torch.set_num_threads(1)
    policy_s = seconds_in_turns({"policy": policy.run}, sizes.repeats)["policy"]
    torch.set_num_threads(thread_count())
    rendering = [
        part.work.floor_s(floors)[0] for part in parts if part.name.startswith("tick, ") and part != policy
    ]
    floor_s, tick_s = policy_s + sum(rendering), taken[WHOLE] / WHOLE_TICKS
    note = (
        f"{1e3 * tick_s:.3g} ms; {1e3 * floor_s:.3g} ms: the policy's forward pass on one thread {1e3 * policy_s:.3g} ms, the least work of "
        f"background, casting and composing {1e3 * sum(rendering):.3g} ms"
    )
    return _WHOLE_LINE, tick_s / floor_s, UNIT, note


def machine_rows(floors: Floors, sizes: Sizes) -> list[tuple[str, float, str, str]]:
    """What the machine can do, on all threads and on one."""
    one = of_one_thread(lambda: machine_floors.measure((_LARGE_BYTES,), sizes.megabytes, sizes.repeats))
    latency_ns = 1e9 * machine_floors.latency_s(_LARGE_BYTES, sizes.repeats)
    threads = f"shortest of {sizes.repeats} runs; {thread_count()} threads"
    rows = []
    for name, value, single, unit in (
        ("bandwidth in a row", floors.stream_bps / 1e9, one.stream_bps / 1e9, "GB/s"),
        (
            "lines of 64 bytes at random, table of 256 MiB",
            64e-9 / floors.line_of(_LARGE_BYTES),
            64e-9 / one.line_of(_LARGE_BYTES),
            "GB/s",
        ),
        ("multiply-adds in float32", floors.flops / 1e9, one.flops / 1e9, "GFLOP/s"),
    ):
        rows.append((f"machine: {name}", value, unit, f"{threads}; one thread {single:.3g} {unit}"))
    note = f"shortest of {sizes.repeats} runs; one thread, each read waits for the one before"
    return [*rows, ("machine: latency of a line, table of 256 MiB", latency_ns, "ns", note)]


def part_row(part: Part, seconds: float, floors: Floors) -> tuple[str, float, str, str]:
    """How far a part is from its floor. The note: time, floor, what bounds it, what was counted."""
    floor_s, bound = part.work.floor_s(floors)
    work = part.work
    note = (
        f"{1e3 * seconds:.3g} ms; {1e3 * floor_s:.3g} ms; {bound}; {work.streamed / 1e6:.4g} MB in a row, "
        f"{work.line_count / 1e3:.4g} k lines, {work.flops / 1e6:.4g} MFLOP"
    )
    return f"floor: {part.name}", seconds / floor_s, UNIT, note


if __name__ == "__main__":
    torch.set_num_threads(thread_count())
    main()
