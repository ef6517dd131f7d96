"""Writes bags that rosbag2, Foxglove, ``mcap`` and ``rosbags`` can open. Messages are stored as the received bytes.

A bag is a folder with one ``.mcap`` file, or with numbered parts, and ``metadata.yaml``. Chunks of 64 KiB are written to
the file at once, and reach the disk once a second. A journal next to the file has the messages of the unfinished chunk, so
that a killed recorder loses no message that it had received (`nodes.bags.repair` adds them to the bag).

The index of a file is kept in memory until the file is finished, about 700 bytes per chunk. So the recorder starts a new part from
time to time, and another thread finishes the old one.
"""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.files import not_writable, write_atomically
from nodes.bags.journal import RESERVE_BYTES, RESERVE_NAME
from nodes.bags.metadata import Contents, rosbag2_metadata
from nodes.bags.part import PartWriter
from nodes.bags.parts import METADATA_FILE, part_name
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.paths import require_new

_SYNC_PERIOD_S = 1.0
_BYTES_PER_MIB = 1 << 20


@dataclass(frozen=True)
class SplitLimits:
    """Limits of a part. A new part starts when one of them is reached.

    Attributes:
        duration_s: Time between the first and the last message of a part [s].
        size_mib: Size of a part [MiB].
    """

    duration_s: float = 600.0
    size_mib: float = 256.0

    def reached(self, part: PartWriter, log_ns: int) -> bool:
        """Whether a message with this log time starts a new part. A clock that was set back also does."""
        if part.first_log_ns is None:
            return False
        late = abs(log_ns - part.first_log_ns) >= self.duration_s * NS_PER_S
        return late or part.size_bytes >= self.size_mib * _BYTES_PER_MIB


class BagWriter:
    """Writes one bag. Not thread-safe.

    Args:
        folder: New folder of the bag. Its name is also used for the files.
        attachments: Content of the attachments by name, stored in the first part of a split bag.
        metadata: Facts to store in every part: versions, git hash.
        attached_ns: Time at which the files were attached [ns since 1970]; None means now.
        limits: Limits of a part. None writes a single file without a number, whose index stays in memory.
        compressed: Whether chunks are compressed with zstd, without loss. Raw pictures of the simulated room shrink to a sixth for one
            per cent of a core. The bytes then depend on the version of zstd, so a replay, which promises equal bytes, does without.
    """

    def __init__(
        self,
        folder: Path,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        attached_ns: int | None = None,
        limits: SplitLimits | None = None,
        compressed: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.messages = 0
        self._limits, self._metadata, self._compressed = limits, dict(metadata or {}), compressed
        self._files: dict[str, Contents] = {}
        self._open = False
        require_new(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._hold_reserve()
            name = f"{self.folder.name}.mcap" if limits is None else part_name(self.folder.name, 0)
            self._part = PartWriter(
                self.folder / name, attachments or {}, self._metadata, attached_ns, compressed
            )
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            need = f"cannot record to {self.folder}: {error.strerror}; it needs {RESERVE_BYTES // 2**20} MiB of free space to begin"
            is_full = error.errno == errno.ENOSPC
            raise BagError(need if is_full else not_writable(self.folder, error)) from error
        self._open = True
        self._full: queue.Queue[PartWriter | None] = queue.Queue()
        self._finishing = False
        self._failure: OSError | None = None
        self._keeper = threading.Thread(target=self._keep, name="bag keeper", daemon=True)
        self._keeper.start()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._part.path

    def write(
        self, topic: str, cdr: bytes, log_ns: int, publish_ns: int, sequence: int, lost: int | None = None
    ) -> None:
        """Add a message.

        Args:
            topic: Name from the topic table.
            cdr: CDR bytes of the message.
            log_ns: Time of reception [ns since 1970].
            publish_ns: Time of publication [ns since 1970].
            sequence: Sequence number of the publisher.
            lost: Number of messages of the topic that were lost before this one; None if unknown.
        """
        try:
            self._raise_failure()
            # While the previous part is being finished, this one keeps growing, because waiting would block the bus.
            if self._limits is not None and not self._finishing and self._limits.reached(self._part, log_ns):
                self._split()
            self._part.write(topic, cdr, log_ns, publish_ns, sequence, lost)
        except OSError as error:
            self._rescue(error)
        self.messages += 1

    def flush(self) -> None:
        """Finish the current chunk, so that the next sync writes it to the disk."""
        try:
            self._raise_failure()
            self._part.flush()
        except OSError as error:
            self._rescue(error)

    def close(self, metadata: Mapping[str, str] | None = None) -> None:
        """Complete the bag: write the summary of its last file and ``metadata.yaml``.

        Args:
            metadata: Facts known only at the end.
        """
        if not self._open:
            return
        try:
            self._stop_keeper()
            self._raise_failure()
            self._finish(self._part, metadata)
            self._let_go()
        except OSError as error:
            self._rescue(error)

    def _split(self) -> None:
        """Start a new part. All chunks of the old one are written to its file first."""
        old = self._part
        old.flush()
        number = len(self._files) + 1
        path = self.folder / part_name(self.folder.name, number)
        self._part = PartWriter(path, {}, self._metadata, compressed=self._compressed)
        self._finishing = True
        self._full.put(old)

    def _finish(self, part: PartWriter, metadata: Mapping[str, str] | None = None) -> None:
        """Finish a part, then list it in ``metadata.yaml``, which never lists an unfinished file."""
        part.finish(metadata)
        self._files[part.path.name] = part.contents
        write_atomically(self.folder / METADATA_FILE, rosbag2_metadata(self._files))

    def _keep(self) -> None:
        """Run the slow work: sync the file to the disk once a second, and finish full parts."""
        while True:
            try:
                part = self._full.get(timeout=_SYNC_PERIOD_S)
            except queue.Empty:
                with contextlib.suppress(OSError):  # the next write reports it
                    self._part.sync()
                continue
            if part is None:
                return
            try:
                self._finish(part)
            except OSError as error:
                part.let_go()
                self._failure = error
            self._finishing = False

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _rescue(self, error: OSError) -> None:
        """After a failed write, finish the files as far as possible, in the reserved space."""
        from nodes.bags.repair_parts import repair_bag

        if self._open:
            self._stop_keeper()
            self._let_go()
        try:
            messages = sum(part.messages for part in repair_bag(self.folder, in_place=True))
            saved = f"{messages} messages up to that point are readable"
        except (BagError, OSError) as second:
            saved = f"and it could not be finished ({second}); free some space and run: advnerf bag repair {self.folder}"
        raise BagError(f"cannot continue recording to {self.folder}: {error.strerror}; {saved}") from error

    def _hold_reserve(self) -> None:
        with open(self.folder / RESERVE_NAME, "wb") as reserve:
            os.posix_fallocate(reserve.fileno(), 0, RESERVE_BYTES)

    def _stop_keeper(self) -> None:
        self._full.put(None)
        self._keeper.join()

    def _let_go(self) -> None:
        self._open = False
        self._part.let_go()
        (self.folder / RESERVE_NAME).unlink(missing_ok=True)
