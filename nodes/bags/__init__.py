"""Recordings: writing, reading, checking, repairing, playing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

__all__ = [
    "BagError",
    "BagInfo",
    "BagMessage",
    "BagWriter",
    "SplitLimits",
    "TopicInfo",
    "diagnose",
    "extract_attachments",
    "read_attachment",
    "read_attachments",
    "read_info",
    "read_messages",
    "repair_bag",
]

if TYPE_CHECKING:
    from nodes.bags.check import diagnose
    from nodes.bags.info import BagInfo, BagMessage, TopicInfo
    from nodes.bags.reader import (
        extract_attachments,
        read_attachment,
        read_attachments,
        read_info,
        read_messages,
    )
    from nodes.bags.repair_parts import repair_bag
    from nodes.bags.writer import BagWriter, SplitLimits
    from nodes.runtime.errors import BagError
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "nodes.bags.check": "diagnose",
            "nodes.bags.info": "BagInfo BagMessage TopicInfo",
            "nodes.bags.reader": "extract_attachments read_attachment read_attachments read_info read_messages",
            "nodes.bags.repair_parts": "repair_bag",
            "nodes.bags.writer": "BagWriter SplitLimits",
            "nodes.runtime.errors": "BagError",
        },
    )
