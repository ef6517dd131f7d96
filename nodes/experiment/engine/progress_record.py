"""Progress of a running experiment, stored in ``progress.json`` of its run folder for the experiment page.

The file is replaced as a whole, so that a reader always finds a complete one, and at most twice a second. It belongs to no
stage: no key depends on it. An error while writing ends the record but not the experiment.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from nodes.runtime.progress import MeasuringReport, Point

if TYPE_CHECKING:  # the page's server reads records without importing the searches
    from nodes.experiment.plan.cell import Cell

FILE, FORMAT = "progress.json", "advnerf-progress-1"
State = Literal["waiting", "running", "done", "reused", "failed"]
_PERIOD_S = 0.5
_LINES, _POINTS = 200, 2000


@dataclass
class Part:
    """One stage or cell of an experiment.

    Attributes:
        text: The current step, or why it failed.
        fraction: Finished share, 0..1.
        first_fraction: Share that was finished at the start, if it was resumed.
        began_s: Time of the start [s since 1970]; 0 before.
        seconds: Duration [s]; 0 until it is finished.
    """

    name: str
    state: State = "waiting"
    text: str = ""
    fraction: float = 0.0
    first_fraction: float = 0.0
    began_s: float = 0.0
    seconds: float = 0.0


class ProgressRecord:
    """Implements `nodes.runtime.progress.StageDisplay`.

    Args:
        folder: The run folder. Curves of an earlier run there are continued.
        about: Description of the experiment for the page, as JSON data.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        self._file, self._about = folder / FILE, dict(about)
        self._began_s, self._ended_s, self._failure = time.time(), 0.0, ""
        self._parts: dict[str, Part] = {}
        self._stages: list[str] = []
        self._cells: list[Cell] = []
        self._curves: dict[str, dict[str, list[list[float]]]] = read_progress(folder).get("curves", {})
        self._log: list[tuple[float, str]] = []
        self._lock = threading.Lock()
        self._written_s, self._broken = 0.0, False

    def plan(self, stages: Sequence[str], cells: Sequence[Cell]) -> None:
        """Set the parts to run, in order."""
        with self._lock:
            self._stages, self._cells = list(stages), list(cells)
            names = [*stages, *(cell.name for cell in cells)]
            self._parts = {name: self._parts.get(name, Part(name)) for name in names}
        self._write(now=True)

    def start(self, stage: str) -> MeasuringReport:
        """Note that a stage or a cell has begun, and return its progress callback."""
        with self._lock:
            self._parts[stage] = Part(stage, "running", began_s=time.time())
        self.say(f"{stage}: started")

        def report(fraction: float, text: str = "", point: Point | None = None) -> None:
            self._report(stage, fraction, text, point)

        return report

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """Note that a stage or a cell is finished, or that its earlier result is reused."""
        with self._lock:
            part = self._parts.setdefault(stage, Part(stage))
            part.state, part.fraction, part.seconds = "reused" if cached else "done", 1.0, seconds
            part.text = ""
        self.say(f"{stage}: {'unchanged, reused' if cached else f'done in {seconds:.1f} s'}")

    def fail(self, name: str, reason: str) -> None:
        """Note that a stage or a cell failed."""
        with self._lock:
            part = self._parts.setdefault(name, Part(name))
            part.state, part.text = "failed", reason
            part.seconds = time.time() - part.began_s if part.began_s else 0.0
        self.say(f"{name}: failed: {reason}")

    def say(self, line: str) -> None:
        """Add a line to the log."""
        with self._lock:
            self._log = [*self._log, (round(time.time(), 1), line)][-_LINES:]
        self._write(now=True)

    def end(self, failure: str = "") -> None:
        """Note that the experiment has ended, with its error if any, which belongs to the running part."""
        running = [part.name for part in self._parts.values() if part.state == "running"]
        for name in running if failure else ():
            self.fail(name, failure)
        with self._lock:
            self._ended_s, self._failure = time.time(), failure
        self._write(now=True)

    def _report(self, stage: str, fraction: float, text: str, point: Point | None) -> None:
        with self._lock:
            part, fraction = self._parts[stage], min(max(fraction, 0.0), 1.0)
            if not part.text and part.fraction == 0.0:
                part.first_fraction = fraction if fraction < 1.0 else 0.0
            part.fraction, part.text = fraction, text or part.text
            if point is not None:
                self._add(stage, point)
        self._write()

    def _add(self, stage: str, point: Point) -> None:
        if not isfinite(point.value):
            return
        curve = self._curves.setdefault(stage, {}).setdefault(point.curve, [])
        # A stage that restarts, or resumes from a checkpoint, repeats steps.
        while curve and curve[-1][0] >= point.step:
            curve.pop()
        curve.append([round(point.step, 3), round(point.value, 4)])
        if len(curve) > _POINTS:
            del curve[1:-1:2]

    def _write(self, now: bool = False) -> None:
        with self._lock:
            if self._broken or (not now and time.monotonic() - self._written_s < _PERIOD_S):
                return
            self._written_s = time.monotonic()
            data = {
                "format": FORMAT,
                **self._about,
                "began_s": self._began_s,
                "ended_s": self._ended_s,
                "failure": self._failure,
                "stages": self._stages,
                "cells": [
                    asdict(cell) | {"name": cell.name, "searched": cell.searched} for cell in self._cells
                ],
                "parts": {name: asdict(part) for name, part in self._parts.items()},
                "curves": self._curves,
                "log": self._log,
            }
            try:
                # Not waited for: the record may be lost in a power cut, and must not slow the experiment.
                write_atomically(self._file, json.dumps(data) + "\n", synced=False)
            except OSError:
                self._broken = True


def read_progress(folder: Path) -> dict[str, Any]:
    """The record in a run folder; empty if it is missing or unreadable."""
    try:
        data = read_json(folder / FILE)
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) and data.get("format") == FORMAT else {}
