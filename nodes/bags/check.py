"""Diagnoses a file of a bag: whether it is intact, and can be repaired. The whole file is read."""

from __future__ import annotations

from pathlib import Path

from nodes.bags.formats import BagFormat, recognise
from nodes.bags.repair import being_written, examine, refusal_of
from nodes.runtime.errors import BagError

_MOST_LINES = 20


def diagnose(path: Path) -> list[str]:
    """Read a whole file and report its damage and what to do, a line each; no lines for an intact file.

    Raises:
        BagError: The file is not a bag, or its compression is unknown.
    """
    if recognise(path) is not BagFormat.MCAP:  # which has no checksums to verify
        return []
    if being_written(path):
        raise BagError(f"{path} is being written at this moment; stop its recorder first")
    scan = examine(path)
    if scan.whole:
        return []
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
    return lines
