"""Progress of each cell of a run folder, read from its files: also of cells that other processes run."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json

# Clocks of a file system and of this computer may differ by this much.
_SLACK_S = 1.0
_LOG_BYTES = 2000


def cell_part(
    folder: Path, cell: Mapping[str, Any], part: Mapping[str, Any], began_s: float
) -> dict[str, Any]:
    """State of a cell: the record's, unless the cell's files in the folder of cells are newer.

    Args:
        cell: The cell's entry in the record.
        part: The cell's progress in the record.
        began_s: When the experiment was started [s since 1970]; older files are of an earlier run.
    """
    name, work = cell["name"], folder / cell["name"]
    result = result_of(folder, name)
    found = {**part, "kind": "cell", "searched": cell["searched"], **result}
    found["seconds"] = part["seconds"] or result.get("seconds", 0.0)
    begun_s, since_s = _changed_s(work / "key.json"), began_s - _SLACK_S
    if part["state"] in ("done", "reused", "failed") or max(begun_s, part["began_s"]) < since_s:
        return found
    error = _error(work / "error.json")
    if error and _changed_s(work / "error.json") >= since_s:
        return {**found, "state": "failed", "text": error}
    if part["state"] == "running" or not begun_s:
        return found
    if _changed_s(folder / f"{name}.json") >= begun_s:
        return {**found, "state": "done", "text": "", "fraction": 1.0}
    fraction, text = _logged(work / "log.txt")
    return {**found, "state": "running", "began_s": begun_s, "fraction": fraction, "text": text}


def result_of(folder: Path, name: str) -> dict[str, Any]:
    """Seconds of a finished cell and its measured values; empty without a result."""
    file = folder / f"{name}.json"
    try:
        return dict(_result(file, file.stat().st_mtime_ns))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


@lru_cache(maxsize=512)
def _result(file: Path, changed_ns: int) -> Mapping[str, Any]:
    del changed_ns  # a changed file is another entry of the cache
    data = read_json(file)
    measured = {
        domain: [round(_mean(data[domain][key]), 2) for key in ("total_cte_m", "none_total_cte_m")]
        for domain in ("surrogate", "deployed")
        if data.get(domain)
    }
    return {"seconds": float(data["seconds"]), "measured": measured}


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _error(file: Path) -> str:
    try:
        return str(read_json(file)["error"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _changed_s(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0


def _logged(file: Path) -> tuple[float, str]:
    """Fraction and text of the last line of a worker's log, e.g. ``37 % 11/30, total CTE 4.2 m``."""
    try:
        with file.open("rb") as stream:
            stream.seek(max(0, file.stat().st_size - _LOG_BYTES))
            line = stream.read().decode("utf-8", "replace").strip().splitlines()[-1]
        percent, _, text = line.partition(" % ")
        return float(percent) / 100.0, text
    except (OSError, ValueError, IndexError):
        return 0.0, ""
