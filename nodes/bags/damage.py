"""Describes the losses of a damaged file as text."""

from __future__ import annotations

from nodes.bags.scanned import Loss, Scan
from nodes.runtime.clock import NS_PER_S


def describe(scan: Scan, loss: Loss) -> str:
    """Describe a loss: its offset, times, topics and reason."""
    words = [f"{loss.what} at byte {loss.offset}"]
    details = []
    if loss.span_ns is not None and loss.span_ns[1]:
        start = min(scan.start_ns, loss.span_ns[0]) if scan.counts else loss.span_ns[0]
        first, last = ((moment - start) / NS_PER_S for moment in loss.span_ns)
        details.append(
            f"log times {loss.span_ns[0]} to {loss.span_ns[1]} ns, {first:.3f} to {last:.3f} s after the first message"
        )
    if loss.counts:
        known = dict(scan.known.channels if scan.known is not None else {}) | scan.channels
        topics = [
            f"{count} of {known[i].topic if i in known else f'channel {i}'}"
            for i, count in loss.counts.items()
        ]
        details.append(f"about {', '.join(topics[:8])}{' ...' if len(topics) > 8 else ''}")
    if details:
        words.append(f"({'; '.join(details)})")
    return f"{' '.join(words)}: {loss.reason}"
