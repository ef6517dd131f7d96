"""Reads a bag's messages of the topic table, decoded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nodes.bags.reader import read_messages
from nodes.runtime.messages import decode, pose_matrix, stamp_ns
from nodes.runtime.topics import topic as topic_row


def read_decoded(bag: Path, topic: str) -> Iterator[Any]:
    """Yield the messages of a topic of the topic table in order of log time."""
    typename = topic_row(topic).type
    return (decode(typename, message.cdr) for message in read_messages(bag, [topic]))


def read_poses(bag: Path, topic: str) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield stamp [ns] and transform ``[4, 4]`` of every finite pose of a topic, in order of log time."""
    for message in read_decoded(bag, topic):
        T = pose_matrix(message)
        if np.isfinite(T).all():
            yield stamp_ns(message), T
