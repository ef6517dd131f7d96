"""A plain rclpy car: camera, odometry and motor driver in one program. Run by the Python of an rclpy environment.

It drives as it is told (kinematic bicycle, rear axle) and has no time-out of its own, so that only messages stop it. One line of JSON
for each command: its arrival on the monotonic clock [ns], and its speed [m/s].
"""

import argparse
import contextlib
import json
import math
import time

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

ODOMETRY_S, IMAGE_S = 0.02, 0.1


class Car(Node):
    def __init__(self, commands, x_m, y_m):
        super().__init__("car")
        self._x, self._y, self._yaw = x_m, y_m, 0.0
        self._speed_mps = self._yaw_radps = 0.0
        self._pixels = bytes(188 * 336 * 3)
        self._odometry = self.create_publisher(Odometry, "/odom", 10)
        self._images = self.create_publisher(Image, "/image_raw", qos_profile_sensor_data)
        self.create_subscription(TwistStamped, commands, self._obey, 10)
        self.create_timer(ODOMETRY_S, self._move)
        self.create_timer(IMAGE_S, self._look)

    def _obey(self, command):
        self._speed_mps, self._yaw_radps = command.twist.linear.x, command.twist.angular.z
        print(json.dumps({"mono_ns": time.monotonic_ns(), "speed_mps": self._speed_mps}), flush=True)

    def _move(self):
        self._yaw += self._yaw_radps * ODOMETRY_S
        self._x += self._speed_mps * ODOMETRY_S * math.cos(self._yaw)
        self._y += self._speed_mps * ODOMETRY_S * math.sin(self._yaw)
        message = Odometry()
        message.header.stamp, message.header.frame_id = self.get_clock().now().to_msg(), "map"
        message.pose.pose.position.x, message.pose.pose.position.y = self._x, self._y
        message.pose.pose.orientation.z = math.sin(self._yaw / 2)
        message.pose.pose.orientation.w = math.cos(self._yaw / 2)
        self._odometry.publish(message)

    def _look(self):
        message = Image(height=188, width=336, encoding="rgb8", step=336 * 3)
        message.header.stamp = self.get_clock().now().to_msg()
        message.data.frombytes(self._pixels)
        self._images.publish(message)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands")
    parser.add_argument("x_m", type=float)
    parser.add_argument("y_m", type=float)
    options = parser.parse_args()
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Car(options.commands, options.x_m, options.y_m))


if __name__ == "__main__":
    main()
