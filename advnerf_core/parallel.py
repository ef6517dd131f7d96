"""Threads for CPU kernels: numba functions that release the GIL, run over fixed slots of the work.

Why not numba's own ``parallel=True``: it compiles several times slower (the demo counts compilation), its work queue may not be
entered from two Python threads, and its pool does not survive a fork. Slots are fixed by the caller, not by the number of
threads, so sums taken per slot and added in slot order give the same bits on every machine.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from advnerf_core.kernel_cache import use_own_folder

use_own_folder()

# Kernels may reorder and contract float sums, but must honour NaN and infinity: trainers test for them. They are inlined where they are called:
# of a function that several kernels contain, the process would use the copy that was loaded first, and copies differ in their rounding.
KERNEL_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "fastmath": {"reassoc", "contract", "nsz", "arcp", "afn"},
    "error_model": "numpy",
    "boundscheck": False,
    "forceinline": True,
}

T = TypeVar("T")
U = TypeVar("U")

SLOTS = 8  # parts of the work; fixed, so that sums over slots do not depend on the number of threads

_pools: dict[
    tuple[int, int], ThreadPoolExecutor
] = {}  # by process and size: a forked child must not reuse its parent's
_threads = 0
_scratch = threading.local()


def thread_count() -> int:
    """Number of threads for kernels: the processors available to this process, unless set."""
    return _threads or len(os.sched_getaffinity(0))


def set_thread_count(threads: int) -> None:
    """Set the number of threads for kernels; 0 restores all available processors."""
    if threads < 0:
        raise ValueError(f"expected a number of threads >= 0, got {threads}")
    global _threads
    _threads = threads


def run_slots(function: Callable[[int], object], slots: int) -> None:
    """Call ``function(slot)`` for each of ``slots`` slots, on all threads; free threads take the next slot.

    Args:
        function: Does the work of one slot; must write only data of that slot, and release the GIL to gain anything.
    """
    threads = min(thread_count(), slots)
    if threads <= 1:
        for slot in range(slots):
            function(slot)
        return
    counter = itertools.count()

    def worker() -> None:
        for slot in counter:
            if slot >= slots:
                return
            function(slot)

    pool = _pool(threads - 1)
    futures = [pool.submit(worker) for _ in range(threads - 1)]
    worker()
    for future in futures:
        future.result()


@dataclass(frozen=True)
class Work(Generic[T]):
    """A computation in independent parts.

    Attributes:
        parts: Callables that do the work; each obeys the rules of a slot of `run_slots`.
        result: Returns the result, once all parts have run.
    """

    parts: Sequence[Callable[[], object]]
    result: Callable[[], T]

    def run(self) -> T:
        """Run the parts on all threads, in their order."""
        run_slots(lambda slot: self.parts[slot](), len(self.parts))
        return self.result()


def beside(first: Work[T], second: Work[U]) -> Work[tuple[T, U]]:
    """Both works as one: threads without a part of the first continue with the second."""
    return Work([*first.parts, *second.parts], lambda: (first.result(), second.result()))


def slot_bounds(count: int, slots: int, multiple: int = 1) -> list[tuple[int, int]]:
    """Split ``range(count)`` into ``slots`` contiguous parts ``(start, stop)`` whose starts are multiples of ``multiple``."""
    blocks = -(-count // multiple)
    edges = [min(count, (blocks * slot // slots) * multiple) for slot in range(slots + 1)]
    edges[-1] = count
    return list(itertools.pairwise(edges))


def scratch(use: str, count: int, dtype: Any) -> NDArray[Any]:
    """An array ``[>= count]`` of this thread for one use: zeros at first, then with the content of the last call for that use."""
    kept: dict[tuple[str, str], NDArray[Any]] = _scratch.__dict__.setdefault("arrays", {})
    key = use, np.dtype(dtype).char
    if key not in kept or len(kept[key]) < count:
        kept[key] = np.zeros(count, dtype)
    return kept[key]


def _pool(size: int) -> ThreadPoolExecutor:
    key = (os.getpid(), size)
    if key not in _pools:
        _pools[key] = ThreadPoolExecutor(size, thread_name_prefix="advnerf-kernel")
    return _pools[key]
