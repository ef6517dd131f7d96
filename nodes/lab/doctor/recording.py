"""Estimates the data rate of a recording: images by size and rate, other topics by the topic table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from nodes.runtime.topics import STATUS_RATE_HZ, TOPICS
from nodes.runtime.topics import topic as topic_row

_PICTURES = ("sensor_msgs/msg/Image",)
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
# Size of a JPEG of quality 90 of a room as a fraction of the raw image; and the size of other messages, with overhead in the bag.
_JPEG_SHARE, _SMALL_BYTES = 0.17, 400
_BY_CAMERA = ("camera", "compositor")


@dataclass(frozen=True)
class ImageFormat:
    """Format of the camera's images.

    Attributes:
        compressed: Whether JPEG images are also published.
    """

    width: int = 336
    height: int = 188
    rate_hz: float = 10.0
    compressed: bool = False


def bytes_per_s(
    pictures: ImageFormat,
    topics: Iterable[str] | None = None,
    publishers: Iterable[str] | None = None,
    statuses: int = 8,
) -> float:
    """Data rate of a bag [bytes/s].

    Args:
        topics: Recorded topics; None means the whole topic table.
        publishers: Roles of the running nodes; None means all.
    """
    roles = None if publishers is None else set(publishers)
    total = statuses * STATUS_RATE_HZ * _SMALL_BYTES
    for name in TOPICS if topics is None else topics:
        row = topic_row(name)
        if row.rate_hz is None or (roles is not None and row.publisher not in roles):
            continue
        by_camera = row.publisher in _BY_CAMERA
        raw = pictures.width * pictures.height * 3
        if row.type in _PICTURES:
            total += pictures.rate_hz * raw
        elif row.type == _COMPRESSED:
            total += pictures.compressed * pictures.rate_hz * raw * _JPEG_SHARE
        else:
            total += (pictures.rate_hz if by_camera else row.rate_hz) * _SMALL_BYTES
    return total
