"""Repairs a bag of several parts: each part separately, then ``metadata.yaml``, which lists all parts."""

from __future__ import annotations

import os
from pathlib import Path

from advnerf_core.files import write_atomically
from nodes.bags.metadata import Contents, rosbag2_metadata
from nodes.bags.parts import METADATA_FILE, bag_parts, listed_files
from nodes.bags.repair import Repaired, kept_names, repair
from nodes.bags.whole import read_summary
from nodes.runtime.errors import BagError


def repair_bag(
    bag: Path, force: bool = False, keep_original: bool = True, in_place: bool = False
) -> list[Repaired]:
    """Repair every part of a bag.

    Args:
        bag: Bag folder or any of its files.
        force: See `nodes.bags.repair.repair`.
        keep_original: Keep copies of the damaged parts and of ``metadata.yaml``.
        in_place: See `nodes.bags.repair.repair`.

    Returns:
        The result of each part, in order.

    Raises:
        BagError: A part cannot be repaired, or is missing.
    """
    parts = bag_parts(bag)
    folder = parts[0].parent
    repaired = [repair(part, force, keep_original, in_place) for part in parts]
    _remove_what_was_begun(folder)
    names, listed = tuple(part.name for part in parts), listed_files(folder)
    if len(parts) > 1 and listed != names:
        _list(folder, parts, listed != () and keep_original)
    elif listed == names and any(not part.was_whole for part in repaired):
        _list(folder, parts, keep_original)  # its counts are outdated
    return repaired


def _remove_what_was_begun(folder: Path) -> None:
    """Remove a part that the recorder had just opened when it was killed. It has no messages."""
    for begun in folder.glob(".*.mcap.opening"):
        begun.unlink()
    for journal in folder.glob(".*.mcap.journal"):
        if not (folder / journal.name[1:].removesuffix(".journal")).exists():
            journal.unlink()


def _list(folder: Path, parts: tuple[Path, ...], keep_old: bool) -> None:
    """Write ``metadata.yaml`` from the repaired parts."""
    files = {part.name: _contents(part) for part in parts}
    file = folder / METADATA_FILE
    if keep_old:
        os.link(file, next(name for name in kept_names(file) if not os.path.lexists(name)))
    write_atomically(file, rosbag2_metadata(files))


def _contents(part: Path) -> Contents:
    """Contents of an intact file according to its summary."""
    summary = read_summary(part)
    if summary is None:
        raise BagError(
            f"{part}: expected a summary with statistics after the repair, got none; repair it again"
        )
    statistics = summary.statistics
    span_ns = statistics.message_start_time, statistics.message_end_time
    return Contents.of(summary.channels, summary.schemas, statistics.channel_message_counts, span_ns)
