"""How benchmarks compare two or more ways: one rule for every side.

All ways run in one process, in turns, equally often, after one run of each that does not count. The figure of a way is the median
of its runs. A best-of rule favours the side that is run more often; runs in turns let other load on the machine hit all sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median

import psutil


def runs_in_turns(ways: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Seconds of ``repeats`` runs of each way, taken in turns after one run of each that does not count."""
    if repeats < 1:
        raise ValueError(f"expected at least one repeat, got {repeats}")
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(repeats + 1):
        for name, way in ways.items():
            began = time.perf_counter()
            way()
            if turn:
                taken[name].append(time.perf_counter() - began)
    return taken


def seconds_in_turns(ways: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each way; see `runs_in_turns`."""
    return {name: median(parts) for name, parts in runs_in_turns(ways, repeats).items()}


class ProcessorUse:
    """Counts from now on how many processors this process keeps busy, and how many other programs do.

    A training that ends by time learns less where others hold its processors; a row that has both figures shows that.
    """

    def __init__(self) -> None:
        self._began, self._own, self._all = time.monotonic(), time.process_time(), _busy_s()

    def text(self) -> str:
        """Describe the means since the start in words."""
        seconds = max(time.monotonic() - self._began, 1e-6)
        own = (time.process_time() - self._own) / seconds
        others = max(0.0, (_busy_s() - self._all) / seconds - own)
        return f"{own:.1f} processors busy with it and {others:.1f} with other programs"


def _busy_s() -> float:
    """Time that all processors of the machine have been busy [s]."""
    times = psutil.cpu_times()
    return float(times.user + times.nice + times.system)
