"""Reads bags in other formats than MCAP through ``rosbags``: the SQLite files of rosbag2, and ROS 1 bags."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import MessageDefinitionFormat

from nodes.bags.formats import BagFormat
from nodes.bags.message_definitions import IDL, MSG, full_type_name
from nodes.bags.stored_types import CDR, ROS1, RecordedTopic
from nodes.runtime.errors import BagError

# Exceptions that the readers raise for a damaged file.
_NONSENSE = (
    rosbag1.ReaderError, rosbag2.ReaderError, struct.error, ValueError, KeyError, IndexError, TypeError, AssertionError,
    OverflowError, EOFError, MemoryError, RuntimeError, OSError,
)  # fmt: skip
_LANGUAGES = {MessageDefinitionFormat.MSG: MSG, MessageDefinitionFormat.IDL: IDL}


class StoredTopic(NamedTuple):
    """One topic of one writer: its number in the file, its description, and its number of messages."""

    number: int
    recorded: RecordedTopic
    messages: int


class StoredBag(NamedTuple):
    """Contents of a file. Times are in nanoseconds since 1970, 0 for a file without messages."""

    start_ns: int
    end_ns: int
    messages: int
    topics: tuple[StoredTopic, ...]


class StoredMessage(NamedTuple):
    """One message, with the number of its topic."""

    number: int
    log_ns: int
    data: bytes


def read_stored(path: Path, form: BagFormat) -> StoredBag:
    """Read the contents of a file.

    Raises:
        BagError: The file is damaged, or its recorder left messages in another file.
    """
    with _opened(path, form) as reader:
        topics = tuple(_topic(connection, form) for connection in reader.connections)
        count = sum(topic.messages for topic in topics)
        if not count:
            return StoredBag(0, 0, 0, topics)
        return StoredBag(reader.start_time, reader.end_time - 1, count, topics)


def stored_messages(
    path: Path, form: BagFormat, numbers: Collection[int], start_ns: int
) -> Iterator[StoredMessage]:
    """Yield messages in order of their log time.

    Args:
        form: Format of the file.
        numbers: Numbers of the topics to read.
        start_ns: First log time [ns since 1970].
    """
    with _opened(path, form) as reader:
        wanted = [connection for connection in reader.connections if connection.id in numbers]
        if wanted:  # an empty list would mean all topics
            for connection, log_ns, data in reader.messages(wanted, start=start_ns):
                yield StoredMessage(connection.id, log_ns, bytes(data))


def _topic(connection: Any, form: BagFormat) -> StoredTopic:
    language = _LANGUAGES.get(connection.msgdef.format, "")
    serialization = ROS1 if form is BagFormat.ROS1 else connection.ext.serialization_format or CDR
    recorded = RecordedTopic(
        connection.topic,
        full_type_name(connection.msgtype),
        "" if form is BagFormat.ROS1 else connection.digest,
        connection.msgdef.data if language else "",
        language or MSG,
        serialization,
    )
    return StoredTopic(connection.id, recorded, connection.msgcount)


@contextmanager
def _opened(path: Path, form: BagFormat) -> Iterator[Any]:
    rest = path.with_name(f"{path.name}-wal")
    if form is BagFormat.SQLITE and rest.exists() and rest.stat().st_size:
        raise BagError(
            f"{path} is unfinished: its recorder was killed or is still running, and the newest messages are in {rest.name}; "
            f"add them with: sqlite3 {path} 'PRAGMA wal_checkpoint(TRUNCATE)'"
        )
    try:
        with _reader(path, form) as reader:
            yield reader
    except BagError:
        raise
    except _NONSENSE as error:
        said = " ".join(str(error).split())
        raise BagError(
            f"{path} is {form.value}, and cannot be read: {type(error).__name__} {said:.160}"
        ) from error


def _reader(path: Path, form: BagFormat) -> Any:
    if form is BagFormat.ROS1:
        return rosbag1.Reader(path)
    if path.suffix != ".db3":
        raise BagError(f"{path} is {form.value}; rename it to {path.stem}.db3 to read it")
    return rosbag2.Reader(path)
