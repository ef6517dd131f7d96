"""Look into bags and take messages out of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Statistics
from mcap.summary import Summary

from advnerf_core.files import write_atomically
from nodes.runtime.bag_chunks import messages_in_order
from nodes.runtime.bag_file import open_bag
from nodes.runtime.bag_repair import mcap_file, read_summary, type_of
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, TopicError
from nodes.runtime.messages import type_hash
from nodes.runtime.topics import topic as topic_row


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    Attributes:
        name: Topic.
        type: ROS 2 type.
        count: Messages.
        lost: Messages that were published but did not reach the recorder; None when the recorder did not say.
    """

    name: str
    type: str
    count: int
    lost: int | None


@dataclass(frozen=True)
class BagInfo:
    """What a bag holds; times are log times [ns since 1970]."""

    path: Path
    size_bytes: int
    start_ns: int
    end_ns: int
    topics: tuple[TopicInfo, ...]
    attachments: tuple[str, ...]
    metadata: dict[str, str]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.topics)


@dataclass(frozen=True)
class BagMessage:
    """One message of a bag."""

    topic: str
    cdr: bytes
    log_ns: int
    publish_ns: int
    sequence: int


def read_info(bag: Path) -> BagInfo:
    """Summary of a bag."""
    path, summary, statistics = _whole_file(bag)
    with open_bag(path) as file:
        records = {record.name: dict(record.metadata) for record in make_reader(file).iter_metadata()}
    ends = records.get("advnerf_end")
    topics = tuple(
        TopicInfo(
            channel.topic, type_of(summary, channel), statistics.channel_message_counts.get(channel.id, 0),
            None if ends is None else _count(ends.get(f"lost {channel.topic}", "0")),
        )
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.topic)
    )  # fmt: skip
    return BagInfo(
        path, path.stat().st_size, statistics.message_start_time, statistics.message_end_time, topics,
        tuple(index.name for index in summary.attachment_indexes), records.get("advnerf", {}),
    )  # fmt: skip


def read_attachment(bag: Path, name: str) -> bytes:
    """Content of an attached file."""
    with open_bag(_whole_file(bag)[0]) as file:
        names = []
        for attachment in make_reader(file).iter_attachments():
            if attachment.name == name:
                return bytes(attachment.data)
            names.append(attachment.name)
    raise BagError(f"{bag} has no attachment {name!r}; it has {', '.join(names) or 'none'}")


def read_attachments(bag: Path) -> dict[str, bytes]:
    """Content of all attached files by name; of two with one name the later."""
    with open_bag(_whole_file(bag)[0]) as file:
        return {attachment.name: bytes(attachment.data) for attachment in make_reader(file).iter_attachments()}


def extract_attachments(bag: Path, folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Write attached files into a folder.

    Args:
        bag: Bag folder or file.
        folder: Where they go; made if it is missing. A file that is there already is an error, never overwritten.
        names: Only these; none means all.
    """
    contents = read_attachments(bag)
    if unknown := [name for name in names if name not in contents]:
        raise BagError(f"{bag} has no attachment {', '.join(unknown)}; it has {', '.join(contents) or 'none'}")
    targets = {name: Path(folder) / plain_name(bag, name) for name in names or contents}
    for target in targets.values():
        if target.exists():
            raise BagError(f"{target} exists; remove it or choose another folder with --output")
    for name, target in targets.items():
        write_atomically(target, contents[name])
    return list(targets.values())


def plain_name(bag: Path, name: str) -> str:
    """The name of an attachment, if it is that of a file and nothing else: a stranger's bag must not write where it likes."""
    if name in ("", ".", "..") or Path(name).name != name or "\0" in name:
        raise BagError(f"{bag}: the attachment {name!r} has no plain file name; it is not written anywhere")
    return name


def read_messages(bag: Path, topics: Sequence[str] | None = None, start_offset_s: float = 0.0) -> Iterator[BagMessage]:
    """Messages in order of their log time.

    Args:
        bag: Bag folder or file.
        topics: Only these; every one must be in the bag.
        start_offset_s: Leave out so much of the beginning [s].
    """
    info = read_info(bag)
    path = info.path
    known = [topic.name for topic in info.topics]
    for name in topics or ():
        if name not in known:
            raise BagError(f"{path} has no topic {name}; it has {', '.join(known)}")
    start_ns = info.start_ns + round(start_offset_s * NS_PER_S)
    if start_offset_s < 0 or start_ns > info.end_ns:
        raise BagError(
            f"expected a start offset between 0 and {info.duration_s:.1f} s, the length of {path}, got {start_offset_s}"
        )
    _, summary, statistics = _whole_file(bag)
    names = {
        channel.id: channel.topic for channel in summary.channels.values() if not topics or channel.topic in topics
    }
    with open_bag(path) as file:
        if statistics.message_count and not summary.chunk_indexes:  # written by others, without chunks
            for _, channel, message in make_reader(file).iter_messages(
                topics, starting_at=start_ns, log_time_order=True
            ):
                yield BagMessage(channel.topic, message.data, message.log_time, message.publish_time, message.sequence)
            return
        for raw in messages_in_order(file, summary, names, start_ns):
            yield BagMessage(names[raw.channel_id], raw.data, raw.log_ns, raw.publish_ns, raw.sequence)


def require_our_types(bag: Path, topics: Sequence[str]) -> None:
    """Refuse a bag whose topics have other types than ours: receivers would refuse every message."""
    path, summary, _ = _whole_file(bag)
    for channel in summary.channels.values():
        if channel.topic not in topics:
            continue
        typename = type_of(summary, channel)
        try:
            ours = topic_row(channel.topic).type
        except TopicError as error:
            raise BagError(f"{path}: cannot play {channel.topic}: {error}") from None
        found = channel.metadata.get("topic_type_hash", "")
        if typename != ours or found not in ("", type_hash(ours)):
            raise BagError(
                f"{path}: {channel.topic} is {typename} {found}, but here it is {ours} {type_hash(ours)}; leave it out with --topics"
            )


def _count(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() else None


def _whole_file(bag: Path) -> tuple[Path, Summary, Statistics]:
    path = mcap_file(bag)
    state = path.stat()
    found = _summary_of(path, state.st_mtime_ns, state.st_size)
    if found is None:
        raise BagError(
            f"{path} is unfinished: its recorder was killed or is still at work; make it whole with: advnerf bag repair {bag}"
        )
    return path, *found


@lru_cache(maxsize=4)
def _summary_of(path: Path, mtime_ns: int, size_bytes: int) -> tuple[Summary, Statistics] | None:
    """Summary of a file in a certain state; one with an hour of chunks takes a second to read."""
    del mtime_ns, size_bytes  # they are the state
    return read_summary(path)
