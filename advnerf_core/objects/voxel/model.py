"""An object in its own frame, for object files and scenes.

The frame: origin in the middle of the base, z up, x forward if it has a front; metres, unless placed with a scale.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import read_tensors, write_tensors
from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, ObjectGrids

FILE_FORMAT = "advnerf-object-1"
# A ray that has crossed two voxels of full density is dark to one part in 10^17.
_DEEP_VOXELS = 3
_STEPS_PER_VOXEL = 2.0
_HIDDEN_RGB = (0.5, 0.5, 0.5)


class ObjectFileError(AdvnerfError, ValueError):
    """An object file cannot be read or is invalid."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object that can be placed.

    Attributes:
        about: Origin: source, resolution, fit, software version (JSON types).
    """

    name: str
    grids: ObjectGrids
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def size_m(self) -> Array:
        """Extent of the non-empty part along x, y, z [m]."""
        low, high = self.solid_box
        return np.asarray(high - low)

    @property
    def solid_box(self) -> tuple[Array, Array]:
        """Corners of the box around the non-empty part [m]."""
        filled = np.argwhere(self.grids.density > 0)
        return (
            self.grids.box_min + self.grids.voxel * filled.min(axis=0),
            self.grids.box_min + self.grids.voxel * (filled.max(axis=0) + 1),
        )

    @cached_property
    def slots(self) -> NDArray[np.int32]:
        """Row of theta for each visible voxel; all others share the last, fixed row. ``[nx, ny, nz]``."""
        near = ndimage.binary_dilation(self.grids.density > 0, np.ones((3, 3, 3)))
        full = self.grids.density >= 0.9 * OPAQUE_PER_VOXEL / self.grids.voxel
        seen = near & ~ndimage.binary_erosion(full, iterations=_DEEP_VOXELS)
        slots = np.full(seen.shape, int(seen.sum()), dtype=np.int32)
        slots[seen] = np.arange(seen.sum(), dtype=np.int32)
        return slots

    def placed(self, T_world_from_object: ArrayLike, scale: float = 1.0) -> VoxelGridObject:
        """The object at a pose ``[4, 4]``, with ``scale`` world metres per metre of the object; what renderers derive is shared."""
        pose = np.asarray(T_world_from_object, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ObjectFileError(
                f"expected a finite pose [4, 4] for {self.name}, got shape {list(pose.shape)}"
            )
        return self._in_its_own_frame.moved(pose, scale)

    @cached_property
    def _in_its_own_frame(self) -> VoxelGridObject:
        count = int(self.slots.max())
        return VoxelGridObject(
            slots=self.slots,
            theta_shape=(count, 3),
            fixed_colours=np.array([_HIDDEN_RGB]),
            box_min=self.grids.box_min,
            box_max=self.grids.box_max,
            T_world_from_object=np.eye(4),
            density=np.asarray(self.grids.density, dtype=np.float64),
            step_units=self.grids.voxel / _STEPS_PER_VOXEL,
            plain_colours=np.asarray(self.grids.colours[self.slots < count], dtype=np.float64),
        )


def save_object(path: Path, model: ObjectModel) -> None:
    """Write an object file, whole or not at all."""
    grids = model.grids
    tensors: dict[str, NDArray[Any]] = {
        "density": np.ascontiguousarray(grids.density),
        "colours": np.ascontiguousarray(grids.colours),
        "box": np.stack([grids.box_min, grids.box_max]),
    }
    metadata = {"format": FILE_FORMAT, "name": model.name, "about": json.dumps(model.about, sort_keys=True)}
    write_tensors(path, "numpy", tensors, metadata)


def load_object(path: Path) -> ObjectModel:
    """Read an object file.

    Raises:
        ObjectFileError: The file is missing, not an object file, or has invalid values.
    """
    if not path.is_file():
        raise ObjectFileError(
            f"expected an object file at {path}, found none: make one with `advnerf scene object build`"
        )
    try:
        metadata, parts = read_tensors(path, "numpy")
    except ValueError as error:
        raise ObjectFileError(f"cannot read {path} as an object file ({error}); build it again") from error
    if metadata.get("format") != FILE_FORMAT:
        raise ObjectFileError(
            f"expected {path} to be an object file ({FILE_FORMAT}), got {metadata.get('format')}"
        )
    if missing := {"density", "colours", "box"} - parts.keys():
        raise ObjectFileError(f"cannot read {path} as an object file (no {min(missing)}); build it again")
    density, colours, box = parts["density"], parts["colours"], parts["box"]
    _check(path, density, colours, box)
    about = json.loads(metadata.get("about", "{}"))
    return ObjectModel(metadata.get("name", path.stem), ObjectGrids(density, colours, box[0], box[1]), about)


def _check(path: Path, density: Any, colours: Any, box: Any) -> None:
    whole = all(np.isfinite(part).all() for part in (density, colours, box))
    if density.ndim != 3 or colours.shape != (*density.shape, 3) or box.shape != (2, 3) or not whole:
        raise ObjectFileError(
            f"expected {path} to hold finite grids [nx, ny, nz] and [nx, ny, nz, 3] and a box [2, 3], "
            f"got {list(density.shape)}, {list(colours.shape)} and {list(box.shape)}; build it again"
        )
    if density.max() <= 0 or (box[1] <= box[0]).any():
        raise ObjectFileError(f"expected {path} to hold something that is not empty; build it again")
