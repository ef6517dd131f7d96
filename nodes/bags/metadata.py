"""Metadata of a bag: topics, counts and times, and ``metadata.yaml`` in the format of rosbag2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml

from nodes.runtime.messages import ROS_DISTRO

# The C emitter writes the same text ten times faster.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@dataclass
class Contents:
    """Contents of a bag according to its summary.

    Attributes:
        types: Type name by topic.
        hashes: RIHS01 hash by topic.
        counts: Number of messages by topic.
        lost: Number of published messages by topic that did not reach the recorder, if it counted them.
        start_ns: Log time of the first message [ns since 1970]; 0 without messages.
        end_ns: Log time of the last message [ns since 1970].
    """

    types: dict[str, str] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(self.counts.values())

    @classmethod
    def of(
        cls,
        channels: Mapping[int, Any],
        schemas: Mapping[int, Any],
        counts: Mapping[int, int],
        span_ns: tuple[int, int],
    ) -> Contents:
        """Contents of a file: its records and its numbers of messages, by id, and the log times of the first and the last message."""
        contents = cls(start_ns=span_ns[0], end_ns=span_ns[1])
        for channel in channels.values():
            schema = schemas.get(channel.schema_id)
            rihs = channel.metadata.get("topic_type_hash", "")
            contents.add_topic(channel.topic, schema.name if schema else "", rihs)
            contents.counts[channel.topic] += counts.get(channel.id, 0)
        return contents

    def add_topic(self, topic: str, typename: str, rihs: str) -> None:
        """Add a topic."""
        self.types[topic], self.hashes[topic] = typename, rihs
        self.counts.setdefault(topic, 0)

    def add_message(self, topic: str, log_ns: int) -> None:
        """Count a message."""
        self.start_ns = min(self.start_ns, log_ns) if self.messages else log_ns
        self.end_ns = max(self.end_ns, log_ns)
        self.counts[topic] += 1

    def add(self, other: Contents) -> None:
        """Add the contents of another file."""
        if other.messages:
            self.start_ns = min(self.start_ns, other.start_ns) if self.messages else other.start_ns
            self.end_ns = max(self.end_ns, other.end_ns)
        for topic, typename in other.types.items():
            self.add_topic(topic, typename, other.hashes[topic])
            self.counts[topic] += other.counts[topic]


def rosbag2_metadata(files: Mapping[str, Contents]) -> str:
    """Make the text of ``metadata.yaml``, version 9, of a bag with these files in order, by name."""
    contents = Contents()
    for each in files.values():
        contents.add(each)
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": typename,
                "serialization_format": "cdr",
                "offered_qos_profiles": [],
                "type_description_hash": contents.hashes[topic],
            },
            "message_count": contents.counts[topic],
        }
        for topic, typename in contents.types.items()
    ]
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        **_times(contents.start_ns, contents.end_ns),
        "message_count": contents.messages,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(files),
        "files": [
            {
                "path": name,
                **dict(reversed(_times(each.start_ns, each.end_ns).items())),
                "message_count": each.messages,
            }
            for name, each in files.items()
        ],
        "custom_data": None,
        "ros_distro": ROS_DISTRO,
    }
    # No YAML aliases, because rosbag2's reader does not support them.
    return str(yaml.dump({"rosbag2_bagfile_information": information}, Dumper=_PlainDumper, sort_keys=False))


def _times(start_ns: int, end_ns: int) -> dict[str, dict[str, int]]:
    return {
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
    }


class _PlainDumper(_DUMPER):
    def ignore_aliases(self, data: object) -> bool:
        return True
