"""Writes one file (part) of a bag."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from pathlib import Path

from mcap.writer import CompressionType, Writer

from nodes.bags.info import BagMessage
from nodes.bags.journal import Journal
from nodes.bags.metadata import Contents, rosbag2_metadata
from nodes.runtime.messages import type_definition, type_hash
from nodes.runtime.topics import topic as topic_row

CHUNK_BYTES = 64 * 1024
PROFILE, LIBRARY = "ros2", "advnerf"


def opening_name(part: Path) -> Path:
    """Temporary name of a new part. The part gets its final name after its header is written, so that no part is ever empty."""
    return part.with_name(f".{part.name}.opening")


class PartWriter:
    """Writes one MCAP file that can be opened on its own: every part has all schemas and channels.

    Only one thread at a time may call its methods.

    Args:
        path: The file, which must not exist.
        attachments: Content of the attachments, by name.
        metadata: Facts to store: versions, git hash.
        attached_ns: Time at which the files were attached [ns since 1970]; None means now.
        compressed: Whether chunks are compressed with zstd.

    Attributes:
        contents: Contents that were written.
        first_log_ns: Log time of the message that was written first [ns since 1970]; None before it.
    """

    def __init__(
        self,
        path: Path,
        attachments: Mapping[str, bytes],
        metadata: Mapping[str, str],
        attached_ns: int | None = None,
        compressed: bool = False,
    ) -> None:
        self.path = path
        self.contents = Contents()
        self.first_log_ns: int | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stream = _WriteThrough(opening_name(path))
        try:
            compression = CompressionType.ZSTD if compressed else CompressionType.NONE
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=compression)  # type: ignore[arg-type]
            self._writer.start(profile=PROFILE, library=LIBRARY)
            if metadata:
                self._writer.add_metadata("advnerf", dict(metadata))
            stamp_ns = time.time_ns() if attached_ns is None else attached_ns
            for name, content in attachments.items():
                self._writer.add_attachment(stamp_ns, stamp_ns, name, "application/octet-stream", content)
            self._journal = Journal(path, self._stream.tell())
            opening_name(path).rename(path)
        except OSError:
            self._stream.close()
            raise

    @property
    def size_bytes(self) -> int:
        """Current length of the file, without the unfinished chunk."""
        return self._stream.tell()

    def write(
        self, topic: str, cdr: bytes, log_ns: int, publish_ns: int, sequence: int, lost: int | None = None
    ) -> None:
        """Add a message; see `nodes.bags.writer.BagWriter.write`.

        Raises:
            OSError: The file cannot be written, for example because the disk is full.
        """
        channel = self._channels.get(topic) or self._register(topic)
        self._journal.restart(self._stream.tell())  # a definition may have filled a chunk
        # A message that fills a chunk completes it at once, so it needs no journal.
        if len(cdr) <= CHUNK_BYTES:
            self._journal.add(BagMessage(topic, cdr, log_ns, publish_ns, sequence))
        self._writer.add_message(channel, log_ns, cdr, publish_ns, sequence & 0xFFFFFFFF)
        self._journal.restart(self._stream.tell())
        self.contents.add_message(topic, log_ns)
        if self.first_log_ns is None:
            self.first_log_ns = log_ns
        if lost is not None:
            self.contents.lost[topic] = self.contents.lost.get(topic, 0) + lost

    def flush(self) -> None:
        """Finish the current chunk, so that the next sync writes it to the disk."""
        self._writer.flush()
        self._journal.restart(self._stream.tell())

    def sync(self) -> None:
        """Wait until all written data are on the disk."""
        os.fdatasync(self._stream.descriptor)

    def finish(self, metadata: Mapping[str, str] | None = None) -> None:
        """Write the summary that completes the file, and close it.

        Args:
            metadata: Facts known only at the end.
        """
        self._writer.flush()
        losses = {f"lost {topic}": str(count) for topic, count in self.contents.lost.items()}
        if ends := {**losses, **(metadata or {})}:
            self._writer.add_metadata("advnerf_end", ends)
        text = rosbag2_metadata({self.path.name: self.contents})
        self._writer.add_metadata("rosbag2", {"serialized_metadata": text})
        self._writer.finish()
        os.fsync(self._stream.descriptor)
        self.let_go()
        self._journal.path.unlink()

    def let_go(self) -> None:
        """Close the files without completing them. The journal is kept for a repair. May be called repeatedly."""
        with contextlib.suppress(OSError):
            self._stream.close()
        with contextlib.suppress(OSError):
            self._journal.close()

    def _register(self, topic: str) -> int:
        typename = topic_row(topic).type
        if typename not in self._schemas:
            definition = type_definition(typename).encode()
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", definition)
        metadata = {"topic_type_hash": type_hash(typename)}
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[typename], metadata)
        self.contents.add_topic(topic, typename, type_hash(typename))
        return self._channels[topic]


class _WriteThrough:
    """The file methods that ``mcap.Writer`` uses, without a buffer.

    A file opened with ``buffering=0`` does not work, because the writer wraps it in a buffer, whose last bytes are then lost.
    """

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = 0
        self._open = True

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
        """Do nothing, because there is no buffer."""

    def close(self) -> None:
        if self._open:
            self._open = False
            os.close(self.descriptor)
