"""The rule for sample intervals from the cameras and the box of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Pinhole
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import SceneFieldConfig

# For cameras among the content, and for cameras that all stand outside the box and look at it.
INTERVAL_PX, INTERVAL_PX_FROM_OUTSIDE = 4.0, 1.5
# Shares of the box's longest side.
_SHORTEST, _LONGEST, NEAR = 1 / 1024, 1 / 64, 1 / 80
# The same number as in Instant-NGP. Occupied space is short, so that few rays come near it.
_MOST_SAMPLES = 1024


def pixel_intervals(
    pinholes: Sequence[Pinhole],
    T_world_from_camera: ArrayLike,
    field: SceneFieldConfig,
    near_m: float | None = None,
    interval_px: float | None = None,
) -> MarchConfig:
    """Choose sample intervals that are a few pixels long, for any camera positions.

    At distance ``t`` a pixel of a camera with focal length ``f`` [px] is ``t / f`` wide. Pictures have no finer detail there, so
    the interval at ``t`` is ``interval_px * t / f``. A camera close to a wall gets short intervals, and a camera that stands back
    gets intervals as fine, relative to its view, as its pixels.

    - Cameras in the box, as in a room: 4 pixels. Rays pass much occupied space, and each surface is seen from about one side.
    - All cameras outside the box, around an object: 1.5 pixels. The ray direction in one view is across it in another, so that
      intervals show like pixels; and rays pass little occupied space, so that short intervals cost few rays in training.

    Limits come from the content, in shares of the longest side of the box:

    - Not shorter than 1/1024: two cells of the finest level of the hash grid.
    - Not longer than 1/64: two cells of the occupancy grid. Small pictures of a far object, whose box covers less than
      ``64 * interval_px`` pixels, are sampled finer than that. Outside the box of a contracted field this limit grows with the cells.

    The same intervals serve training and rendering. A field learns densities that suit the intervals of its training, with
    surfaces about that thick. Longer intervals in rendering step over them. Shorter ones in training mean fewer rays a step, since a step
    has a limited number of samples: a short training then ends worse.

    Args:
        pinholes: The relevant cameras: the training images', or the rendering camera. The median of
            their focal lengths is used.
        T_world_from_camera: Poses of the training images ``[N, 4, 4]``.
        field: The field, for its box.
        near_m: Smallest sampled distance from a camera [m]; None: 1/80 of the longest side of the box, 5 cm in a room of 4 m.
        interval_px: Interval in pixels, instead of the rule's. Fewer give finer silhouettes and take more samples.
    """
    if interval_px is None:
        places = np.asarray(T_world_from_camera, np.float64)[:, :3, 3]
        inside = ((places >= np.array(field.box_low_m)) & (places <= np.array(field.box_high_m))).all(axis=1)
        interval_px = INTERVAL_PX if inside.any() else INTERVAL_PX_FROM_OUTSIDE
    if near_m is not None and near_m >= field.extent_m:
        raise ValueError(
            f"expected near below {field.extent_m:.4g}, the longest side of the box, got {near_m:.4g}: is it in the unit of the cameras?"
        )
    if not interval_px > 0.0:
        raise ValueError(f"expected interval_px > 0, got {interval_px}")
    return MarchConfig(
        near_m=NEAR * field.extent_m if near_m is None else near_m,
        smallest_step_m=_SHORTEST * field.extent_m,
        largest_step_m=_LONGEST * field.extent_m,
        step_growth=interval_px / median(pinhole.fx for pinhole in pinholes),
        max_samples=_MOST_SAMPLES,
    )
