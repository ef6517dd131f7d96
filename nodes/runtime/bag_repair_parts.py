"""Make a bag of several parts whole: every part by itself, then ``metadata.yaml``, which lists them all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader

from advnerf_core.files import write_atomically
from nodes.runtime.bag_file import open_bag
from nodes.runtime.bag_metadata import Contents, FileEntry, rosbag2_metadata
from nodes.runtime.bag_parts import METADATA_FILE, bag_parts, listed_files
from nodes.runtime.bag_repair import Repaired, repair
from nodes.runtime.errors import BagError


def repair_bag(bag: Path, repair_file: Callable[[Path], Repaired] = repair) -> list[Repaired]:
    """Make every part of a bag whole.

    Args:
        bag: Bag folder or any of its files.
        repair_file: Repairs one file.

    Returns:
        What was done to each part, in order.

    Raises:
        BagError: A part cannot be repaired, or is missing.
    """
    parts = bag_parts(bag)
    folder = parts[0].parent
    repaired = [repair_file(part) for part in parts]
    _remove_what_was_begun(folder)
    if len(parts) > 1 and listed_files(folder) != tuple(part.name for part in parts):
        _list(folder, parts)
    return repaired


def _remove_what_was_begun(folder: Path) -> None:
    """A part that the recorder was about to begin when it was killed; it has no message."""
    for begun in folder.glob(".*.mcap.opening"):
        begun.unlink()
    for journal in folder.glob(".*.mcap.journal"):
        if not (folder / journal.name[1:].removesuffix(".journal")).exists():
            journal.unlink()


def _list(folder: Path, parts: tuple[Path, ...]) -> None:
    total, files = Contents(), []
    for part in parts:
        contents = _contents(part)
        total.add(contents)
        files.append(FileEntry.of(part.name, contents))
    write_atomically(folder / METADATA_FILE, rosbag2_metadata("", total, files))


def _contents(part: Path) -> Contents:
    """What the summary of a whole file says."""
    with open_bag(part) as file:
        summary = make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise BagError(f"{part}: expected a summary with statistics after the repair, got none; repair it again")
    statistics = summary.statistics
    contents = Contents(start_ns=statistics.message_start_time, end_ns=statistics.message_end_time)
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        contents.add_topic(
            channel.topic, "" if schema is None else schema.name, channel.metadata.get("topic_type_hash", "")
        )
        contents.counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
    return contents
