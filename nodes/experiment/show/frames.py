"""The frames of a deployment scene as the background of an attack: differentiable rendering over pictures without a learned scene."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, yaw_of
from advnerf_core.policies.view import PolicyView
from hardware.worlds.world import World, require_depth
from nodes.experiment.show.standing import clear


class DeployedFrames:
    """A background renderer (`advnerf_core.scene.surrogate.BackgroundRenderer`): the policy's view of a scene without objects.

    Time does not pass. Colours are resized as in the policy's view; of the depths under a pixel the middle one is taken,
    as a mean of near and far belongs to no surface.

    Args:
        scene: Scene that renders from any pose of the car.
        view: The policy's view of its camera.
    """

    def __init__(self, scene: World, view: PolicyView) -> None:
        self.scene, self.view = scene, view
        self._T_camera_from_car = np.linalg.inv(scene.T_car_from_camera)

    def __call__(self, poses: Array, pinhole: Pinhole) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours ``[B, H, W, 3]`` in 0..1 and planar depth ``[B, H, W]`` [m] at camera poses ``[B, 4, 4]`` of a car on the ground."""
        if pinhole != self.view.pinhole:
            raise ValueError(f"expected the camera of the policy's view, {self.view.pinhole}, got {pinhole}")
        size = (self.view.width, self.view.height)
        clear(self.scene)
        rgb, depth_m = [], []
        for pose in poses @ self._T_camera_from_car:
            image, depth = require_depth(
                self.scene.observe_at(float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose))
            )
            rgb.append(self.view.image(image))
            depth_m.append(cv2.resize(depth[self.view.window], size, interpolation=cv2.INTER_NEAREST_EXACT))
        return np.stack(rgb).astype(np.float32) / np.float32(255.0), np.stack(depth_m).astype(np.float32)
