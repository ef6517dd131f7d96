"""A program of ``zenoh_ros2_sdk``, another implementation of ``rmw_zenoh``'s wire: prints what it gets, answers images, looks around.

Arguments: the port of the router, the domain, and a JSON file with the definition of each type, of which it computes the hashes. One
line of JSON for each message, and one for each topic of ``--about``.
"""

import argparse
import hashlib
import json
import threading
import time
from pathlib import Path

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_info
from zenoh_ros2_sdk.utils import get_type_hash

IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
_PRINTING = threading.Lock()


def note(line):
    with _PRINTING:
        print(json.dumps(line), flush=True)


def plain(value):
    """The fields of a message as plain data."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list) else value


class Peer:
    """Opens publishers and subscribers for the types of a file."""

    def __init__(self, options):
        self.where = {"router_port": options.port, "domain_id": options.domain}
        self._definitions = json.loads(options.definitions.read_text())

    def described(self, typename):
        """Arguments that describe a type; the hash is computed here."""
        parts = self._definitions[typename]
        rule = "\n" + "=" * 80 + "\n"
        nested = {name: text for name, text in parts.items() if name != typename}
        whole = parts[typename] + "".join(f"{rule}MSG: {name}\n{text}" for name, text in nested.items())
        stated = get_type_hash(typename, parts[typename], nested)
        note({"type": typename, "hash": stated})
        return {"msg_type": typename, "msg_definition": whole, "type_hash": stated, **self.where}


def answer(peer, name, speed):
    """Answer each image with a speed."""
    commands = ROS2Publisher(topic=name, node_name="answering", **peer.described(TWIST))
    made = commands.session_mgr.store.types

    def see(image):
        zero = made["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        forward = made["geometry_msgs/msg/Vector3"](x=speed, y=0.0, z=0.0)
        twist = made["geometry_msgs/msg/Twist"](linear=forward, angular=zero)
        commands.publish(header=image.header, twist=twist)
        stamp = image.header.stamp
        note(
            {
                "stamp_ns": stamp.sec * 10**9 + stamp.nanosec,
                "sha256": hashlib.sha256(bytes(image.data)).hexdigest(),
                "shape": [image.height, image.width, image.encoding, image.step],
            }
        )

    return ROS2Subscriber(topic="/image_raw", callback=see, node_name="answering", **peer.described(IMAGE))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("domain", type=int)
    parser.add_argument("definitions", type=Path)
    parser.add_argument("--commands", default="", help="answer each image there")
    parser.add_argument("--speed", type=float, default=0.5)
    parser.add_argument("--read", nargs="*", default=[], help="NAME=TYPE: print each message")
    parser.add_argument("--about", nargs="*", default=[], help="print who publishes and reads a topic")
    options = parser.parse_args()
    peer = Peer(options)
    kept = [answer(peer, options.commands, options.speed)] if options.commands else []
    for name, typename in (each.split("=") for each in options.read):
        see = lambda message, name=name: note({"topic": name, "message": plain(message)})  # noqa: E731
        kept.append(ROS2Subscriber(topic=name, callback=see, node_name="reading", **peer.described(typename)))
    note({"ready": True})
    while True:
        for name in options.about:
            found = get_topic_info(name, verbose=True, **peer.where)
            note({"about": name, "found": None if found is None else plain(found)})
        time.sleep(0.5)


if __name__ == "__main__":
    main()
