"""Contents of bags: their messages, topics and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nodes.bags.formats import BagFormat
from nodes.bags.stored_types import RecordedTopic
from nodes.runtime.clock import NS_PER_S


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag.

    Attributes:
        name: Name of the topic.
        type: ROS 2 type.
        count: Number of messages.
        lost: Number of published messages that did not reach the recorder; None if the recorder did not count them.
    """

    name: str
    type: str
    count: int
    lost: int | None


@dataclass(frozen=True)
class BagInfo:
    """Contents of a bag; times are log times.

    Attributes:
        path: The bag's file, or its folder if it was split.
        parts: The bag's files in order.
        size_bytes: Size of all files [bytes].
        start_ns: Time of the first message [ns since 1970].
        end_ns: Time of the last message [ns since 1970].
        topics: Topics by name.
        attachments: Names of the attached files in all parts.
        metadata: Facts noted by the recorder: versions, git hash.
        unchecked: Why its messages may have changed unnoticed; empty if checksums cover them. Every figure made from
            such a bag says so.
    """

    path: Path
    parts: tuple[Path, ...]
    size_bytes: int
    start_ns: int
    end_ns: int
    topics: tuple[TopicInfo, ...]
    attachments: tuple[str, ...]
    metadata: dict[str, str]
    unchecked: str = ""

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
    """One message of a bag.

    Attributes:
        topic: Name of the topic.
        cdr: CDR bytes; on a topic of the topic table they are converted to our type if the bag has another definition.
        log_ns: Time at which the recorder received it [ns since 1970].
        publish_ns: Time at which it was published [ns since 1970].
        sequence: Sequence number from its publisher.
    """

    topic: str
    cdr: bytes
    log_ns: int
    publish_ns: int
    sequence: int


@dataclass(frozen=True)
class FileInfo:
    """Contents of one file of a bag, without the index of its chunks.

    Attributes:
        topics: One entry for each writer of a topic.
        recorded: Descriptions of the topics by their numbers in the file.
    """

    path: Path
    format: BagFormat
    size_bytes: int
    start_ns: int
    end_ns: int
    messages: int
    topics: tuple[TopicInfo, ...]
    recorded: Mapping[int, RecordedTopic]
    attachments: tuple[str, ...]
    metadata: dict[str, str]
    unchecked: str
