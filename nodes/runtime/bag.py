"""Bags: what rosbag2, Foxglove, ``mcap`` and ``rosbags`` open. The bytes of the wire go in as they are.

A bag is a folder with ``<name>.mcap`` and ``metadata.yaml``. Chunks of 64 KiB are written through to the file at once and
reach the disk once a second; the chunk that is being filled is kept in a journal beside it, so that a recorder that is killed
loses none of the messages it had received (`nodes.runtime.bag_repair` puts them together).
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from mcap.writer import CompressionType, Writer

from advnerf_core.files import write_atomically
from nodes.runtime.bag_index_spool import SpooledIndexes
from nodes.runtime.bag_journal import Entry, Journal
from nodes.runtime.errors import BagError
from nodes.runtime.messages import ROS_DISTRO, type_definition, type_hash
from nodes.runtime.topics import topic as topic_row

CHUNK_BYTES = 64 * 1024
PROFILE, LIBRARY = "ros2", "advnerf"
METADATA_FILE = "metadata.yaml"
# Held back so that the summary still fits when the disk is full: about a day of chunk indexes.
RESERVE_BYTES = 8 * 1024 * 1024
_RESERVE_NAME = ".reserve"
_SYNC_PERIOD_S = 1.0


@dataclass
class Contents:
    """What a bag's summary says.

    Attributes:
        types: Type name by topic.
        hashes: RIHS01 hash by topic.
        counts: Number of messages by topic.
        start_ns: Log time of the first message [ns since 1970]; 0 when there is none.
        end_ns: Log time of the last message [ns since 1970].
    """

    types: dict[str, str] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0

    def add_topic(self, topic: str, typename: str, rihs: str) -> None:
        """Note a topic."""
        self.types[topic], self.hashes[topic] = typename, rihs
        self.counts.setdefault(topic, 0)

    def add_message(self, topic: str, log_ns: int) -> None:
        """Note a message."""
        self.start_ns = min(self.start_ns, log_ns) if sum(self.counts.values()) else log_ns
        self.end_ns = max(self.end_ns, log_ns)
        self.counts[topic] += 1


def rosbag2_metadata(file_name: str, contents: Contents) -> str:
    """Text of ``metadata.yaml``, version 9."""
    duration = {"nanoseconds": contents.end_ns - contents.start_ns}
    start = {"nanoseconds_since_epoch": contents.start_ns}
    count = sum(contents.counts.values())
    topics = [
        {
            "topic_metadata": {
                "name": topic, "type": typename, "serialization_format": "cdr",
                "offered_qos_profiles": [], "type_description_hash": contents.hashes[topic],
            },
            "message_count": contents.counts[topic],
        }
        for topic, typename in contents.types.items()
    ]  # fmt: skip
    information = {
        "version": 9, "storage_identifier": "mcap", "duration": duration, "starting_time": start, "message_count": count,
        "topics_with_message_count": topics, "compression_format": "", "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [{"path": file_name, "starting_time": start, "duration": duration, "message_count": count}],
        "custom_data": None, "ros_distro": ROS_DISTRO,
    }  # fmt: skip
    # Without aliases: rosbag2's reader does not know them.
    return yaml.dump({"rosbag2_bagfile_information": information}, Dumper=_PlainDumper, sort_keys=False)


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


class _WriteThrough:
    """The part of a file that ``mcap.Writer`` uses, without a buffer between it and the system.

    A file opened with ``buffering=0`` would not do: the writer wraps it in a buffer of its own, whose end is then lost.
    """

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            written = os.write(self.descriptor, view)
            view = view[written:]
            self._position += written
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        os.close(self.descriptor)


class BagWriter:
    """Writes one bag; for one thread.

    Args:
        folder: New folder of the bag; its name is also that of the file in it.
        attachments: Content of the files that ride along, by name.
        metadata: Facts that ride along: versions, git hash.
        attached_ns: Time at which the files were attached [ns since 1970]; none means now.
    """

    def __init__(
        self,
        folder: Path,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        attached_ns: int | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.path = self.folder / f"{self.folder.name}.mcap"
        self.contents = Contents()
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stop_sync = threading.Event()
        self._open = False
        if self.folder.exists() and any(self.folder.iterdir()):
            raise BagError(f"{self.folder} exists and is not empty; record to another folder, or remove it")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._hold_reserve()
            self._stream = _WriteThrough(self.path)
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)  # type: ignore[arg-type]
            # The library has no setting for where it keeps these; a kilobyte for every picture would be 100 MB an hour.
            self._indexes = SpooledIndexes(self.folder)
            self._writer._Writer__chunk_indices = self._indexes  # type: ignore[attr-defined]
            self._writer.start(profile=PROFILE, library=LIBRARY)
            if metadata:
                self._writer.add_metadata("advnerf", dict(metadata))
            stamp_ns = time.time_ns() if attached_ns is None else attached_ns
            for name, content in (attachments or {}).items():
                self._writer.add_attachment(stamp_ns, stamp_ns, name, "application/octet-stream", content)
            self._journal = Journal(self.path, self._stream.tell())
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise BagError(
                f"cannot record to {self.folder}: {error.strerror}; it needs {RESERVE_BYTES // 2**20} MiB of free space to begin"
            ) from error
        self._open = True
        self._sync_thread = threading.Thread(target=self._sync, name="bag sync", daemon=True)
        self._sync_thread.start()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def write(self, topic: str, cdr: bytes, log_ns: int, publish_ns: int, sequence: int) -> None:
        """Add a message.

        Args:
            topic: Name from the topic table.
            cdr: Bytes of the wire.
            log_ns: When it was received [ns since 1970].
            publish_ns: When it was published [ns since 1970].
            sequence: Number of its publisher.
        """
        try:
            channel = self._channels.get(topic) or self._register(topic)
            self._journal.restart(self._stream.tell())  # a definition may have filled a chunk
            # A message that fills a chunk by itself ends it at once and needs no journal.
            if len(cdr) <= CHUNK_BYTES:
                self._journal.add(Entry(topic, cdr, log_ns, publish_ns, sequence))
            self._writer.add_message(channel, log_ns, cdr, publish_ns, sequence & 0xFFFFFFFF)
            self._journal.restart(self._stream.tell())
        except OSError as error:
            self._rescue(error)
        self.contents.add_message(topic, log_ns)

    def flush(self) -> None:
        """End the present chunk, so that it reaches the disk with the next sync."""
        try:
            self._writer.flush()
            self._journal.restart(self._stream.tell())
        except OSError as error:
            self._rescue(error)

    def close(self, metadata: Mapping[str, str] | None = None) -> None:
        """Write what makes a bag whole: the summary and ``metadata.yaml``.

        Args:
            metadata: Facts known only at the end: what was lost.
        """
        if not self._open:
            return
        try:
            self._writer.flush()
            if metadata:
                self._writer.add_metadata("advnerf_end", dict(metadata))
            text = rosbag2_metadata(self.path.name, self.contents)
            self._writer.add_metadata("rosbag2", {"serialized_metadata": text})
            self._writer.finish()
            os.fsync(self._stream.descriptor)
            self._let_go()
            self._journal.path.unlink()
            write_atomically(self.folder / METADATA_FILE, text)
        except OSError as error:
            self._rescue(error)

    def _register(self, topic: str) -> int:
        typename = topic_row(topic).type
        if typename not in self._schemas:
            definition = type_definition(typename).encode()
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", definition)
        metadata = {"topic_type_hash": type_hash(typename)}
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[typename], metadata)
        self.contents.add_topic(topic, typename, type_hash(typename))
        return self._channels[topic]

    def _rescue(self, error: OSError) -> None:
        """After a failed write: finish the file as far as it goes, in the space held back for it."""
        from nodes.runtime.bag_repair import repair

        if self._open:
            self._let_go()
        try:
            saved = f"{repair(self.folder, in_place=True).messages} messages up to then are readable in it"
        except (BagError, OSError) as second:
            saved = (
                f"and it could not be finished ({second}); free some space and run: advnerf bag repair {self.folder}"
            )
        raise BagError(f"cannot go on recording to {self.folder}: {error.strerror}; {saved}") from error

    def _hold_reserve(self) -> None:
        with open(self.folder / _RESERVE_NAME, "wb") as reserve:
            os.posix_fallocate(reserve.fileno(), 0, RESERVE_BYTES)

    def _let_go(self) -> None:
        self._open = False
        self._stop_sync.set()
        self._sync_thread.join()
        self._stream.close()
        self._indexes.close()
        self._journal.close()
        (self.folder / _RESERVE_NAME).unlink(missing_ok=True)

    def _sync(self) -> None:
        while not self._stop_sync.wait(_SYNC_PERIOD_S):
            with contextlib.suppress(OSError):  # the next write reports it
                os.fdatasync(self._stream.descriptor)
