"""A plain rclpy program: prints each message of some topics as JSON. Run by the Python of an rclpy environment.

Arguments: NAME=PACKAGE/TYPE. Subscriptions have rclpy's default QoS: reliable, depth 10.
"""

import contextlib
import importlib
import json
import sys

import rclpy
from rclpy.executors import ExternalShutdownException


def plain(value):
    """The fields of a message as plain data."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):  # arrays of numbers
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, bytes):
        return list(value)
    return value


def main():
    rclpy.init()
    node = rclpy.create_node("listening")
    for argument in sys.argv[1:]:
        name, _, typename = argument.partition("=")
        package, kind = typename.split("/")
        found = getattr(importlib.import_module(f"{package}.msg"), kind)
        node.create_subscription(
            found, name, lambda message, name=name: print(json.dumps([name, plain(message)]), flush=True), 10
        )
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
