"""Rendering of splats on the CPU: colour, depth and opacity of pinhole views."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.parallel import run_slots, scratch, slot_bounds
from advnerf_core.render.rays import intrinsics_row
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.splats.cleaning import central_box
from advnerf_core.splats.gaussians import GaussianSplats
from advnerf_core.splats.kernels import COLUMNS, TILE, draw_tiles, fill_tiles, project
from advnerf_core.splats.projection import View, drawn_within

NEAR_M = 0.05
_SLOTS = 16
Corner = tuple[float, float, float]
_Images = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


class SplatRenderer:
    """Renders a splat; arguments and results as `FieldRenderer`'s; same inputs, same bits.

    Like all scenes here it is seen by ideal pinholes: the images of a data set are undistorted when they are loaded.

    Args:
        behind: Colour ``[3]`` behind everything.
        near_m: Gaussians whose centres are nearer are left out [m].
        box: Low and high corner of the scene [m], for views of it and for baking; None: where nearly all Gaussians are.
    """

    def __init__(
        self,
        splats: GaussianSplats,
        behind: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near_m: float = NEAR_M,
        box: tuple[Corner, Corner] | None = None,
    ) -> None:
        if box is None:
            low, high = ((float(x), float(y), float(z)) for x, y, z in central_box(splats))
            box = low, high
        self.box = box
        self.splats, self.behind, self.near_m = splats, behind, near_m
        self._covariances, self._within = splats.covariances(), drawn_within(splats.opacities)

    @property
    def config(self) -> SceneFieldConfig:
        """The box in the form of fields."""
        return SceneFieldConfig(*self.box)

    def render(
        self, T_world_from_camera: ArrayLike | Tensor, pinhole: Pinhole
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render a batch of views.

        Args:
            T_world_from_camera: Poses ``[B, 4, 4]``.

        Returns:
            Colours ``[B, H, W, 3]`` in 0..1, planar depth by weight ``[B, H, W]`` [m] (infinite for empty pixels) and opacity ``[B, H, W]``, all
            float32 without history.
        """
        if isinstance(T_world_from_camera, Tensor):
            T_world_from_camera = T_world_from_camera.detach().cpu().numpy()
        poses = np.asarray(T_world_from_camera, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ValueError(f"expected poses [B, 4, 4], got {poses.shape}")
        shape = (len(poses), pinhole.height, pinhole.width)
        rgb = np.empty((*shape, 3), np.float32)
        depth_m, alpha = (np.empty(shape, np.float32) for _ in range(2))
        for n, pose in enumerate(poses):
            self._draw(pose, pinhole, (rgb[n], depth_m[n], alpha[n]))
        return torch.from_numpy(rgb), torch.from_numpy(depth_m), torch.from_numpy(alpha)

    __call__ = render

    def _draw(self, pose: Array, pinhole: Pinhole, images: _Images) -> None:
        view, splats, count = View.of(pose, pinhole, self.near_m), self.splats, len(self.splats)
        across, down = -(-pinhole.width // TILE), -(-pinhole.height // TILE)
        bounds = slot_bounds(count, _SLOTS)
        projected = scratch("splats projected", count * COLUMNS, np.float32)[: count * COLUMNS].reshape(
            count, COLUMNS
        )
        source = scratch("splats source", count, np.int32)
        reach = scratch("splats reach", 4 * count, np.int16)[: 4 * count].reshape(count, 4)
        counts, ends = np.zeros((_SLOTS, across * down), np.int32), [0] * _SLOTS

        def put_into_image(slot: int) -> None:
            ends[slot] = project(
                *bounds[slot],
                splats.means_m,
                self._covariances,
                splats.opacities,
                self._within,
                view.T_camera_from_world,
                intrinsics_row(pinhole),
                view.limits.numpy(),
                view.near_m,
                pinhole.width,
                pinhole.height,
                projected,
                source,
                reach,
                counts[slot],
            )

        run_slots(put_into_image, _SLOTS)
        # By tile, then by slot: in a list, Gaussians keep their order.
        flat = np.concatenate([[0], np.cumsum(counts.T.reshape(-1), dtype=np.int64)])
        places = np.ascontiguousarray(flat[:-1].reshape(across * down, _SLOTS).T)
        starts, lists = np.ascontiguousarray(flat[::_SLOTS]), scratch("splats lists", int(flat[-1]), np.int32)
        run_slots(
            lambda slot: fill_tiles(bounds[slot][0], ends[slot], reach, across, places[slot], lists), _SLOTS
        )
        centre, behind = view.centre_m.astype(np.float32), np.array(self.behind, np.float32)

        def draw(tile: int) -> None:
            parts = (starts, lists, projected, source, splats.means_m, splats.harmonics)
            draw_tiles(tile, tile + 1, *parts, centre, behind, *images)

        run_slots(draw, across * down)
