"""The frames of a deployment scene as the background of an attack: differentiable rendering over pictures without a learned scene."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.policies.view import PolicyView
from hardware.worlds.world import World
from nodes.experiment.show.standing import bare_views


class DeployedFrames:
    """A background renderer (`advnerf_core.scene.surrogate.BackgroundRenderer`): the policy's view of a scene without objects.

    Time does not pass. Colours are resized as in the policy's view; of the depths under a pixel the middle one is taken,
    as a mean of near and far belongs to no surface.
    """

    def __init__(self, scene: World, view: PolicyView) -> None:
        self.scene, self.view = scene, view

    def __call__(self, poses: Array, pinhole: Pinhole) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours ``[B, H, W, 3]`` in 0..1 and planar depth ``[B, H, W]`` [m] at camera poses ``[B, 4, 4]`` of a car on the ground."""
        if pinhole != self.view.pinhole:
            raise ValueError(f"expected the camera of the policy's view, {self.view.pinhole}, got {pinhole}")
        size = (self.view.width, self.view.height)
        rgb, depth_m = [], []
        for image, depth in bare_views(self.scene, poses):
            rgb.append(self.view.image(image))
            depth_m.append(cv2.resize(depth[self.view.window], size, interpolation=cv2.INTER_NEAREST_EXACT))
        return np.stack(rgb).astype(np.float32) / np.float32(255.0), np.stack(depth_m).astype(np.float32)
