"""Result of scanning an MCAP file: pieces to keep, losses, definitions and counts."""

from __future__ import annotations

from dataclasses import dataclass, field

from mcap.records import AttachmentIndex, Channel, ChunkIndex, Header, MetadataIndex, Schema, Statistics
from mcap.summary import Summary

from nodes.bags.summary import Ending
from nodes.runtime.clock import NS_PER_S

# How a loss came about.
BAD, CUT, ZEROS, JUNK = "bad", "cut", "zeros", "junk"


@dataclass
class Piece:
    """Bytes of the file to keep, or their replacement.

    Attributes:
        offset: Offset in the file.
        length: Number of bytes.
        record: Entry in the summary, with the offsets of the file; None without an entry.
        content: Bytes that replace them; ``record`` then refers to these bytes at ``offset``.
    """

    offset: int
    length: int
    record: ChunkIndex | AttachmentIndex | MetadataIndex | None = None
    content: bytes | None = None


def chunk_index(
    at: int, length: int, span_ns: tuple[int, int], size: int, packed: tuple[str, int] | None = None
) -> ChunkIndex:
    """Entry in the summary of a chunk without message indexes.

    Args:
        at: Offset of its record.
        length: Length of its record [bytes].
        span_ns: Log times of its first and last message.
        size: Size of its content [bytes].
        packed: Compression and size of the compressed content; None if it is not compressed.
    """
    compression, compressed_size = packed or ("", size)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=at,
        compression=compression,
        compressed_size=compressed_size,
        message_end_time=span_ns[1],
        message_index_length=0,
        message_index_offsets={},
        message_start_time=span_ns[0],
        uncompressed_size=size,
    )


@dataclass
class Loss:
    """Bytes that cannot be kept.

    Attributes:
        offset: Offset in the file.
        length: Number of bytes.
        what: Their description, as far as known.
        reason: Why they cannot be kept.
        kind: ``bad`` (a whole record with a wrong checksum), ``cut``, ``zeros``, or ``junk``.
        span_ns: Log times of their first and last message, if known [ns since 1970].
        counts: Number of their messages by channel, as far as known.
        harmless: Whether they contained no message, attachment or metadata.
    """

    offset: int
    length: int
    what: str
    reason: str
    kind: str
    span_ns: tuple[int, int] | None = None
    counts: dict[int, int] = field(default_factory=dict)
    harmless: bool = False


@dataclass
class MessageRun:
    """Consecutive messages outside chunks. Its fields have the names of a `ChunkIndex`, so that it is read as a chunk is."""

    chunk_start_offset: int
    chunk_length: int
    message_start_time: int
    message_end_time: int
    message_index_offsets: set[int]


@dataclass
class Scan:
    """Contents and damage of a file.

    Attributes:
        size: Size of the file [bytes].
        ending: The footer; None if it is missing.
        known: The summary; None if it is missing or damaged.
        summary_damage: Damage of the summary; empty if undamaged.
        data_end: Offset of the record that ends the data; None if it is missing.
        data_crc: Checksum of all data; 0 means none.
        data_crc_wrong: Whether this checksum is wrong.
        pieces: Pieces to keep, in order.
        losses: Bytes that are lost.
        fixes: Repairs without a loss.
        headers, schemas, channels: Records of the data section; schemas and channels by id.
        counts: Number of messages by channel id.
        gaps: Number of missing sequence numbers by channel id.
        sequences: Last sequence number by channel id.
        start_ns, end_ns: Log times of the first and the last message [ns since 1970].
        unchecked_chunks: Number of chunks without a checksum.
        unchecked_messages: Number of messages outside chunks, which have no checksum.
        runs: Messages outside chunks.
        insert_at: Index of the piece before which the lost definitions are inserted.
        lost_definitions: Definitions that the file has lost.
    """

    size: int = 0
    ending: Ending | None = None
    known: Summary | None = None
    summary_damage: str = ""
    data_end: int | None = None
    data_crc: int = 0
    data_crc_wrong: bool = False
    pieces: list[Piece] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    fixes: list[str] = field(default_factory=list)
    header: Header | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    gaps: dict[int, int] = field(default_factory=dict)
    sequences: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    unchecked_chunks: int = 0
    unchecked_messages: int = 0
    runs: list[MessageRun] = field(default_factory=list)
    insert_at: int | None = None
    lost_definitions: list[Schema | Channel] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Number of messages that are kept."""
        return sum(self.counts.values())

    @property
    def complete(self) -> bool:
        """Whether the file is complete: end of data, footer, magic."""
        return self.data_end is not None and self.ending is not None

    @property
    def whole(self) -> bool:
        """Whether the file is intact."""
        wrong = (
            self.losses or self.fixes or self.lost_definitions or self.summary_damage or self.data_crc_wrong
        )
        return self.complete and not wrong

    @property
    def unchecked(self) -> str:
        """Why damage to messages may go unnoticed; empty if checksums cover them."""
        if self.data_crc and not self.data_crc_wrong:
            return ""
        parts = []
        if self.unchecked_messages:
            parts.append(f"{self.unchecked_messages} of its messages are outside chunks")
        if self.unchecked_chunks:
            parts.append(f"{self.unchecked_chunks} of its chunks have no checksum")
        return " and ".join(parts)

    def count(self, channel_id: int, sequence: int, log_ns: int) -> None:
        """Count a message and the missing ones before it. A decreasing sequence number means a restarted publisher."""
        if not self.counts:
            self.start_ns = self.end_ns = log_ns
        elif log_ns > self.end_ns:
            self.end_ns = log_ns
        elif log_ns < self.start_ns:
            self.start_ns = log_ns
        self.counts[channel_id] = self.counts.get(channel_id, 0) + 1
        last = self.sequences.get(channel_id)
        if last is not None and sequence > last + 1:
            self.gaps[channel_id] = self.gaps.get(channel_id, 0) + sequence - last - 1
        self.sequences[channel_id] = sequence

    def statistics(self, attachments: int, chunks: int, metadata: int) -> Statistics:
        """Statistics for the summary of a file with so many attachments, chunks and metadata records."""
        return Statistics(
            attachment_count=attachments,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=chunks,
            message_count=self.messages,
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=metadata,
            schema_count=len(self.schemas),
        )

    def loses_more_than_the_tail(self) -> list[Loss]:
        """Losses before the end of the kept data, or in a finished file."""
        last = max((piece.offset for piece in self.pieces if piece.length), default=0)
        tail_is_fine = self.ending is None and self.data_end is None
        return [
            loss
            for loss in self.losses
            if not loss.harmless and (not tail_is_fine or loss.offset < last or loss.kind == JUNK)
        ]

    def describe(self, loss: Loss) -> str:
        """Describe a loss: its offset, times, topics and reason."""
        words = [f"{loss.what} at byte {loss.offset}"]
        details = []
        if loss.span_ns is not None and loss.span_ns[1]:
            start = min(self.start_ns, loss.span_ns[0]) if self.counts else loss.span_ns[0]
            first, last = ((moment - start) / NS_PER_S for moment in loss.span_ns)
            details.append(
                f"log times {loss.span_ns[0]} to {loss.span_ns[1]} ns, {first:.3f} to {last:.3f} s after the first message"
            )
        if loss.counts:
            known = dict(self.known.channels if self.known is not None else {}) | self.channels
            topics = [
                f"{count} of {known[i].topic if i in known else f'channel {i}'}"
                for i, count in loss.counts.items()
            ]
            details.append(f"about {', '.join(topics[:8])}{' ...' if len(topics) > 8 else ''}")
        if details:
            words.append(f"({'; '.join(details)})")
        return f"{' '.join(words)}: {loss.reason}"
