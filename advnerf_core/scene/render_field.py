"""Fast rendering of a trained scene field without gradients, for attacks and for training data of policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.geometry import Pinhole
from advnerf_core.parallel import run_slots, slot_bounds
from advnerf_core.render.march import MarchConfig
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.render.rays import intrinsics_row, poses_in_box
from advnerf_core.scene.colour import ColourMap
from advnerf_core.scene.field import SceneField, load_scene
from advnerf_core.scene.render_kernels import SIDE, render_tiles

_SLOTS = 16


class FieldRenderer:
    """Renders images, planar depth and opacity of a trained field on the CPU; same inputs, same bits.

    Args:
        scene: The field; its weights are copied.
        occupied: Occupied cells ``[X, Y, Z]``.
        march: Placement of samples, from training.
        colour_map: Applied to all colours: from the camera that learned the scene to the rendered one.
        least_transmittance: A ray stops when less light than this would still come through.
        behind: Colour ``[3]`` behind a scene that was learned from images with alpha; black gives colours times opacity.
    """

    def __init__(
        self,
        scene: SceneField,
        occupied: NDArray[np.bool_],
        march: MarchConfig | None = None,
        colour_map: ColourMap | None = None,
        least_transmittance: float = 5e-3,
        behind: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.config, self.march, self.colour_map = scene.config, march or MarchConfig(), colour_map
        self.least_transmittance, self.behind = least_transmittance, behind
        self.samples = 0  # samples of the last call, for benchmarks
        self.weights = {name: value.detach().cpu().numpy().copy() for name, value in scene.named_parameters()}
        self.levels = scene.grid.levels
        cells = (np.array(occupied.shape) / self.config.box_high).astype(np.float32)
        self.leaps = leap_distances(occupied, cells)

    @property
    def networks(self) -> tuple[Any, ...]:
        """Encoding and networks in the order in which kernels take them."""
        layers = ("density_1", "density_2", "colour_1", "colour_2")
        parts = (self.weights[f"{layer}.{part}"] for layer in layers for part in ("weight", "bias"))
        return self.weights["grid.table"], self.levels, *parts

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        colour_map: ColourMap | None = None,
        behind: tuple[float, float, float] = (1.0, 1.0, 1.0),
        interval_scale: float = 1.0,
    ) -> FieldRenderer:
        """Renderer of a scene file.

        Args:
            colour_map: Replaces the file's map, if any.
            behind: Colour behind a scene that was learned from images with alpha.
            interval_scale: Sample intervals relative to the training's, which suit the field best. Longer ones are quicker.
        """
        scene, occupied, metadata = load_scene(Path(path))
        march = MarchConfig(**metadata["march"]) if "march" in metadata else None
        if colour_map is None and "colour_map" in metadata:
            colour_map = ColourMap.from_dict(metadata["colour_map"])
        march = (march or MarchConfig()).coarser(interval_scale)
        return cls(scene, occupied, march, colour_map, behind=behind)

    def render(
        self, T_world_from_camera: ArrayLike | Tensor, pinhole: Pinhole
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render a batch of views.

        Args:
            T_world_from_camera: Poses ``[B, 4, 4]``.

        Returns:
            Colours ``[B, H, W, 3]`` in 0..1, planar depth ``[B, H, W]`` [m] (infinite for empty pixels) and opacity
            ``[B, H, W]``, all float32 without history.
        """
        if isinstance(T_world_from_camera, Tensor):
            T_world_from_camera = T_world_from_camera.detach().cpu().numpy()
        poses = np.asarray(T_world_from_camera, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ValueError(f"expected poses [B, 4, 4], got {poses.shape}")
        shape = (len(poses), pinhole.height, pinhole.width)
        rgb, depth_m, alpha = (
            np.empty((*shape, 3), np.float32),
            np.empty(shape, np.float32),
            np.empty(shape, np.float32),
        )
        tiles = len(poses) * -(-pinhole.height // SIDE) * -(-pinhole.width // SIDE)
        bounds, samples = slot_bounds(tiles, _SLOTS), np.zeros(_SLOTS, np.int64)
        in_box = poses_in_box(poses, self.config.origin_m, self.config.extent_m, self.config.ray_unit_m)

        def work(slot: int) -> None:
            samples[slot] = self._render_tiles(
                in_box, intrinsics_row(pinhole), bounds[slot], rgb, depth_m, alpha
            )

        run_slots(work, _SLOTS)
        self.samples = int(samples.sum())
        colours = rgb if self.colour_map is None else self.colour_map.apply(rgb)
        if not self.config.learned_background:
            opacity = alpha[..., None]
            colours = opacity * colours + (np.float32(1.0) - opacity) * np.array(self.behind, np.float32)
        return (
            torch.from_numpy(colours),
            torch.from_numpy(depth_m * np.float32(self.config.ray_unit_m)),
            torch.from_numpy(alpha),
        )

    __call__ = render

    def _render_tiles(
        self,
        poses: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        bounds: tuple[int, int],
        rgb: NDArray[np.float32],
        depth_m: NDArray[np.float32],
        alpha: NDArray[np.float32],
    ) -> int:
        march = self.march.in_unit(self.config.ray_unit_m)
        return int(
            render_tiles(
                poses,
                intrinsics,
                *bounds,
                self.config.box_high,
                np.float32(march.near_m),
                march.steps(),
                self.leaps.distance,
                self.leaps.cells,
                *self.networks,
                self.weights["background"],
                self.config.direction_bands,
                np.float32(self.least_transmittance),
                march.max_samples,
                rgb,
                depth_m,
                alpha,
                self.config.contraction,
            )
        )
