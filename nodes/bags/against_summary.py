"""Compares a scan with the summary of the file: definitions that only the summary has, and contradictions."""

from __future__ import annotations

from mcap.records import Channel, ChunkIndex, Schema
from mcap.summary import Summary

from nodes.bags.records import MAGIC
from nodes.bags.scanned import Scan


def restore_definitions(found: Scan) -> None:
    """Restore lost definitions of kept messages: from the summary, or else without a name."""
    known = found.known if found.known is not None else Summary()
    for channel_id in sorted(found.counts.keys() - found.channels.keys()):
        channel = known.channels.get(channel_id) or Channel(
            channel_id, f"/unnamed_channel_{channel_id}", "", {}, 0
        )
        found.channels[channel_id] = channel
        found.lost_definitions.append(channel)
    for channel in list(found.channels.values()):
        if channel.schema_id and channel.schema_id not in found.schemas:
            schema = known.schemas.get(channel.schema_id) or Schema(channel.schema_id, b"", "", "unknown")
            found.schemas[schema.id] = schema
            found.lost_definitions.append(schema)
    if found.lost_definitions:
        # A schema precedes its channels, and both precede their messages.
        found.lost_definitions.sort(key=lambda record: isinstance(record, Channel))
        first = min((loss.offset for loss in found.losses if not loss.harmless), default=0)
        found.insert_at = next(
            (i for i, piece in enumerate(found.pieces) if piece.offset >= max(first, len(MAGIC) + 1)),
            len(found.pieces),
        )


def contradiction(found: Scan, known: Summary) -> str:
    """Contradiction between summary and data; empty without one. A summary may be incomplete."""
    statistics = known.statistics
    counts = {channel_id: n for channel_id, n in found.counts.items() if n}
    if statistics is not None:
        listed = {channel_id: n for channel_id, n in statistics.channel_message_counts.items() if n}
        if statistics.message_count != found.messages or (listed and listed != counts):
            return f"its summary lists {statistics.message_count} messages, but it has {found.messages}"
    chunks = {
        (piece.record.chunk_start_offset, piece.record.chunk_length)
        for piece in found.pieces
        if isinstance(piece.record, ChunkIndex)
    }
    if (
        known.chunk_indexes
        and {(i.chunk_start_offset, i.chunk_length) for i in known.chunk_indexes} != chunks
    ):
        return "its summary lists other chunks than it has"
    return ""
