"""Estimates the remaining time of an experiment from the time its parts took. Times come as arguments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# Below this fraction, progress is no measure of the speed.
_TOO_EARLY = 0.02
_REPORT = "report"


def part_left_s(part: Mapping[str, Any], now_s: float) -> float | None:
    """Remaining time of a running part [s]; None if it is too early to tell."""
    done = part["fraction"] - part["first_fraction"]
    if part["state"] != "running" or done < _TOO_EARLY:
        return None
    return float((now_s - part["began_s"]) * (1.0 - part["fraction"]) / done)


def all_left_s(
    stages: Sequence[Mapping[str, Any]], cells: Sequence[Mapping[str, Any]], now_s: float
) -> tuple[float, bool]:
    """Remaining time of all parts [s], and whether it is complete.

    A waiting cell takes as long as finished cells of its kind, a search or a control, did on average. A waiting stage is not
    known. The report is left out: it takes seconds.
    """
    left_s, known = 0.0, True
    for part in stages:
        if part["name"] != _REPORT and part["state"] in ("waiting", "running"):
            own_s = part_left_s(part, now_s)
            known, left_s = known and own_s is not None, left_s + (own_s or 0.0)
    usual_s = {searched: _mean_s(cells, searched) for searched in (True, False)}
    cells_s = 0.0
    for part in cells:
        own_s = _cell_left_s(part, usual_s[part["searched"]], now_s)
        known, cells_s = known and own_s is not None, cells_s + (own_s or 0.0)
    at_a_time = max(1, sum(part["state"] == "running" for part in cells))
    return left_s + cells_s / at_a_time, known


def _cell_left_s(part: Mapping[str, Any], usual_s: float | None, now_s: float) -> float | None:
    if part["state"] not in ("waiting", "running"):
        return 0.0
    own_s = part_left_s(part, now_s)
    if own_s is None and usual_s is not None and part["state"] == "running":
        return max(0.0, usual_s - (now_s - part["began_s"]))
    return usual_s if own_s is None else own_s


def _mean_s(cells: Iterable[Mapping[str, Any]], searched: bool) -> float | None:
    seconds = [
        part["seconds"]
        for part in cells
        if part["searched"] == searched and part["state"] in ("done", "reused") and part["seconds"]
    ]
    return sum(seconds) / len(seconds) if seconds else None
