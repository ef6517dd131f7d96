"""Scans an MCAP file record by record: what can be kept, what is lost, and what no checksum covers."""

from __future__ import annotations

import contextlib
import zlib
from bisect import bisect_right
from collections import Counter
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)

from nodes.bags.against_summary import contradiction, restore_definitions
from nodes.bags.file import mapped
from nodes.bags.records import (
    DATA_END_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkHead,
    Damaged,
    bytes_of,
    checked_attachment,
    chunk_head,
    index_entries,
    parse,
    record_at,
    records_of,
    unpack_chunk,
)
from nodes.bags.resync import (
    is_cut,
    makes_sense,
    next_file,
    next_record,
    only_zeros,
    plausible_end,
    runs_over,
)
from nodes.bags.salvage import good_records
from nodes.bags.scanned import BAD, CUT, JUNK, ZEROS, Loss, MessageRun, Piece, Scan, chunk_index
from nodes.bags.summary import Ending, read_ending, read_summary_section
from nodes.runtime.errors import BagError

# Messages outside chunks are read in runs of this many bytes.
_RUN_BYTES = 1 << 20
_CRC_BLOCK_BYTES = 1 << 22
_SUMMARY_ONLY = (Opcode.FOOTER, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET, Opcode.CHUNK_INDEX)  # fmt: skip


def scan_file(path: Path) -> Scan:
    """Scan a whole file, skipping damage.

    Raises:
        BagError: The file is not MCAP, or its compression is unknown.
    """
    with mapped(path) as buffer:
        scan = _Scanner(buffer, path)
        scan.run()
        return scan.found


class _Scanner:
    def __init__(self, buffer: Any, path: Path) -> None:
        self._buffer, self._path = buffer, path
        self.found = found = Scan(size=len(buffer))
        self._limit = found.size
        # For the last chunk: its piece, its entries by channel, and the message indexes found after it.
        self._chunk: Piece | None = None
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self._indexed: dict[int, int] = {}
        self._index_wrong = False
        self._bad_chunk: Loss | None = None
        self._listed: dict[int, ChunkIndex] = {}
        found.ending = read_ending(buffer, found.size)
        if found.ending is not None and found.ending.summary_start:
            self._read_summary(found.ending)

    def _read_summary(self, ending: Ending) -> None:
        try:
            self.found.known = read_summary_section(self._buffer, ending)
        except Damaged as error:
            self.found.summary_damage = str(error)
        else:
            self._limit = ending.summary_start
            self._listed = {index.chunk_start_offset: index for index in self.found.known.chunk_indexes}

    def run(self) -> None:
        """Scan all records."""
        at = self._begin()
        while at < self._limit and self.found.data_end is None:
            try:
                at = self._take(at)
            except Damaged as error:
                at = self._over_damage(at, str(error))
        self._close_chunk(at_end=True)
        if self.found.data_end is not None and (other := next_file(self._buffer, at)) is not None:
            # As cat leaves it: no reader sees its messages.
            why = "it begins behind the end of this one; cut it out into a file of its own"
            self.found.losses.append(Loss(other, self.found.size - other, "another recording", why, JUNK))
        if self.found.data_end is None and self.found.ending is not None:
            self.found.fixes.append("the record that ends the data was missing")
        restore_definitions(self.found)
        if self.found.known is not None and not self.found.summary_damage and not self.found.losses:
            self.found.summary_damage = contradiction(self.found, self.found.known)

    def _begin(self) -> int:
        buffer, at = self._buffer, len(MAGIC)
        if buffer[:at] == MAGIC:
            return at
        try:
            opcode, body, end = record_at(buffer, at, self._limit)
            parse(Header, buffer[body:end] if opcode == Opcode.HEADER else b"")
        except Damaged:
            raise BagError(
                f"{self._path}: expected an MCAP file, got another beginning; give an MCAP file"
            ) from None
        self.found.fixes.append("its first eight bytes were damaged")
        return at

    def _take(self, at: int) -> int:
        """Add the record at an offset to the scan. Returns the offset of the next record."""
        opcode, body, end = record_at(self._buffer, at, self._limit)
        if opcode == Opcode.MESSAGE_INDEX:
            self._take_index(at, body, end)
            return end
        self._close_chunk()
        self._bad_chunk = None
        if opcode == Opcode.CHUNK:
            return self._take_chunk(at, body, end)
        if opcode == Opcode.MESSAGE:
            self._take_message(at, body, end)
        elif opcode == Opcode.ATTACHMENT:
            a, _ = checked_attachment(self._buffer[body:end])
            index = AttachmentIndex(
                at, end - at, a.log_time, a.create_time, len(a.data), a.name, a.media_type
            )
            self.found.pieces.append(Piece(at, end - at, index))
        elif opcode == Opcode.METADATA:
            name = parse(Metadata, self._buffer[body:end]).name
            self.found.pieces.append(
                Piece(at, end - at, MetadataIndex(offset=at, length=end - at, name=name))
            )
        elif opcode == Opcode.DATA_END:
            self._take_data_end(at, body, end)
        elif opcode in _SUMMARY_ONLY or opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            raise Damaged("a record of the summary is among the data")
        else:
            self._take_plain(opcode, at, body, end)
        return end

    def _take_plain(self, opcode: int, at: int, body: int, end: int) -> None:
        content = self._buffer[body:end]
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, content)
            self.found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, content)
            self.found.channels[channel.id] = channel
        elif opcode == Opcode.HEADER:
            if at != len(MAGIC):
                raise Damaged("a second header is among the data")
            self.found.header = parse(Header, content)
        elif not plausible_end(self._buffer, end, self._limit) or self._chunk_in_disguise(at) is not None:
            # An unknown kind of record, from a newer version of the format, is kept if valid records follow.
            raise Damaged(f"there is no record of kind {opcode}")
        self._keep(at, end)

    def _keep(self, at: int, end: int) -> None:
        pieces = self.found.pieces
        # The header is a separate piece, so that records can be inserted after it.
        if len(pieces) > 1 and pieces[-1].record is None and self._end_of(pieces[-1]) == at:
            pieces[-1].length += end - at
        else:
            pieces.append(Piece(at, end - at))

    @staticmethod
    def _end_of(piece: Piece) -> int:
        return piece.offset + piece.length

    def _take_message(self, at: int, body: int, end: int) -> None:
        if end - body < MESSAGE_HEAD.size:
            raise Damaged(f"a message has {end - body} bytes, fewer than its own head")
        channel_id, sequence, log_ns, _ = MESSAGE_HEAD.unpack_from(self._buffer, body)
        if channel_id not in self.found.channels and not plausible_end(self._buffer, end, self._limit):
            raise Damaged(f"a message is of channel {channel_id}, which does not exist")
        self.found.count(channel_id, sequence, log_ns)
        self.found.unchecked_messages += 1
        self._keep(at, end)
        run = self.found.runs[-1] if self.found.runs else None
        if run and run.chunk_start_offset + run.chunk_length == at and run.chunk_length < _RUN_BYTES:
            run.chunk_length = end - run.chunk_start_offset
            run.message_start_time = min(run.message_start_time, log_ns)
            run.message_end_time = max(run.message_end_time, log_ns)
            run.message_index_offsets.add(channel_id)
        else:
            self.found.runs.append(MessageRun(at, end - at, log_ns, log_ns, {channel_id}))

    def _take_chunk(self, at: int, body: int, end: int) -> int:
        head = chunk_head(self._buffer, body, end - body)
        try:
            records = unpack_chunk(head, self._buffer[head.data_at : end])
            self._commit(at, end, head, records, *_contents(records))
        except Damaged as error:
            if not plausible_end(self._buffer, end, self._limit):
                raise
            return self._lose_chunk(at, end, head, str(error))
        return end

    def _commit(
        self,
        at: int,
        end: int,
        head: ChunkHead,
        records: bytes,
        definitions: list[Schema | Channel],
        messages: list[tuple[int, int, int, int]],
    ) -> None:
        entries = self._count_all(definitions, messages)
        self.found.unchecked_chunks += head.crc == 0 and bool(messages)
        times = [log_ns for _, _, log_ns, _ in messages] or [head.start_ns, head.end_ns]
        packed = head.compression, head.data_length
        index = chunk_index(at, end - at, (min(times), max(times)), len(records), packed)
        self._chunk, self._entries = Piece(at, end - at, index), entries
        self._indexed, self._index_wrong = {}, False
        fits = (
            RECORD_HEAD.pack(Opcode.CHUNK, end - at - RECORD_HEAD.size)
            == self._buffer[at : at + RECORD_HEAD.size]
        )
        if not fits or (head.start_ns, head.end_ns, head.size) != (min(times), max(times), len(records)):
            self.found.fixes.append(f"the head of the chunk at byte {at} did not agree with its content")
            data = self._buffer[head.data_at : end]
            self._chunk.content = bytes_of(
                Chunk(head.compression, data, max(times), min(times), head.crc, len(records))
            )

    def _count_all(
        self, definitions: list[Schema | Channel], messages: list[tuple[int, int, int, int]]
    ) -> dict[int, list[tuple[int, int]]]:
        """Add the records of a chunk to the scan. Returns log time and offset of its messages, by channel."""
        for definition in definitions:
            if isinstance(definition, Schema):
                self.found.schemas[definition.id] = definition
            else:
                self.found.channels[definition.id] = definition
        entries: dict[int, list[tuple[int, int]]] = {}
        for channel_id, sequence, log_ns, place in messages:
            entries.setdefault(channel_id, []).append((log_ns, place))
            self.found.count(channel_id, sequence, log_ns)
        return entries

    def _chunk_in_disguise(self, at: int) -> tuple[int, ChunkHead, bytes] | None:
        """End, head and records of a chunk that certainly begins here, even if opcode and length of its record are damaged."""
        try:
            head = chunk_head(self._buffer, at + RECORD_HEAD.size, None)
            end = head.data_at + head.data_length
            if not head.crc or end > self._limit:
                return None
            return end, head, unpack_chunk(head, self._buffer[head.data_at : end])
        except (Damaged, BagError):
            return None

    def _lose_chunk(self, at: int, end: int, head: ChunkHead, reason: str) -> int:
        """Note the loss of a damaged chunk, and keep its good records. Returns the offset of the next record."""
        indexed = self._listed.get(at)
        span = (head.start_ns, head.end_ns)
        if indexed is not None:
            span = indexed.message_start_time, indexed.message_end_time
        self._bad_chunk = Loss(at, end - at, "a chunk", reason, BAD, span)
        self.found.losses.append(self._bad_chunk)
        indexed_messages, after = self._message_indexes(end)
        data = bytes(self._buffer[head.data_at : end])
        records, proven = good_records(head, data, indexed_messages, self.found.channels.keys())
        if not records:
            return end
        definitions, messages = _contents(records)
        lost = Counter(channel_id for channel_id, _ in indexed_messages.values())
        lost.subtract(channel_id for channel_id, *_ in messages if channel_id in lost)
        loss, self._bad_chunk = self._bad_chunk, None
        loss.length, loss.counts = after - at, {channel_id: n for channel_id, n in lost.items() if n > 0}
        loss.reason = f"{reason}; {len(messages)} of its messages are kept"
        self.found.unchecked_chunks += bool(messages) and not proven
        times = [log_ns for _, _, log_ns, _ in messages] or [head.start_ns, head.end_ns]
        crc = zlib.crc32(records) if proven else 0
        piece = Piece(at, after - at)
        fill_anew(piece, records, (min(times), max(times)), crc, self._count_all(definitions, messages))
        self.found.pieces.append(piece)
        return after

    def _message_indexes(self, at: int) -> tuple[dict[int, tuple[int, int]], int]:
        """Channel and log time of the messages of a chunk by their offset, from the indexes that follow it, and where these end."""
        found: dict[int, tuple[int, int]] = {}
        with contextlib.suppress(Damaged):
            while True:
                opcode, body, end = record_at(self._buffer, at, self._limit)
                if opcode != Opcode.MESSAGE_INDEX:
                    break
                channel_id, entries = index_entries(self._buffer[body:end])
                found |= {place: (channel_id, log_ns) for log_ns, place in entries}
                at = end
        return found, at

    def _take_index(self, at: int, body: int, end: int) -> None:
        """Assign a message index to the chunk before it. A wrong or cut index is rebuilt from the chunk."""
        channel_id, entries = index_entries(self._buffer[body:end])
        if self._bad_chunk is not None:
            self._bad_chunk.counts[channel_id] = len(entries)
            self._bad_chunk.length += end - at
        elif self._chunk is None:
            self._note_harmless(at, end, "a message index belongs to no chunk")
        else:
            # Some writers also list channels without messages.
            wrong = (
                sorted(entries) != sorted(self._entries.get(channel_id, [])) or channel_id in self._indexed
            )
            self._index_wrong |= wrong
            self._indexed[channel_id] = at
            self._chunk.length += end - at

    def _note_harmless(self, at: int, end: int, reason: str) -> None:
        self.found.losses.append(Loss(at, end - at, f"{end - at} bytes", reason, BAD, harmless=True))

    def _close_chunk(self, at_end: bool = False) -> None:
        """Finish the piece that consists of a chunk and its message indexes."""
        piece, self._chunk = self._chunk, None
        if piece is None:
            return
        assert isinstance(piece.record, ChunkIndex)
        index = piece.record
        missing = bool(self._entries.keys() - self._indexed.keys())
        # A writer may omit all message indexes. In an unfinished file, this looks the same as a recorder killed at this point.
        left_out = not self._indexed and not (at_end and self.found.ending is None)
        if self._index_wrong or (missing and not left_out):
            if self._index_wrong or self.found.ending is not None:
                self.found.fixes.append(
                    f"the message index of the chunk at byte {piece.offset} was wrong or incomplete"
                )
            chunk = piece.content or self._buffer[piece.offset : piece.offset + index.chunk_length]
            _index_anew(piece, index, chunk, self._entries)
        else:
            index.message_index_offsets.update(self._indexed)
            index.message_index_length = piece.length - index.chunk_length
            if piece.content is not None:
                piece.content += self._buffer[piece.offset + index.chunk_length : self._end_of(piece)]
        self.found.pieces.append(piece)

    def _take_data_end(self, at: int, body: int, end: int) -> None:
        if end - at != DATA_END_BYTES:
            raise Damaged("the record that ends the data has the wrong length")
        if self.found.known is not None and end != self._limit:
            raise Damaged("the data end before their end")
        self.found.data_end = at
        self.found.data_crc = int.from_bytes(self._buffer[body:end], "little")
        if self.found.data_crc:
            crc = 0
            for block in range(0, at, _CRC_BLOCK_BYTES):
                crc = zlib.crc32(self._buffer[block : min(at, block + _CRC_BLOCK_BYTES)], crc)
            self.found.data_crc_wrong = crc != self.found.data_crc

    def _over_damage(self, at: int, reason: str) -> int:
        """Note a loss. Returns the offset of the next valid records, or the end of the file."""
        if (end := self._index_end(at)) is not None:
            return end
        self._close_chunk(at_end=runs_over(self._buffer, at, self._limit))
        if (disguised := self._chunk_in_disguise(at)) is not None:
            end, head, records = disguised
            self._commit(at, end, head, records, *_contents(records))
            return end
        buffer, limit, found = self._buffer, self._limit, self.found
        opcode = buffer[at]
        if only_zeros(buffer, at):
            found.losses.append(
                Loss(at, limit - at, f"{limit - at} zeros", "nothing was written there", ZEROS)
            )
            return limit
        if found.known is not None and limit - at <= DATA_END_BYTES:
            self._note_harmless(at, limit, "the end of the data is damaged")
            return limit
        bad, self._bad_chunk = self._bad_chunk, None
        if found.known is None and is_cut(buffer, at, limit):
            found.losses.append(
                Loss(at, limit - at, _KINDS.get(opcode, "a record"), "the file ends in it", CUT)
            )
            return limit
        after = self._next(at, opcode)
        end = limit if after is None else after
        if after is None and found.known is None and runs_over(buffer, at, limit):
            kind, reason = CUT, "the file ends in it"
        elif after is None:
            kind = JUNK
        else:
            kind = BAD
        index_only = opcode == Opcode.MESSAGE_INDEX and after is not None and buffer[after] == Opcode.CHUNK
        if bad is not None and index_only:
            bad.length = end - bad.offset
        else:
            loss = Loss(at, end - at, f"{end - at} bytes", reason, kind, self._span(at, end))
            found.losses.append(loss)
        return end

    def _index_end(self, at: int) -> int | None:
        """End of the message indexes of the current chunk if this offset is certainly among them, because they can be rebuilt."""
        piece = self._chunk
        listed = self._listed.get(piece.offset) if piece is not None else None
        if piece is None or listed is None:
            return None
        end = piece.offset + listed.chunk_length + listed.message_index_length
        if not at < end <= self._limit:
            return None
        piece.length, self._index_wrong = end - piece.offset, True
        return end

    def _span(self, at: int, end: int) -> tuple[int, int] | None:
        """Log times of the chunks that the summary lists between two offsets."""
        indexes = self.found.known.chunk_indexes if self.found.known is not None else []
        inside = [index for index in indexes if at <= index.chunk_start_offset < end]
        if not inside:
            return None
        return min(index.message_start_time for index in inside), max(
            index.message_end_time for index in inside
        )

    def _next(self, at: int, opcode: int) -> int | None:
        found = self.found
        known = found.known
        channels = found.channels.keys() | (known.channels.keys() if known is not None else set())
        with contextlib.suppress(Damaged):
            end = record_at(self._buffer, at, self._limit)[2]
            if end < self._limit and makes_sense(self._buffer, end, self._limit, channels, messages=True):
                return end  # only the content of this record is damaged, not its length
        if (
            known is not None
            and known.statistics is not None
            and known.statistics.chunk_count
            and not found.runs
        ):
            places = sorted(
                [index.chunk_start_offset for index in known.chunk_indexes]
                + [attachment.offset for attachment in known.attachment_indexes]
                + [metadata.offset for metadata in known.metadata_indexes]
                + [self._limit - DATA_END_BYTES]
            )
            after = bisect_right(places, at)
            if after < len(places):
                return places[after]
        # A damaged chunk also contains messages, which its checksum would have covered.
        messages = opcode != Opcode.CHUNK or bool(found.runs)
        return next_record(self._buffer, at, self._limit, channels, messages)


_KINDS = {Opcode.CHUNK: "a chunk", Opcode.ATTACHMENT: "an attachment", Opcode.MESSAGE: "a message"}


def _contents(records: bytes) -> tuple[list[Schema | Channel], list[tuple[int, int, int, int]]]:
    """Definitions of a chunk, and channel, sequence, log time and offset of its messages."""
    definitions: list[Schema | Channel] = []
    messages = []
    for opcode, body, end in records_of(records):
        if opcode == Opcode.MESSAGE:
            messages.append((*MESSAGE_HEAD.unpack_from(records, body)[:3], body - RECORD_HEAD.size))
        elif opcode == Opcode.SCHEMA:
            definitions.append(parse(Schema, records[body:end]))
        elif opcode == Opcode.CHANNEL:
            definitions.append(parse(Channel, records[body:end]))
    return definitions, messages


def fill_anew(
    piece: Piece,
    records: bytes,
    span_ns: tuple[int, int],
    crc: int,
    by_channel: dict[int, list[tuple[int, int]]],
) -> None:
    """Make a piece of a new chunk with these records, and new message indexes.

    Args:
        span_ns: Log times of the first and last message.
        crc: Checksum of the records; 0 for none.
        by_channel: Log time and offset of the messages, by channel.
    """
    chunk = bytes_of(Chunk("", records, span_ns[1], span_ns[0], crc, len(records)))
    piece.record = chunk_index(piece.offset, len(chunk), span_ns, len(records))
    _index_anew(piece, piece.record, chunk, by_channel)


def _index_anew(
    piece: Piece, index: ChunkIndex, chunk: bytes, by_channel: dict[int, list[tuple[int, int]]]
) -> None:
    """Make a piece of a chunk record and new message indexes."""
    index.message_index_offsets.clear()
    rows = bytearray()
    for channel_id, entries in by_channel.items():
        index.message_index_offsets[channel_id] = piece.offset + len(chunk) + len(rows)
        rows += bytes_of(MessageIndex(channel_id, entries))
    piece.content, index.message_index_length = chunk + bytes(rows), len(rows)
