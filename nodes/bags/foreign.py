"""Reads bags in other formats than MCAP through ``rosbags``: the SQLite files of rosbag2, and ROS 1 bags."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import MessageDefinitionFormat

from nodes.bags.formats import BagFormat, mend_advice, no_checksums
from nodes.bags.info import BagMessage, FileInfo, TopicInfo
from nodes.bags.message_definitions import IDL, MSG, full_type_name
from nodes.bags.stored_types import CDR, ROS1, RecordedTopic
from nodes.runtime.errors import BagError

# Exceptions that the readers raise for a damaged file.
_NONSENSE = (
    rosbag1.ReaderError, rosbag2.ReaderError, struct.error, ValueError, KeyError, IndexError, TypeError, AssertionError,
    OverflowError, EOFError, MemoryError, RuntimeError, OSError,
)  # fmt: skip
_LANGUAGES = {MessageDefinitionFormat.MSG: MSG, MessageDefinitionFormat.IDL: IDL}


def read_stored(path: Path, form: BagFormat, size_bytes: int) -> FileInfo:
    """Read the contents of a file.

    Raises:
        BagError: The file is damaged, or its recorder left messages in another file.
    """
    with _opened(path, form) as reader:
        recorded = {connection.id: _recorded(connection, form) for connection in reader.connections}
        counts = [connection.msgcount for connection in reader.connections]
        return FileInfo(
            path,
            form,
            size_bytes,
            reader.start_time if sum(counts) else 0,
            reader.end_time - 1 if sum(counts) else 0,
            sum(counts),
            tuple(
                TopicInfo(each.topic, each.type, count, None)
                for each, count in zip(recorded.values(), counts, strict=True)
            ),
            recorded,
            (),
            {},
            no_checksums(form),
        )


def stored_messages(
    path: Path, form: BagFormat, names: Mapping[int, str], start_ns: int
) -> Iterator[tuple[int, BagMessage]]:
    """Yield number of the topic and message in order of their log time. Publish times and sequence numbers are generated.

    Args:
        names: Topics to read by their numbers.
        start_ns: First log time [ns since 1970].
    """
    counts = dict.fromkeys(names.values(), 0)
    with _opened(path, form) as reader:
        wanted = [connection for connection in reader.connections if connection.id in names]
        if wanted:  # an empty list would mean all topics
            for connection, log_ns, data in reader.messages(wanted, start=start_ns):
                topic = names[connection.id]
                yield connection.id, BagMessage(topic, bytes(data), log_ns, log_ns, counts[topic])
                counts[topic] += 1


def stored_times(path: Path) -> Iterator[tuple[str, int]]:
    """Yield topic and log time [ns since 1970] of the messages of an SQLite file, in the order in which they were written.

    Source: ``rosbag2_storage_sqlite3``, ``sqlite_storage.cpp``: ``messages.id`` is the primary key, so it counts up.
    """
    query = "SELECT name, timestamp FROM messages JOIN topics ON topic_id = topics.id ORDER BY messages.id"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as stored:
            yield from stored.execute(query)
    except sqlite3.Error as error:
        raise BagError(f"{path} is {BagFormat.SQLITE.value}, and cannot be read: {error}") from error


def _recorded(connection: Any, form: BagFormat) -> RecordedTopic:
    language = _LANGUAGES.get(connection.msgdef.format, "")
    serialization = ROS1 if form is BagFormat.ROS1 else connection.ext.serialization_format or CDR
    return RecordedTopic(
        connection.topic,
        full_type_name(connection.msgtype),
        "" if form is BagFormat.ROS1 else connection.digest,
        connection.msgdef.data if language else "",
        language or MSG,
        serialization,
    )


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
            f"{path} is {form.value}, and cannot be read: {type(error).__name__} {said:.160}; {mend_advice(path, form)}"
        ) from error


def _reader(path: Path, form: BagFormat) -> Any:
    if form is BagFormat.ROS1:
        return rosbag1.Reader(path)
    if path.suffix != ".db3":
        raise BagError(f"{path} is {form.value}; rename it to {path.stem}.db3 to read it")
    return rosbag2.Reader(path)
