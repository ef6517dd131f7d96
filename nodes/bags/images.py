"""Reads the camera images of a bag, recorded raw or compressed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nodes.bags.reader import read_info, read_messages
from nodes.runtime.errors import BagError
from nodes.runtime.image_parts import IMAGE_TYPE
from nodes.runtime.messages import decode
from nodes.runtime.pictures import COMPRESSED_TOPIC, RAW_TOPIC

CAMERA_TOPICS = (RAW_TOPIC, COMPRESSED_TOPIC)


def image_topic(bag: Path) -> str:
    """Return the first topic of the camera that has messages.

    Raises:
        BagError: None of the topics has messages.
    """
    topics = {topic.name: topic for topic in read_info(bag).topics if topic.count}
    for name in CAMERA_TOPICS:
        if name in topics:
            return name
    raise BagError(
        f"expected images on {' or '.join(CAMERA_TOPICS)} in {bag}, got none; it has {', '.join(topics) or 'no message'}"
    )


def image_messages(bag: Path, topic: str) -> Iterator[Any]:
    """Yield the images of a topic as ``sensor_msgs/Image`` in order of log time. Compressed images are decoded.

    Args:
        topic: A topic with images. It need not be in the topic table.
    """
    for message in read_messages(bag, [topic], types={topic: IMAGE_TYPE}):
        yield decode(IMAGE_TYPE, message.cdr)
