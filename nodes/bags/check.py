"""Diagnoses a file of a bag: whether it is intact, has checksums, and can be repaired. The whole file is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nodes.bags.formats import BagFormat, no_checksums, recognise
from nodes.bags.repair import being_written, examine, refusal_of
from nodes.runtime.errors import BagError

_MOST_LINES = 20


@dataclass(frozen=True)
class Diagnosis:
    """Damage of a file.

    Attributes:
        path: The file.
        whole: Whether the file is intact.
        unchecked: Why damage to messages may go unnoticed; empty if checksums cover them.
        lines: The damage and what to do, as text; empty for an intact file.
    """

    path: Path
    whole: bool
    unchecked: str
    lines: tuple[str, ...]


def diagnose(path: Path) -> Diagnosis:
    """Read a whole file and report its damage.

    Raises:
        BagError: The file is not a bag, or its compression is unknown.
    """
    if (form := recognise(path)) is not BagFormat.MCAP:
        return Diagnosis(path, True, no_checksums(form), ())
    if being_written(path):
        raise BagError(f"{path} is being written at this moment; stop its recorder first")
    scan = examine(path)
    if scan.whole:
        return Diagnosis(path, True, scan.unchecked, ())
    lines = [scan.describe(loss) for loss in scan.losses]
    if len(lines) > _MOST_LINES:
        lines = [*lines[:_MOST_LINES], f"and {len(lines) - _MOST_LINES} more places"]
    lines += scan.fixes
    if scan.summary_damage:
        lines.append(scan.summary_damage)
    if scan.data_crc_wrong:
        lines.append("the checksum of all its data is wrong")
    if refusal := refusal_of(scan):
        lines.append(f"{refusal}")
        lines.append(
            f"only advnerf bag repair --force {path} repairs it anyway: it keeps {scan.messages} messages, and a copy of the damaged file"
        )
    else:
        cut = sum(loss.length for loss in scan.losses)
        lost = f"and drops {cut} bytes at its end" if cut else "and loses nothing"
        lines.append(f"advnerf bag repair {path} keeps all {scan.messages} intact messages, {lost}")
    return Diagnosis(path, False, scan.unchecked, tuple(lines))
