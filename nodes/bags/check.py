"""Is a file of a bag whole, checked, and would a repair be right? Every byte of it is read for the answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nodes.bags.damage import describe
from nodes.bags.formats import Format, no_checksums, recognise
from nodes.bags.repair import being_written, examine, refusal_of
from nodes.runtime.errors import BagError

_MOST_LINES = 20


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a file.

    Attributes:
        path: The file.
        whole: Nothing is.
        unchecked: Why messages may have changed without a sign of it; empty where checksums cover them.
        lines: What is wrong, and what to do, in words; empty for a whole file.
    """

    path: Path
    whole: bool
    unchecked: str
    lines: tuple[str, ...]


def diagnose(path: Path) -> Diagnosis:
    """Read a file from its beginning to its end, and say what is wrong with it.

    Raises:
        BagError: It is no bag, or is packed in a way that is not known here.
    """
    if (form := recognise(path)) is not Format.MCAP:
        return Diagnosis(path, True, no_checksums(form), ())
    if being_written(path):
        raise BagError(f"{path} is being written at this moment; stop its recorder, then it has an end")
    scan = examine(path)
    if scan.whole:
        return Diagnosis(path, True, scan.unchecked, ())
    lines = [describe(scan, loss) for loss in scan.losses]
    if len(lines) > _MOST_LINES:
        lines = [*lines[:_MOST_LINES], f"and {len(lines) - _MOST_LINES} more places"]
    lines += scan.fixes
    if scan.summary_damage:
        lines.append(scan.summary_damage)
    if scan.data_crc_wrong:
        lines.append("the checksum of all its data is that of other data")
    if refusal := refusal_of(scan):
        lines.append(f"{refusal}")
        lines.append(
            f"only advnerf bag repair --force {path} goes on all the same: it keeps {scan.messages} messages, and the file as it is beside it"
        )
    else:
        cut = sum(loss.length for loss in scan.losses)
        lost = f"and leaves out {cut} bytes at its end" if cut else "and loses nothing"
        lines.append(f"advnerf bag repair {path} keeps all {scan.messages} messages that are whole, {lost}")
    return Diagnosis(path, False, scan.unchecked, tuple(lines))
