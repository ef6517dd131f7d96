"""A plain rclpy program: prints each image that it gets, and may answer it. Run by the Python of an rclpy environment.

One line of JSON for each image: its stamp, the digest of its pixels, and monotonic times of its arrival and of the answer [ns]; and one
for each pose: its stamp.
"""

import argparse
import contextlib
import hashlib
import json
import time

import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image


class Answering(Node):
    def __init__(self, options):
        super().__init__("answering")
        self._options = options
        self._commands = (
            self.create_publisher(TwistStamped, options.commands, 1) if options.commands else None
        )
        quality = 10 if options.reliable else qos_profile_sensor_data
        self.create_subscription(Image, options.images, self._see, quality)
        if options.poses:
            self.create_subscription(PoseStamped, options.poses, self._note, 1000)

    def _note(self, pose):
        print(json.dumps({"pose_ns": pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec}), flush=True)

    def _see(self, image):
        line = {"arrived_ns": time.monotonic_ns()}
        if self._commands is not None:
            command = TwistStamped()
            command.header.stamp = image.header.stamp
            command.twist.linear.x = self._options.speed
            line["answered_ns"] = time.monotonic_ns()
            self._commands.publish(command)
        stamp = image.header.stamp
        line["stamp_ns"] = stamp.sec * 10**9 + stamp.nanosec
        if self._options.digest:
            line["sha256"] = hashlib.sha256(bytes(image.data)).hexdigest()
            line["shape"] = [image.height, image.width, image.encoding, image.step]
        print(json.dumps(line), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", default="/image_raw")
    parser.add_argument("--commands", default="", help="answer each image there")
    parser.add_argument("--speed", type=float, default=0.5)
    parser.add_argument("--digest", action="store_true")
    parser.add_argument(
        "--reliable", action="store_true", help="rclpy's default QoS instead of that of sensor data"
    )
    parser.add_argument("--poses", default="", help="note each pose there")
    options = parser.parse_args()
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Answering(options))


if __name__ == "__main__":
    main()
