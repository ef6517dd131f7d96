"""Had the processors time to spare while something happened? The kernel's own count, for all processes and the host together."""

from __future__ import annotations

import os
from pathlib import Path

_STAT = Path("/proc/stat")
# A host that withholds this share stops a machine for tenths of a second; so little is left by what needs more than there is.
_STOLEN_SHARE, _SPARE_SHARE = 0.01, 0.25
_NICE, _IDLE, _IOWAIT, _STEAL, _FIELDS = 1, 3, 4, 7, 8


class Shortage:
    """Looks from its making on.

    Args:
        stat: The kernel's count.
    """

    def __init__(self, stat: Path = _STAT) -> None:
        self._stat = stat
        self._before = self._now()

    def found(self) -> str:
        """Why processes may have been late since; empty if the processors had time to spare."""
        spent = [after - before for after, before in zip(self._now(), self._before, strict=True)]
        total = max(1, sum(spent))
        # Processes that are nice give way at once.
        spare, stolen = (spent[_NICE] + spent[_IDLE] + spent[_IOWAIT]) / total, spent[_STEAL] / total
        if stolen >= _STOLEN_SHARE:
            return f"the host withheld {stolen:.0%} of the processors"
        return f"the processors had {spare:.0%} of their time to spare" if spare < _SPARE_SHARE else ""

    def _now(self) -> list[int]:
        """Time of each kind of the processors that this process may use, since the start of the machine [jiffies]."""
        ours = {f"cpu{number}" for number in os.sched_getaffinity(0)}
        lines = [line.split() for line in self._stat.read_text(encoding="ascii").splitlines()]
        counts = [list(map(int, words[1 : _FIELDS + 1])) for words in lines if words[0] in ours]
        return [sum(column) for column in zip(*counts, strict=True)]
