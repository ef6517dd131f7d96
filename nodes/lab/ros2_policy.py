"""A policy that runs in ROS 2, queried over DDS or Zenoh: for black-box attacks, ``advnerf policy check``, and drives in a world.

The ROS program gets whole camera images, as it does on the car, and answers each with a command that carries the image's stamp.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from advnerf_core.policies.adapter import AdaptedPolicy, adapt
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, VehicleCalibration, load_calibration
from nodes.linking.ros2.answers import OneWriter, stamp_of_cdr
from nodes.linking.ros2.conversions import ACKERMANN, IMAGE, TWIST, Setting, conversion
from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.samples import Heard
from nodes.linking.ros2.transports import Transport, open_transport
from nodes.linking.ros2.zenoh_settings import ZenohSettings
from nodes.runtime.errors import BusError
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import decode, encode, image_message

_FIND_S, _ANSWER_S, _AGAIN_S, _POLL_S = 30.0, 10.0, 0.5, 0.0005
# The loopback: a search sends thousands of queries and needs no network.
_INTERFACE = "lo"


class Ros2Network(nn.Module):
    """Queries a ROS 2 program for the steering of images, one after the other.

    Args:
        command_type: ``geometry_msgs/msg/TwistStamped`` or ``ackermann_msgs/msg/AckermannDriveStamped``.
        wheelbase_m: Distance of the axles, which turns yaw rates into wheel angles [m].
    """

    def __init__(
        self,
        domain_id: int,
        images: str,
        commands: str,
        command_type: str,
        wheelbase_m: float,
        transport: Transport = "auto",
    ) -> None:
        super().__init__()
        self._names, self._type, self._setting = (images, commands), command_type, Setting(wheelbase_m)
        self._inbox: Inbox[list[Heard]] = Inbox(100)
        self._side = open_transport(
            transport,
            domain_id,
            _INTERFACE,
            ZenohSettings(),
            [Endpoint(images, IMAGE, reliable=True, depth=5)],
            [Endpoint(commands, command_type, reliable=True, depth=10)],
            self._inbox,
        )
        self._stamp_ns = 0
        self.identity = f"ROS 2 program, domain {domain_id}, {images} to {commands} ({command_type})"
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """Steering ``[B]`` [rad], left positive, of camera images ``[B, 3, H, W]`` RGB in 0..1."""
        self._find()
        pixels = (images.detach().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(0, 2, 3, 1)
        return torch.tensor([self._ask(image.numpy()) for image in pixels.cpu()], dtype=images.dtype)

    def _find(self) -> None:
        deadline = time.monotonic() + _FIND_S
        while not (self._side.present(0) and self._side.readers_of(0)):
            if time.monotonic() > deadline:
                told = (
                    f"expected a ROS 2 program that subscribes to {self._names[0]} and publishes {self._type} on {self._names[1]},"
                    f" found none in {_FIND_S:g} s; start it with the same ROS_DOMAIN_ID. {self._side.mismatch(0)}"
                )
                raise BusError(told.rstrip())
            time.sleep(0.05)

    def _ask(self, rgb: Any) -> float:
        self._stamp_ns = max(self._stamp_ns + 1, time.time_ns())
        cdr = encode(image_message(np.ascontiguousarray(rgb), self._stamp_ns, "camera"))
        began, sent = time.monotonic(), -_AGAIN_S
        while (waited_s := time.monotonic() - began) < _ANSWER_S:
            if waited_s - sent >= _AGAIN_S:
                sent = waited_s
                self._side.write(0, cdr)
            for heard in (heard for batch in self._inbox.take() for heard in batch):
                if (steering_rad := self._answer(heard)) is not None:
                    return steering_rad
            time.sleep(_POLL_S)
        raise BusError(
            f"expected a command on {self._names[1]} with the image's stamp within {_ANSWER_S:g} s, got none;"
            " the program must copy the stamp of the image into its command"
        )

    def _answer(self, heard: Heard) -> float | None:
        if problem := OneWriter(present=heard.present).problem:
            raise BusError(f"{self._names[1]}: {problem}")
        if stamp_of_cdr(heard.cdr) != self._stamp_ns:
            return None
        message = decode(self._type, heard.cdr)
        if self._type != ACKERMANN:
            message = conversion(ACKERMANN, self._type, outward=False)(message, self._setting)
        return float(message.drive.steering_angle)


def ros2_policy(
    camera: str | Path,
    vehicle: str | Path,
    domain_id: int = 0,
    images: str = "/image_raw",
    commands: str = "/cmd_vel",
    command_type: str = TWIST,
    view: PolicyView | None = None,
    transport: Transport = "auto",
) -> AdaptedPolicy:
    """A running ROS 2 program as a policy: a black box that sees the whole camera image.

    Args:
        camera: Camera calibration file, for the size of the images.
        vehicle: Vehicle calibration file, for the wheelbase.
        domain_id: ``ROS_DOMAIN_ID`` of the program.
        images: ROS name of the images.
        commands: ROS name of its commands.
        command_type: Type of its commands.
        view: View of the sent images; None sends whole camera images. A program that takes its network's own input size answers faster,
            because the scene is rendered at that size.
        transport: ``dds``, ``zenoh`` or ``auto``, as in the configuration of the ROS 2 node.
    """
    found = load_calibration(CameraCalibration, Path(camera)).pinhole
    whole = PolicyView(
        found, crop_top_px=0, crop_height_px=found.height, width=found.width, height=found.height
    )
    wheelbase_m = load_calibration(VehicleCalibration, Path(vehicle)).wheelbase_m
    network = Ros2Network(domain_id, images, commands, command_type, wheelbase_m, transport=transport)
    return adapt(network, PolicyContract(view or whole, differentiable=False))
