"""A trained scene as voxels: no networks while rendering, so that a frame takes a few milliseconds."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.files import read_tensors, write_tensors
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.parallel import Work, run_slots, slot_bounds, thread_count
from advnerf_core.render.march import MarchConfig
from advnerf_core.render.occupancy import Leaps, flat_boxes, leap_distances
from advnerf_core.render.rays import intrinsics_row, poses_in_box
from advnerf_core.scene.baked_kernels import HIGH, WIDE, render_baked
from advnerf_core.scene.field import SceneFieldConfig, SceneFileError

FORMAT = "advnerf-baked-1"
_SLOTS = 16
_NOTING = 4  # threads that record seen cells: an array of all cells is tens of MiB
_NOTHING_NOTED = np.zeros((0, 0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class Voxels:
    """Values of a field at voxel corners.

    Attributes:
        values: Logarithm of density and colour of each corner ``[V, 4]`` uint8; first the cells', then the bricks'.
        brick_of: First value of the brick of each cell ``[X, Y, Z]`` int32; negative without a brick.
        log_sides: Logarithm to base 2 of the parts along each side of the bricks ``[X, Y, Z]`` uint8.
        behind: Colour ``[3]`` behind everything.
    """

    values: NDArray[np.uint8]
    brick_of: NDArray[np.int32]
    log_sides: NDArray[np.uint8]
    behind: NDArray[np.float32]

    @property
    def words(self) -> NDArray[np.int32]:
        """The values ``[V]``, each as one word: the first of its four bytes is the lowest."""
        return self.values.view("<i4").reshape(-1)

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        return self.values.nbytes + self.brick_of.nbytes + self.log_sides.nbytes


class BakedScene:
    """Renders voxels as `FieldRenderer` renders the field that they were baked from; same inputs, same bits.

    Samples have the same places as in the field's renderer. Colours are mixed along a ray; the field mixes features, and decodes them once.

    Args:
        least_transmittance: A ray stops when less light than this would still come through.
        voxels: Voxels from `bake`.
    """

    def __init__(
        self,
        config: SceneFieldConfig,
        march: MarchConfig,
        leaps: Leaps,
        least_transmittance: float,
        voxels: Voxels,
    ) -> None:
        self.config, self.march, self.leaps = config, march, leaps
        self.least_transmittance, self.voxels = least_transmittance, voxels
        self._boxes = leaps.distance if config.contraction else flat_boxes(leaps.distance)

    def render(
        self, T_world_from_camera: ArrayLike | Tensor, pinhole: Pinhole
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render a batch of views; arguments and results as in `FieldRenderer.render`."""
        return self.work(T_world_from_camera, pinhole).run()

    __call__ = render

    def work(
        self, T_world_from_camera: ArrayLike | Tensor, pinhole: Pinhole
    ) -> Work[tuple[Tensor, Tensor, Tensor]]:
        """`render` as work that has not begun: its parts may run beside other work's."""
        if isinstance(T_world_from_camera, Tensor):
            T_world_from_camera = T_world_from_camera.detach().cpu().numpy()
        poses = np.asarray(T_world_from_camera, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ValueError(f"expected poses [B, 4, 4], got {poses.shape}")
        return self._work(poses, pinhole, _NOTHING_NOTED)

    def nearest_seen_m(self, T_world_from_camera: Array, pinhole: Pinhole) -> NDArray[np.float32]:
        """Distance [m] from which each cell ``[X, Y, Z]`` is seen in views ``[N, 4, 4]``, the smallest; infinite for unseen ones."""
        # Each thread records in its own array, as two would write the same cells.
        shape = (min(thread_count(), _NOTING), *self.leaps.distance.shape)
        nearest_m = np.full(shape, np.inf, np.float32)

        def work(slot: int) -> None:
            for pose in T_world_from_camera[slot :: len(nearest_m)]:
                self._work(pose[None], pinhole, nearest_m[slot]).run()

        run_slots(work, len(nearest_m))
        found: NDArray[np.float32] = nearest_m.min(axis=0)
        return found

    def _work(
        self, poses: Array, pinhole: Pinhole, nearest_m: NDArray[np.float32]
    ) -> Work[tuple[Tensor, Tensor, Tensor]]:
        shape = (len(poses), pinhole.height, pinhole.width)
        rgb, depth_m = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        alpha = np.empty(shape, np.float32)
        tiles = len(poses) * -(-pinhole.height // HIGH) * -(-pinhole.width // WIDE)
        bounds = slot_bounds(tiles, 1 if nearest_m.size else _SLOTS)
        in_box = poses_in_box(poses, self.config.origin_m, self.config.extent_m)

        def work(slot: int) -> None:
            render_baked(
                in_box,
                intrinsics_row(pinhole),
                *bounds[slot],
                self.config.box_high,
                np.float32(self.march.near_m),
                self.march.steps(),
                self._boxes,
                self.leaps.cells,
                self.voxels.brick_of.reshape(-1),
                self.voxels.log_sides.reshape(-1),
                self.voxels.words,
                self.voxels.behind,
                np.float32(self.least_transmittance),
                self.march.max_samples,
                rgb,
                depth_m,
                alpha,
                nearest_m,
                self.config.contraction,
            )

        return Work(
            [partial(work, slot) for slot in range(len(bounds))],
            lambda: (torch.from_numpy(rgb), torch.from_numpy(depth_m), torch.from_numpy(alpha)),
        )

    def save(self, path: Path) -> None:
        """Write to one ``.safetensors`` file, atomically."""
        cells = np.flatnonzero(self.voxels.brick_of.reshape(-1) >= 0)
        arrays: dict[str, NDArray[Any]] = {
            "values": self.voxels.values,
            "brick_cells": cells.astype(np.int32),
            "brick_begins": self.voxels.brick_of.reshape(-1)[cells],
            "brick_log_sides": self.voxels.log_sides.reshape(-1)[cells],
            "behind": self.voxels.behind,
            "occupancy_bits": np.packbits(self.leaps.distance == 0),
        }
        header = {
            "format": FORMAT,
            "config": json.dumps(self.config.to_dict()),
            "march": json.dumps(asdict(self.march)),
            "shape": json.dumps(list(self.leaps.distance.shape)),
            "least_transmittance": repr(self.least_transmittance),
        }
        write_tensors(path, "numpy", arrays, header)

    @classmethod
    def load(cls, path: Path) -> BakedScene:
        """Read a file of `save`.

        Raises:
            SceneFileError: The file is missing, damaged, or of another kind.
        """
        try:
            header, arrays = read_tensors(path, "numpy")
        except (OSError, ValueError) as error:
            raise SceneFileError(
                f"expected a baked scene at {path}, got: {error}; bake the scene again"
            ) from error
        if header.get("format") != FORMAT:
            raise SceneFileError(
                f"expected format {FORMAT} in {path}, got {header.get('format')}; bake the scene again"
            )
        config = SceneFieldConfig.from_dict(json.loads(header["config"]))
        shape = tuple(json.loads(header["shape"]))
        occupied = np.unpackbits(arrays["occupancy_bits"], count=int(np.prod(shape))).reshape(shape)
        brick_of, log_sides = np.full(shape, -1, np.int32), np.zeros(shape, np.uint8)
        brick_of.reshape(-1)[arrays["brick_cells"]] = arrays["brick_begins"]
        log_sides.reshape(-1)[arrays["brick_cells"]] = arrays["brick_log_sides"]
        cells = (np.array(shape) / config.box_high).astype(np.float32)
        return cls(
            config,
            MarchConfig(**json.loads(header["march"])),
            leap_distances(occupied.astype(bool), cells),
            float(header["least_transmittance"]),
            Voxels(arrays["values"], brick_of, log_sides, arrays["behind"]),
        )
