"""Bags in several parts, as others write them."""

from pathlib import Path

import yaml
from mcap.writer import CompressionType, Writer

from nodes.runtime.messages import type_definition
from nodes.runtime.topics import topic as topic_row
from tests.support.bag_samples import START_NS, sample


def foreign_part(path: Path, messages, attachments=(), chunked=True):
    """A part with messages ``(topic, log time, sequence)``, in the order in which they are given."""
    writer = Writer(str(path), chunk_size=2000, compression=CompressionType.ZSTD, use_chunking=chunked)
    writer.start(profile="ros2")
    for name, content in attachments:
        writer.add_attachment(0, 0, name, "text/plain", content)
    channels = {}
    for topic, log_ns, sequence in messages:
        typename = topic_row(topic).type
        if topic not in channels:
            schema = writer.register_schema(typename, "ros2msg", type_definition(typename).encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], log_ns, sample(typename, START_NS), log_ns, sequence)
    writer.finish()


def foreign_metadata(folder: Path, names, counts):
    """``metadata.yaml`` as rosbag2 writes it for some files."""
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": topic_row(topic).type,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": count,
        }
        for topic, count in counts.items()
    ]
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": 10**9},
        "message_count": sum(counts.values()),
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(names),
        "files": [],
    }
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
