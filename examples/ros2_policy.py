"""A driving policy as a plain ROS 2 node: rclpy and ONNX Runtime, nothing of advnerf.

    .venv/bin/advnerf launch launch/ros2.launch.yaml --folder runs/ros2
    .venv-ros2/bin/python examples/ros2_policy.py policy.onnx

Run it in any ROS 2 environment; `make setup-ros2` makes `.venv-ros2`. It answers each image with a command that carries the image's
stamp. Without the stamp the command does not count, because nobody could say how old its image is.
"""

from __future__ import annotations

import argparse
import contextlib

import cv2
import numpy as np
import onnxruntime
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image


class Policy(Node):
    """Images in, speed and yaw rate out."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("policy")
        self._options = options
        self._network = onnxruntime.InferenceSession(options.network, providers=["CPUExecutionProvider"])
        self._input = self._network.get_inputs()[0]
        self._commands = self.create_publisher(TwistStamped, "/cmd_vel", 1)
        self.create_subscription(Image, "/image_raw", self._see, qos_profile_sensor_data)

    def _see(self, image: Image) -> None:
        steering_rad = self._steer(np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3))
        command = TwistStamped()
        command.header.stamp = image.header.stamp
        command.twist.linear.x = self._options.speed
        command.twist.angular.z = self._options.speed * np.tan(steering_rad) / self._options.wheelbase
        self._commands.publish(command)

    def _steer(self, rgb: np.ndarray) -> float:
        """Wheel angle [rad], left positive, of an image ``[H, W, 3]`` uint8."""
        top, height = self._options.rows
        *_, rows, columns = self._input.shape
        seen = cv2.resize(rgb[top : top + height], (columns, rows), interpolation=cv2.INTER_AREA)
        batch = seen.astype(np.float32).transpose(2, 0, 1)[None] / 255.0
        return float(self._network.run(None, {self._input.name: batch})[0].squeeze())


def main() -> None:
    """Drive until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", help="ONNX file: images [B, 3, H, W] in 0..1 to wheel angles [rad]")
    parser.add_argument("--rows", type=int, nargs=2, default=(24, 111), metavar=("TOP", "HEIGHT"))
    parser.add_argument("--speed", type=float, default=0.8, help="[m/s]")
    parser.add_argument("--wheelbase", type=float, default=0.25, help="distance of the axles [m]")
    options = parser.parse_args()
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Policy(options))


if __name__ == "__main__":
    main()
