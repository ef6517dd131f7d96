"""A plain rclpy program: prints each image that it gets, and may answer it. Run by the Python of an rclpy environment.

One line of JSON for each image: its stamp, the digest of its pixels, and monotonic times of its arrival and of the answer [ns].
"""

import argparse
import contextlib
import hashlib
import json
import time

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image


class Answering(Node):
    def __init__(self, images, commands, speed_mps, digest, reliable):
        super().__init__("answering")
        self._speed_mps, self._digest = speed_mps, digest
        self._commands = self.create_publisher(TwistStamped, commands, 1) if commands else None
        self.create_subscription(Image, images, self._see, 10 if reliable else qos_profile_sensor_data)

    def _see(self, image):
        line = {"arrived_ns": time.monotonic_ns()}
        if self._commands is not None:
            command = TwistStamped()
            command.header.stamp = image.header.stamp
            command.twist.linear.x = self._speed_mps
            line["answered_ns"] = time.monotonic_ns()
            self._commands.publish(command)
        stamp = image.header.stamp
        line["stamp_ns"] = stamp.sec * 10**9 + stamp.nanosec
        if self._digest:
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
    options = parser.parse_args()
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(
            Answering(options.images, options.commands, options.speed, options.digest, options.reliable)
        )


if __name__ == "__main__":
    main()
