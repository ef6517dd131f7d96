"""Baking: the values of a trained field at voxel corners, finest where a driving camera comes near."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole
from advnerf_core.parallel import run_slots, slot_bounds
from advnerf_core.render.contraction import radial_stretch
from advnerf_core.render.march import MarchConfig
from advnerf_core.render.occupancy import Leaps
from advnerf_core.scene.baked import BakedScene, Voxels
from advnerf_core.scene.baked_kernels import bake_points
from advnerf_core.scene.colour import IDENTITY
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.render_field import FieldRenderer

# Length of a brick's part in pixels at the nearest view. Shorter ones look a little better and take much more memory.
PART_PX = 1.4
# Per side of a cell: down to the field's own finest cells. A contracted cube is twice as wide as its inner region, and so are its cells.
_MOST_HALVINGS, _MOST_HALVINGS_CONTRACTED = 3, 4
_SLOTS = 16
_CHUNK = 1 << 20  # points baked at a time
_CONSTANT = np.float32(0.28209479177387814)  # the spherical harmonic of degree 0


class NotBakedError(AdvnerfError):
    """A field cannot be baked."""


class CornerValues(Protocol):
    """What is baked: values at points of a box, and where in it there is something.

    Attributes:
        config: For the box.
        march: Placement of samples on the rays of the baked scene.
        leaps: Occupied cells.
        least_transmittance: A ray stops when less light than this would still come through.
        behind: Colour ``[3]`` behind everything.
    """

    config: SceneFieldConfig
    march: MarchConfig
    leaps: Leaps
    least_transmittance: float
    behind: NDArray[np.float32]

    def at(self, points: NDArray[np.float32], spacing: float) -> NDArray[np.uint8]:
        """Values ``[N, 4]`` as `Voxels` holds them, at points ``[N, 3]`` in box coordinates that are ``spacing`` apart."""


def bake(
    source: FieldRenderer, T_world_from_camera: ArrayLike, pinhole: Pinhole, part_px: float = PART_PX
) -> BakedScene:
    """Bake a field, including its colour map; see `bake_corners`.

    Raises:
        NotBakedError: The field's colours depend on the direction, or it is transparent.
    """
    config = source.config
    if config.direction_bands > 1 or not config.learned_background or config.ray_unit_m != 1.0:
        raise NotBakedError(
            "expected an opaque field with colours that do not depend on the direction, got one with learned_background = "
            f"{config.learned_background}, direction_bands = {config.direction_bands}, a longest side of {config.extent_m:.4g} m"
        )
    return bake_corners(_OfField(source), T_world_from_camera, pinhole, part_px)


def bake_corners(
    source: CornerValues, T_world_from_camera: ArrayLike, pinhole: Pinhole, part_px: float = PART_PX
) -> BakedScene:
    """Bake the values of a source.

    Every occupied cell gets values at its corners. A cell seen from near by also gets a brick of finer ones.

    Args:
        T_world_from_camera: Poses ``[N, 4, 4]`` like the later ones: bricks are made where these look.
        pinhole: Intrinsics of the later renders.
        part_px: Length of a brick's part in pixels, at the nearest view.
    """
    config = source.config
    shape = source.leaps.distance.shape
    none_yet = np.full(shape, -1, np.int32), np.zeros(shape, np.uint8)
    coarse = Voxels(_corner_values(source), *none_yet, source.behind)
    plain = BakedScene(config, source.march, source.leaps, source.least_transmittance, coarse)
    poses = np.asarray(T_world_from_camera, np.float64).reshape(-1, 4, 4)
    parts = _widths_m(source) * pinhole.fx / (part_px * plain.nearest_seen_m(poses, pinhole))
    voxels = _with_bricks(source, coarse, parts)
    return BakedScene(config, source.march, source.leaps, source.least_transmittance, voxels)


def _corner_values(source: CornerValues) -> NDArray[np.uint8]:
    """Values at the corners of all cells; empty where no sample of an occupied cell can lie."""
    shape = np.array(source.leaps.distance.shape)
    corners = np.flatnonzero(_within_reach(source))
    values = np.zeros((int(np.prod(shape + 1)), 4), np.uint8)
    for part in np.array_split(corners, max(1, len(corners) // _CHUNK)):
        points = np.stack(np.unravel_index(part, shape + 1), -1).astype(np.float32)
        values[part] = source.at(points / source.leaps.cells, _spacing(source))
    return values


def _within_reach(source: CornerValues) -> NDArray[np.bool_]:
    """Corners ``[X + 1, Y + 1, Z + 1]`` of cells in which a sample can lie: half an interval behind the point where its ray met an occupied cell."""
    occupied = source.leaps.distance == 0
    reach = 1 + int(np.ceil(0.5 * source.march.largest_step_m / _inner_cell_m(source)))
    near: NDArray[np.bool_] = ndimage.maximum_filter(np.pad(occupied, (0, 1)), size=2 * reach + 1)
    if source.config.contraction:
        # Outside, an interval is as long as a cell is deep, and crosses many where it runs along their width.
        outside = radial_stretch(source.leaps.distance.shape) > 1.0
        near |= ndimage.maximum_filter(np.pad(outside, (0, 1)), size=2)
    return near


def _inner_cell_m(source: CornerValues) -> float:
    """Length of a cell; if contracted, in the inner region, which is half of the cube."""
    share = 2.0 if source.config.contraction else 1.0
    return share * source.config.extent_m / float(source.leaps.cells.max())


def _widths_m(source: CornerValues) -> float | NDArray[np.float32]:
    """Width of the cells, ``[X, Y, Z]`` if contracted: outside it grows like the distance."""
    cell_m = _inner_cell_m(source)
    if not source.config.contraction:
        return cell_m
    return np.asarray(cell_m * np.sqrt(radial_stretch(source.leaps.distance.shape)), np.float32)


def _with_bricks(source: CornerValues, coarse: Voxels, parts: NDArray[np.float32]) -> Voxels:
    """The voxels with bricks of at least ``parts [X, Y, Z]`` along the sides of cells, up to the limit."""
    logs = np.ceil(np.log2(np.maximum(parts.reshape(-1), 1.0))).astype(np.int64)
    cells = np.flatnonzero(logs > 0)
    most = _MOST_HALVINGS_CONTRACTED if source.config.contraction else _MOST_HALVINGS
    logs = np.minimum(logs[cells], most)
    counts = (2**logs + 1) ** 3
    begins = len(coarse.values) + np.cumsum(counts) - counts
    brick_of, log_sides = coarse.brick_of.copy(), coarse.log_sides.copy()
    brick_of.reshape(-1)[cells], log_sides.reshape(-1)[cells] = begins, logs
    values = np.concatenate([coarse.values, np.zeros((int(counts.sum()), 4), np.uint8)])
    corners = np.stack(np.unravel_index(cells, parts.shape), -1).astype(np.float32)
    for log in np.unique(logs):
        of_size = logs == log
        _fill_bricks(source, values, corners[of_size], begins[of_size], 2 ** int(log))
    return Voxels(values, brick_of, log_sides, coarse.behind)


def _fill_bricks(
    source: CornerValues,
    values: NDArray[np.uint8],
    corners: NDArray[np.float32],
    begins: NDArray[np.int64],
    side: int,
) -> None:
    inside = (np.indices((side + 1,) * 3).reshape(3, -1).T / side).astype(np.float32)
    for part in np.array_split(np.arange(len(corners)), max(1, len(corners) * len(inside) // _CHUNK)):
        points = (corners[part, None] + inside) / source.leaps.cells
        rows = begins[part, None] + np.arange(len(inside))
        values[rows.reshape(-1)] = source.at(points.reshape(-1, 3), _spacing(source) / side)


def _spacing(source: CornerValues) -> float:
    """Length of a cell in box coordinates."""
    return 1.0 / float(source.leaps.cells.max())


class _OfField:
    """The corner values of a trained field."""

    def __init__(self, field: FieldRenderer) -> None:
        self._field, self.config, self.march, self.leaps = field, field.config, field.march, field.leaps
        self.least_transmittance, self.behind = field.least_transmittance, _far_colour(field)

    def at(self, points: NDArray[np.float32], spacing: float) -> NDArray[np.uint8]:
        """See `CornerValues`; a field has learned its own sharpness."""
        del spacing
        points, networks = np.ascontiguousarray(points, np.float32), self._field.networks
        colours = self._field.colour_map or IDENTITY
        matrix, offset = np.array(colours.matrix, np.float32), np.array(colours.offset, np.float32)
        values, bounds = np.empty((len(points), 4), np.uint8), slot_bounds(len(points), _SLOTS)

        def work(slot: int) -> None:
            bake_points(
                points,
                *bounds[slot],
                *networks,
                matrix,
                offset,
                np.float32(colours.power),
                values,
            )

        run_slots(work, _SLOTS)
        return values


def _far_colour(source: FieldRenderer) -> NDArray[np.float32]:
    """Colour ``[3]`` of the learned background, in the colours of the driving camera."""
    w = source.weights
    inputs = np.zeros(w["colour_1.weight"].shape[1], np.float32)
    inputs[: len(w["background"])] = w["background"]
    inputs[len(w["background"])] = _CONSTANT
    hidden = np.maximum(w["colour_1.weight"] @ inputs + w["colour_1.bias"], 0.0)
    raw = (w["colour_2.weight"] @ hidden + w["colour_2.bias"])[:3]
    rgb = (1.0 / (1.0 + np.exp(-raw))).astype(np.float32)
    return (source.colour_map or IDENTITY).apply(rgb)
