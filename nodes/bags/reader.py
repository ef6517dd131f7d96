"""Reads bags: their summary, attachments and messages."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

from mcap.records import Channel

from advnerf_core.files import is_plain_name, write_atomically
from nodes.bags.check import diagnose
from nodes.bags.chunks import (
    messages_in_order,
    read_attachment_at,
    read_metadata_at,
    time_spans,
    times_as_written,
)
from nodes.bags.file import open_bag
from nodes.bags.foreign import read_stored, stored_messages, stored_times
from nodes.bags.formats import BagFormat, recognise
from nodes.bags.info import BagInfo, BagMessage, FileInfo, TopicInfo
from nodes.bags.message_definitions import full_type_name
from nodes.bags.parts import bag_parts
from nodes.bags.stored_types import Convert, RecordedTopic, converter, unpacked
from nodes.bags.whole import FileSummary, read_summary
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.topics import type_of_topic

T = TypeVar("T")


def read_info(bag: Path) -> BagInfo:
    """Read the summary of a bag with all its parts."""
    parts = _parts(bag)
    filled = [part for part in parts if part.messages]
    topics: dict[str, TopicInfo] = {}
    for topic in (topic for part in parts for topic in part.topics):
        topics[topic.name] = _sum(topics[topic.name], topic) if topic.name in topics else topic
    return BagInfo(
        parts[0].path if len(parts) == 1 else parts[0].path.parent,
        tuple(part.path for part in parts),
        sum(part.size_bytes for part in parts),
        min((part.start_ns for part in filled), default=0),
        max((part.end_ns for part in filled), default=0),
        tuple(topics[name] for name in sorted(topics)),
        tuple(dict.fromkeys(name for part in parts for name in part.attachments)),
        next((part.metadata for part in parts if part.metadata), {}),
        next((part.unchecked for part in parts if part.unchecked), ""),
    )


def recorded_topics(bag: Path) -> dict[str, RecordedTopic]:
    """How the messages of each topic are stored, by its name."""
    return {topic.topic: topic for part in _parts(bag) for topic in part.recorded.values()}


def has_publish_times(bag: Path) -> bool:
    """Whether messages have publish times; other formats than MCAP store none, and log times stand for them."""
    return all(part.format is BagFormat.MCAP for part in _parts(bag))


def message_spans(bag: Path) -> list[tuple[int, int]]:
    """Spans of log time that cover all messages, from the index of the bag, as written [ns since 1970]."""
    spans: list[tuple[int, int]] = []
    for part in _parts(bag):
        if part.messages:
            whole = [(part.start_ns, part.end_ns)]
            spans += time_spans(_whole_file(part.path)) if part.format is BagFormat.MCAP else whole
    return spans


def read_times_as_written(bag: Path) -> Iterator[tuple[str, int]]:
    """Yield topic and log time [ns since 1970] of all messages as written. ROS 1 bags do not say that order: theirs are left out."""
    for part in _parts(bag):
        if part.format is BagFormat.MCAP:
            with open_bag(part.path) as file:
                yield from times_as_written(file, _whole_file(part.path))
        elif part.format is BagFormat.SQLITE:
            yield from stored_times(part.path)


def read_attachment(bag: Path, name: str) -> bytes:
    """Read the content of an attachment from the part that has it."""
    parts = _parts(bag)
    for part in parts:
        if name in part.attachments:
            return _attachments(part.path, [name])[name]
    names = [name for part in parts for name in part.attachments]
    raise BagError(f"{bag} has no attachment {name!r}; it has {', '.join(names) or 'none'}")


def read_attachments(bag: Path) -> dict[str, bytes]:
    """Read all attachments by name. Of two with the same name, the later is returned."""
    contents: dict[str, bytes] = {}
    for part in _parts(bag):
        if part.attachments:
            contents |= _attachments(part.path, part.attachments)
    return contents


def _attachments(path: Path, names: Sequence[str]) -> dict[str, bytes]:
    summary = _whole_file(path)
    with open_bag(path) as file:
        found = [
            read_attachment_at(file, index) for index in summary.attachment_indexes if index.name in names
        ]
    return {attachment.name: bytes(attachment.data) for attachment in found}


def extract_attachments(bag: Path, folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Write attachments to a folder.

    Args:
        bag: Bag folder or file.
        folder: Destination, which is created if needed. An existing file is an error and is never overwritten.
        names: Attachments to extract; none means all.
    """
    contents = read_attachments(bag)
    if unknown := [name for name in names if name not in contents]:
        raise BagError(
            f"{bag} has no attachment {', '.join(unknown)}; it has {', '.join(contents) or 'none'}"
        )
    targets = {name: Path(folder) / plain_name(bag, name) for name in names or contents}
    for target in targets.values():
        if target.exists():
            raise BagError(f"{target} exists; remove it or choose another folder with --output")
    for name, target in targets.items():
        write_atomically(target, contents[name])
    return list(targets.values())


def plain_name(bag: Path, name: str) -> str:
    """Check that the name of an attachment is a plain file name, so that a foreign bag cannot write to other folders."""
    if not is_plain_name(name):
        raise BagError(
            f"{bag}: expected attachments with plain file names, got {name!r}; it is not extracted"
        )
    return name


def read_messages(
    bag: Path,
    topics: Sequence[str] | None = None,
    start_offset_s: float = 0.0,
    types: Mapping[str, str] | None = None,
    as_recorded: bool = False,
) -> Iterator[BagMessage]:
    """Yield messages in order of their log time.

    Messages on topics of the topic table have the table's type. If a bag has another definition of the type, or an equivalent type
    (see `nodes.bags.stored_types`), they are converted.

    Args:
        bag: Bag folder or file.
        topics: Topics to read, which must be in the bag; None means all.
        start_offset_s: Time to skip at the beginning [s].
        types: Wanted types by topic. None uses the topic table's and does not convert other topics.
        as_recorded: Do not convert any message.

    Raises:
        BagError: The bag cannot be read, lacks a topic, or has a topic of a type that cannot be converted.
    """
    info = read_info(bag)
    path = info.path
    if info.unchecked:
        _say_unchecked(path, info.unchecked)
    known = [topic.name for topic in info.topics]
    for name in topics or ():
        if name not in known:
            raise BagError(f"{path} has no topic {name}; it has {', '.join(known)}")
    # Without an offset no message is skipped: the summary does not count log times of 0 as the start of a file.
    start_ns = info.start_ns + round(start_offset_s * NS_PER_S) if start_offset_s else 0
    if start_offset_s < 0 or start_ns > info.end_ns:
        raise BagError(
            f"expected a start offset between 0 and {info.duration_s:.1f} s, the length of {path}, got {start_offset_s}"
        )
    wanted = frozenset(topics or known)
    parts = [
        (part, {} if as_recorded else _converters(part, wanted, types or {}))
        for part in _parts(bag)
        if part.messages
        and part.end_ns >= start_ns
        and not wanted.isdisjoint(topic.name for topic in part.topics)
    ]
    timed = (
        _from_start(part, _messages_of(part, wanted, start_ns, converters)) for part, converters in parts
    )
    for _, message in merge(*timed, key=itemgetter(0)):
        if message is not None:
            yield message


def _from_start(part: FileInfo, messages: Iterator[BagMessage]) -> Iterator[tuple[int, BagMessage | None]]:
    """Yield the start of a file before its messages with their log times, so that a merge opens it only when its time has come."""
    yield part.start_ns, None
    for message in messages:
        yield message.log_ns, message


def _messages_of(
    part: FileInfo, topics: frozenset[str], start_ns: int, converters: Mapping[int, Convert]
) -> Iterator[BagMessage]:
    """Yield the messages of one file in order of their log time."""
    names = {number: recorded.topic for number, recorded in part.recorded.items() if recorded.topic in topics}
    for number, message in _stored(part, names, start_ns):
        data = unpacked(message.cdr, message.topic, str(part.path))
        if convert := converters.get(number):
            data = convert(data)
        yield message if data is message.cdr else replace(message, cdr=data)


def _stored(part: FileInfo, names: Mapping[int, str], start_ns: int) -> Iterator[tuple[int, BagMessage]]:
    """Yield number of the topic and message, as they are in the file."""
    if part.format is not BagFormat.MCAP:
        yield from stored_messages(part.path, part.format, names, start_ns)
        return
    summary = _whole_file(part.path)
    with open_bag(part.path) as file:
        yield from messages_in_order(file, summary, names, start_ns)


def require_readable(bag: Path, topics: Mapping[str, str]) -> None:
    """Refuse a bag with a topic that cannot be converted to the wanted type, given by topic."""
    for part in _parts(bag):
        _converters(part, frozenset(topics), topics)


def _converters(part: FileInfo, topics: frozenset[str], types: Mapping[str, str]) -> dict[int, Convert]:
    """Converters of a file's messages by the number of their topic; topics without conversion are missing."""
    found = {}
    for number, recorded in part.recorded.items():
        expected = types.get(recorded.topic) or type_of_topic(recorded.topic)
        if (
            recorded.topic in topics
            and expected
            and (convert := converter(recorded, expected, str(part.path)))
        ):
            found[number] = convert
    return found


def _count(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() else None


def _sum(one: TopicInfo, other: TopicInfo) -> TopicInfo:
    lost = None if one.lost is None or other.lost is None else one.lost + other.lost
    return TopicInfo(one.name, one.type or other.type, one.count + other.count, lost)


def _parts(bag: Path) -> list[FileInfo]:
    return [_finished(path, _part_of) for path in bag_parts(bag)]


@lru_cache(maxsize=1024)
def _part_of(path: Path, mtime_ns: int, size_bytes: int) -> FileInfo | None:
    form = recognise(path)
    if form is not BagFormat.MCAP:
        return read_stored(path, form, size_bytes)
    if (summary := _summary_of(path, mtime_ns, size_bytes)) is None:
        return None
    with open_bag(path) as file:
        notes = [read_metadata_at(file, index) for index in summary.metadata_indexes]
    records = {record.name: dict(record.metadata) for record in notes}
    ends, statistics = records.get("advnerf_end"), summary.statistics
    recorded = {channel.id: _recorded(summary, channel) for channel in summary.channels.values()}
    return FileInfo(
        path,
        form,
        size_bytes,
        statistics.message_start_time,
        statistics.message_end_time,
        statistics.message_count,
        tuple(
            TopicInfo(
                each.topic,
                each.type,
                statistics.channel_message_counts.get(number, 0),
                None if ends is None else _count(ends.get(f"lost {each.topic}", "0")),
            )
            for number, each in recorded.items()
        ),
        recorded,
        tuple(index.name for index in summary.attachment_indexes),
        records.get("advnerf", {}),
        summary.unchecked,
    )


def _recorded(summary: FileSummary, channel: Channel) -> RecordedTopic:
    schema = summary.schemas.get(channel.schema_id)
    return RecordedTopic(
        channel.topic,
        "" if schema is None else full_type_name(schema.name),
        channel.metadata.get("topic_type_hash", ""),
        "" if schema is None else schema.data.decode("utf-8", "replace"),
        "" if schema is None else schema.encoding,
        channel.message_encoding,
    )


def _whole_file(path: Path) -> FileSummary:
    return _finished(path, _summary_of)


@lru_cache(maxsize=1024)
def _say_unchecked(path: Path, reason: str) -> None:
    """Print once per bag that its numbers are unchecked."""
    print(f"{path}: unchecked: {reason}, so damage to it cannot be noticed", file=sys.stderr, flush=True)


def _finished(path: Path, read: Callable[[Path, int, int], T | None]) -> T:
    """Read a file as it is now, and once more if its recorder has finished it meanwhile.

    Raises:
        BagError: It is being written, or was left unfinished; with advice that depends on its contents.
    """
    for _ in range(2):
        state = path.stat()
        if (found := read(path, state.st_mtime_ns, state.st_size)) is not None:
            return found
        if lines := diagnose(path):
            break
    raise BagError(f"{path} is unfinished: its recorder was killed; {'; '.join(lines[-2:])}")


@lru_cache(maxsize=4)
def _summary_of(path: Path, mtime_ns: int, size_bytes: int) -> FileSummary | None:
    """Summary of a file, cached by time and size, because reading the summary of an hour takes a second."""
    del mtime_ns, size_bytes  # they are the state
    return read_summary(path)
