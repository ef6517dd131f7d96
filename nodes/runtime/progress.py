"""Progress of long jobs: bars with the remaining time on a terminal, occasional lines in a log."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import NamedTuple, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nodes.runtime.console import plain_console

LOG_PERIOD_S = 15.0


class Point(NamedTuple):
    """One value that a running stage measured, as a point of a curve.

    Attributes:
        curve: Name of the curve with its unit, e.g. ``PSNR on training rays [dB]``.
        step: Number of the step at which it was measured.
        value: The value, in the unit of the curve.
    """

    curve: str
    step: float
    value: float


class Report(Protocol):
    """Progress callback of one stage."""

    def __call__(self, fraction: float, text: str = "") -> None:
        """Report the finished fraction (0..1) and the current step."""


class MeasuringReport(Report, Protocol):
    """Progress callback of a stage that also measures something on its way."""

    def __call__(self, fraction: float, text: str = "", point: Point | None = None) -> None:
        """Report the finished fraction (0..1), the current step, and a value that was measured in it."""


def counted(report: Report, what: str, count: int, before: int, total: int) -> Callable[[int], None]:
    """Make a callback for a loop that reports how many of its ``count`` items are done, as one part of a stage.

    Args:
        what: Name of the part.
        count: Number of items of the part.
        before: Number of items of the stage before the part.
        total: Number of items of the whole stage.
    """
    return lambda done: report((before + done) / total, f"{what} {done}/{count}")


class StageDisplay(Protocol):
    """Shows the progress of stages to the user."""

    def start(self, stage: str) -> MeasuringReport:
        """Start a stage and return its progress callback."""

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """Finish a stage, or report that its earlier result is reused."""


class ProgressDisplay:
    """Implements `StageDisplay`.

    Args:
        console: Console to write to. A log file or pipe gets lines instead of bars.
        watcher: A second display that receives the same reports, such as the record of the experiment page.
    """

    def __init__(self, console: Console | None = None, watcher: StageDisplay | None = None) -> None:
        self._console, self._watcher = console or plain_console(), watcher
        columns = (
            TextColumn("{task.fields[stage]:<8}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}", markup=False),
        )
        self._progress = Progress(*columns, console=self._console) if self._console.is_terminal else None

    def __enter__(self) -> ProgressDisplay:
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.stop()

    def start(self, stage: str) -> MeasuringReport:
        """Start a stage and return its progress callback."""
        shown = self._shown(stage)
        watched = None if self._watcher is None else self._watcher.start(stage)

        def report(fraction: float, text: str = "", point: Point | None = None) -> None:
            shown(fraction, text)
            if watched is not None:
                watched(fraction, text, point)

        return report

    def _shown(self, stage: str) -> Report:
        if self._progress is None:
            self._console.print(f"{stage}: started", highlight=False, markup=False, soft_wrap=True)
            return _LogReport(self._console, stage)
        return _bar(self._progress, self._progress.add_task("", total=1.0, stage=stage, text=""))

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """Finish a stage, or report that its earlier result is reused."""
        text = "unchanged, reused" if cached else f"done in {seconds:.1f} s"
        self._console.print(f"{stage}: {text}", highlight=False, markup=False, soft_wrap=True)
        if self._watcher is not None:
            self._watcher.finish(stage, seconds, cached)


def _bar(progress: Progress, task: TaskID) -> Report:
    def report(fraction: float, text: str = "") -> None:
        progress.update(task, completed=min(max(fraction, 0.0), 1.0), text=text)

    return report


class _LogReport:
    def __init__(self, console: Console, stage: str) -> None:
        self._console, self._stage = console, stage
        self._begin_s = self._printed_s = time.monotonic()

    def __call__(self, fraction: float, text: str = "") -> None:
        now_s = time.monotonic()
        if now_s - self._printed_s < LOG_PERIOD_S:
            return
        self._printed_s = now_s
        left = (now_s - self._begin_s) * (1.0 / fraction - 1.0) if fraction > 0.01 else float("nan")
        remaining = "" if left != left else f", about {left:.0f} s left"
        self._console.print(
            f"{self._stage}: {100 * fraction:.0f} % {text}{remaining}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
