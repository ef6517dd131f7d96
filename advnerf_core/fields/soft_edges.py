"""Objects whose edges are a few voxels wide, so that a picture of them changes smoothly as they move.

The outline of a solid, or of a dense voxel grid, passes from empty to opaque within a fraction of a millimetre. Few rays of a
picture lie there, and an exact derivative of these rays with respect to the object's place says little about the outline
between them. Here the opacity ``a`` rises from 0 to 1 over a given width, half of it outside the surface, by the distance to it. With
extinction ``-log(1 - a) / chord`` a ray that crosses a chord of constant ``a`` has the opacity ``a``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array

DEFAULT_WIDTH_VOXELS = 2.0
# The inside of a grid with a density: voxels that take more than half of the light.
_HALF_OPAQUE = float(np.log(2.0))
# Chord of a ray that grazes the outline of a body, in widths of the edge.
_CHORD_WIDTHS = 3.0
# Transmission of the inside, one part in 10^8; layers of a flat solid; ray-marching steps along the width of an edge.
_DEEPEST, _LAYERS, _STEPS = 1e-8, 4, 2


def with_soft_edges(field: VoxelGridObject, width: float | None = None) -> VoxelGridObject:
    """The same object with soft edges; its colours, theta, pose and front are unchanged.

    Args:
        field: An object, solid or with a density. A solid that is seen from its front only becomes a sheet as deep as the width.
        width: Length over which the opacity rises from 0 to 1, in object units; two of the widest voxel edges if not given. Parts of a body that are
            thinner than the width become translucent.

    Raises:
        ValueError: The width is not positive, or the object has no body.
    """
    pitch = (np.asarray(field.box_max, np.float64) - field.box_min) / field.slots.shape
    flat = field.density is None and field.one_sided
    widest = float(pitch[1:].max() if flat else pitch.max())
    width = DEFAULT_WIDTH_VOXELS * widest if width is None else float(width)
    if not 0.0 < width < np.inf:
        raise ValueError(f"expected a positive width of the soft edges, got {width}")
    return _sheet(field, width, pitch) if flat else _body(field, width, pitch)


def _sheet(field: VoxelGridObject, width: float, pitch: Array) -> VoxelGridObject:
    """Opaque by the distance to the outline of the front; the front's colours extend through all layers."""
    pitch = np.array([width / _LAYERS, pitch[1], pitch[2]])
    border = _border(width, pitch)
    around = [(int(n), int(n)) for n in border[1:]]
    inside = np.pad(np.ones(field.slots.shape[1:], dtype=bool), around)
    density = _extinction(_signed_distance(inside, pitch[1:]), width, width)
    front = np.pad(field.slots[-1], around, mode="edge")
    margin = np.array([0.0, *(border * pitch)[1:]])
    low, high = np.asarray(field.box_min, np.float64) - margin, np.asarray(field.box_max, np.float64) + margin
    low[0], high[0] = field.box_max[0] - (_LAYERS + 1) * pitch[0], field.box_max[0] + pitch[0]
    return replace(
        field,
        slots=np.ascontiguousarray(np.repeat(front[None], _LAYERS + 2, axis=0)),
        box_min=low,
        box_max=high,
        density=np.pad(np.repeat(density[None], _LAYERS, axis=0), [(1, 1), (0, 0), (0, 0)]),
        step_units=width / _STEPS,
    )


def _body(field: VoxelGridObject, width: float, pitch: Array) -> VoxelGridObject:
    if field.density is None:
        inside = np.ones(field.slots.shape, dtype=bool)
    else:
        inside = np.asarray(field.density) * float(pitch.min()) > _HALF_OPAQUE
    if not inside.any():
        raise ValueError(
            "expected an object of which some voxel is more than half opaque; without it, it is soft already"
        )
    border = _border(width, pitch)
    around = [(int(n), int(n)) for n in border]
    inside = np.pad(inside, around)
    density = _extinction(_signed_distance(inside, pitch), width, _CHORD_WIDTHS * width)
    # Outside of the body a ray sees the colour of the nearest part of it.
    nearest = ndimage.distance_transform_edt(~inside, pitch, return_distances=False, return_indices=True)
    slots = np.pad(field.slots, around)[tuple(nearest)]
    return replace(
        field,
        slots=np.ascontiguousarray(slots, np.int32),
        density=density,
        box_min=field.box_min - border * pitch,
        box_max=field.box_max + border * pitch,
        step_units=min(width / _STEPS, float(pitch.max())),
    )


def _border(width: float, pitch: Array) -> NDArray[np.int64]:
    """Number of voxels around the object; the outermost are empty."""
    return np.ceil(0.5 * width / pitch).astype(np.int64) + 1


def _extinction(distance: Array, width: float, chord: float) -> Array:
    opacity = np.clip(0.5 + distance / width, 0.0, 1.0 - _DEEPEST)
    return np.asarray(-np.log1p(-opacity) / chord)


def _signed_distance(inside: NDArray[np.bool_], pitch: Array) -> Array:
    """Distance of voxel centres to the surface, positive inside; the surface lies half a voxel beyond the last centre."""
    half = 0.5 * float(pitch.min())
    inner = ndimage.distance_transform_edt(inside, pitch) - half
    outer = ndimage.distance_transform_edt(~inside, pitch) - half
    return np.asarray(np.where(inside, inner, -outer))
