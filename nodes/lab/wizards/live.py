"""Records a bag of a running launch for a calibration, so that its data are kept."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from nodes.bags.writer import BagWriter
from nodes.runtime.bus import Bus
from nodes.runtime.errors import BagError


def record_live(
    run_dir: Path,
    topics: Sequence[str],
    duration_s: float,
    bag: Path,
    attachments: Mapping[str, bytes] | None = None,
) -> Path:
    """Record topics for a given time.

    Args:
        bag: New folder.
        attachments: Content of files to attach by name: what the recorded numbers depend on.

    Raises:
        BagError: One of the topics had no messages.
    """
    heard = dict.fromkeys(topics, 0)
    with Bus(run_dir) as bus, BagWriter(bag, attachments) as writer:
        for topic in topics:
            bus.subscribe(topic, queue=2000)
        end = time.monotonic() + duration_s
        while (left := end - time.monotonic()) > 0.0:
            bus.wait(min(left, 0.1))
            for received in bus.receive():
                info = received.info
                writer.write(
                    received.topic, info.raw, info.receive_real_ns, info.publish_real_ns, info.sequence
                )
                heard[received.topic] += 1
            writer.flush()
    silent = [topic for topic, count in heard.items() if count == 0]
    if silent:
        raise BagError(
            f"expected messages of {', '.join(silent)} within {duration_s:g} s, got none; are their nodes running?"
        )
    return bag
