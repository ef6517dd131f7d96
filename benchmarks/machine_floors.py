"""What this machine can do at most: bandwidth of memory in a row and at random, and multiply-adds, through the same kernels' compiler.

All rates are of numba code on the threads that our kernels use. Nothing here is a data sheet's figure: a loop of ours cannot be faster
than these loops, which do one thing only.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import run_slots, set_thread_count, slot_bounds, thread_count

Array32 = NDArray[np.float32]
Measured = TypeVar("Measured")

LINE_BYTES = 64
_LINE_FLOATS = 16
_CHAIN = 16  # multiply-adds on each value of the arithmetic loop
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False}
_CONTRACT = {**_OPTIONS, "fastmath": {"contract"}}


@dataclass(frozen=True)
class Floors:
    """Rates of this machine.

    Attributes:
        stream_bps: Triad ``a = b + s c`` over arrays beyond the cache [bytes/s], 12 bytes counted for each element.
        flops: float32 multiply-adds, two operations each [1/s].
        line_s: Time of a line of 64 bytes read at random, by the bytes of the table it lies in [s]; reads do not wait for each other.
    """

    stream_bps: float
    flops: float
    line_s: dict[int, float]

    def line_of(self, table_bytes: int) -> float:
        """Time of a random line of a table [s]: that of the largest measured table that is no larger."""
        fitting = [size for size in self.line_s if size <= table_bytes]
        return self.line_s[max(fitting) if fitting else min(self.line_s)]


@njit(**_CONTRACT)
def _triad(a: Array32, b: Array32, c: Array32, s: np.float32, first: int, stop: int) -> None:
    for n in range(first, stop):
        a[n] = b[n] + s * c[n]


@njit(**_CONTRACT)
def _multiply_add(x: Array32, a: np.float32, b: np.float32, rounds: int) -> None:
    for _ in range(rounds):
        for n in range(x.shape[0]):
            v = x[n]
            # Written out: a loop inside would keep the outer one from being vectorised.
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            v = v * a + b
            x[n] = v


@njit(**_OPTIONS)
def _gather(table: Array32, rows: NDArray[np.uint32], first: int, stop: int) -> np.float32:
    """Sum of one value of each of the lines ``rows[first:stop]``; four sums, so that adding is not what is measured."""
    s0, s1, s2, s3 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for n in range(first, stop - 3, 4):
        s0 += table[rows[n], 0]
        s1 += table[rows[n + 1], 0]
        s2 += table[rows[n + 2], 0]
        s3 += table[rows[n + 3], 0]
    return s0 + s1 + s2 + s3


@njit(**_OPTIONS)
def _chase(following: NDArray[np.uint32], start: np.uint32, hops: int) -> np.uint32:
    at = start
    for _ in range(hops):
        at = following[at, 0]
    return at


def stream_bps(megabytes: int, repeats: int) -> float:
    """Bytes a second of a triad over three arrays of so many megabytes each."""
    count = megabytes * (1 << 20) // 4
    a, b, c = (np.full(count, value, np.float32) for value in (0.0, 1.0, 2.0))
    bounds = slot_bounds(count, 2 * thread_count(), _LINE_FLOATS)
    s = np.float32(3.0)
    return (
        12.0
        * count
        / _least_s(lambda: run_slots(lambda slot: _triad(a, b, c, s, *bounds[slot]), len(bounds)), repeats)
    )


def multiply_adds(repeats: int, rounds: int = 20_000) -> float:
    """Float operations a second on values that stay in the first-level cache."""
    slots = thread_count()
    values = [np.ones(1024, np.float32) for _ in range(slots)]
    a, b = np.float32(0.999), np.float32(0.001)
    seconds = _least_s(
        lambda: run_slots(lambda slot: _multiply_add(values[slot], a, b, rounds), slots), repeats
    )
    return 2.0 * _CHAIN * rounds * 1024 * slots / seconds


def line_s(table_bytes: int, repeats: int, reads: int = 1 << 20) -> float:
    """Time of a line read at random from a table of so many bytes, on all threads together [s]."""
    lines = max(table_bytes // LINE_BYTES, 1)
    table = np.zeros((lines, _LINE_FLOATS), np.float32)
    table[:] = 1.0  # pages of zeros would all be one page
    rows = np.random.default_rng(0).integers(0, lines, reads).astype(np.uint32)
    bounds = slot_bounds(reads, 2 * thread_count(), 4)
    return (
        _least_s(lambda: run_slots(lambda slot: _gather(table, rows, *bounds[slot]), len(bounds)), repeats)
        / reads
    )


def latency_s(table_bytes: int, repeats: int, hops: int = 1 << 18) -> float:
    """Time of a line whose address the line before tells, so that reads wait for each other [s]; one thread."""
    lines = table_bytes // LINE_BYTES
    order = np.random.default_rng(0).permutation(lines).astype(np.uint32)
    following = np.zeros((lines, _LINE_FLOATS), np.uint32)
    following[order, 0] = np.roll(order, -1)
    start = np.uint32(order[0])
    return _least_s(lambda: _chase(following, start, hops), repeats) / hops


def measure(table_sizes: tuple[int, ...], megabytes: int, repeats: int) -> Floors:
    """The rates on all threads.

    Args:
        table_sizes: Tables for random lines [bytes].
        megabytes: Size of each array of the triad, beyond the cache.
        repeats: Timed runs; the shortest counts, as a floor is what was possible.
    """
    lines = {size: line_s(size, repeats) for size in sorted(table_sizes)}
    return Floors(stream_bps(megabytes, repeats), multiply_adds(repeats), lines)


def of_one_thread(work: Callable[[], Measured]) -> Measured:
    """The same with one thread."""
    before = thread_count()
    set_thread_count(1)
    try:
        return work()
    finally:
        set_thread_count(before)


def _least_s(work: Callable[[], object], repeats: int) -> float:
    """Seconds of the shortest of some runs, after one that does not count."""
    taken = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return min(taken[1:])
