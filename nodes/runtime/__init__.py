"""Building blocks of every node: messages, topics, bus, clock, loop, process, configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

__all__ = [
    "TOPICS",
    "Bus",
    "Clock",
    "ConfigError",
    "Inbox",
    "ManualClock",
    "MessageError",
    "MessageInfo",
    "Node",
    "NodeContext",
    "NodeFinished",
    "Now",
    "Out",
    "ReaderThread",
    "Received",
    "SystemClock",
    "Topic",
    "camera_info_message",
    "decode",
    "drive_message",
    "encode",
    "header",
    "image_message",
    "pose_matrix",
    "pose_message",
    "rgb_image",
    "run_node",
    "run_node_main",
    "stamp_ns",
    "topic",
    "types",
]

if TYPE_CHECKING:
    from advnerf_core.errors import ConfigError
    from nodes.runtime.bus import Bus, Received
    from nodes.runtime.clock import Clock, ManualClock, Now, SystemClock
    from nodes.runtime.errors import MessageError, NodeFinished
    from nodes.runtime.inbox import Inbox, ReaderThread
    from nodes.runtime.messages import (
        camera_info_message,
        decode,
        drive_message,
        encode,
        header,
        image_message,
        pose_matrix,
        pose_message,
        stamp_ns,
        types,
    )
    from nodes.runtime.node import Node, NodeContext, Out
    from nodes.runtime.pictures import rgb_image
    from nodes.runtime.process import run_node, run_node_main
    from nodes.runtime.topics import TOPICS, Topic, topic
    from nodes.runtime.wire import MessageInfo
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "nodes.runtime.bus": "Bus Received",
            "nodes.runtime.clock": "Clock ManualClock Now SystemClock",
            "advnerf_core.errors": "ConfigError",
            "nodes.runtime.errors": "MessageError NodeFinished",
            "nodes.runtime.inbox": "Inbox ReaderThread",
            "nodes.runtime.messages": "camera_info_message decode drive_message encode header image_message pose_matrix pose_message stamp_ns types",
            "nodes.runtime.node": "Node NodeContext Out",
            "nodes.runtime.pictures": "rgb_image",
            "nodes.runtime.process": "run_node run_node_main",
            "nodes.runtime.topics": "TOPICS Topic topic",
            "nodes.runtime.wire": "MessageInfo",
        },
    )
