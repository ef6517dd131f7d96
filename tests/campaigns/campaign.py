"""How large a campaign is, and its rows.

A campaign tries again and again whether something holds. ``make campaign`` runs all of them in full and ``make campaign ONLY=fuzz``
one; what is finished is kept, and their rows are written. ``SIZE=20`` tries twenty times and ``SIZE=`` as often as takes a few minutes,
both in a folder that goes, without rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.results import record_row
from tests.support.live.processes import REPOSITORY

_FULL = "full"


@dataclass(frozen=True)
class Campaign:
    """One campaign.

    Attributes:
        name: Of its file, without ``test_``.
        asked: Its size: ``full``, a number, or empty.
        empty: An empty folder of this run.
    """

    name: str
    asked: str
    empty: Path

    @property
    def is_full(self) -> bool:
        """Whether its rows are written."""
        return self.asked == _FULL

    def size(self, small: int, full: int) -> int:
        """How often to try, where nothing is asked for and in full."""
        return full if self.is_full else int(self.asked or small)

    def folder(self, name: str) -> Path:
        """Where finished work is kept: below ``runs/`` in full."""
        return REPOSITORY / "runs" / name if self.is_full else self.empty / name

    def record(
        self, line: str, value: float | str, unit: str, target: str, met: bool | None, note: str = ""
    ) -> None:
        """Print a row, and write it where the campaign is full; see `benchmarks.results.record_row`."""
        print(f"{line}: {value} {unit}, expected {target}; {note}", flush=True)
        if self.is_full:
            record_row(line, value, unit, target, met, f"make campaign ONLY={self.name}", note)
