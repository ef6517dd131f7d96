"""The path that a car drove, from the poses of its camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from advnerf_core.csv_rows import read_csv
from advnerf_core.files import natural_order
from advnerf_core.geometry import Array
from hardware.worlds.fitting import path_through
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import WorldError

# Between two photographs of one drive the distance is at most this many times the usual one, and leads forward at least this much (cosine).
_LONGEST_STEPS, _FORWARD = 5.0, 0.5
# Of the photographs; a drive in fewer of them is none, or they are not in its order.
_LEAST_SHARE = 0.25
# In half lanes: distance of the points that the path passes, and its largest error there.
_SPACING, _MISS = 0.5, 0.04
# Of a path by points: a parabola through fewer says nothing of where it leads.
_FEWEST = 4


def driving_order(cars: Array, names: Sequence[str]) -> Sequence[int]:
    """Indices of the photographs in the order of the drive: as they are listed, or by the numbers in their names if that continues longer.

    Args:
        cars: ``T_world_from_car [N, 4, 4]`` as listed.
        names: Names of their files.
    """
    listed = list(range(len(cars)))
    named = sorted(listed, key=lambda index: natural_order(names[index]))
    return max(listed, named, key=lambda order: len(_longest_part(cars[order])))


def driven_track(cars: Array) -> Array:
    """The longest continuous part of a drive.

    Args:
        cars: ``T_world_from_car [N, 4, 4]`` in the order of the drive.

    Returns:
        x [m], y [m] ``[M, 2]``.

    Raises:
        WorldError: The photographs show no drive, or are not in its order.
    """
    best = _longest_part(cars)
    if len(best) < max(3, _LEAST_SHARE * len(cars)):
        raise WorldError(
            f"expected photographs one after the other along a drive, got {len(cars)} of which at most {len(best)} are; list or name them "
            "in the order of the drive, or give the path as a CSV file with columns x_m, y_m"
        )
    return np.asarray(cars[best, :2, 3])


def _longest_part(cars: Array) -> Array:
    """Indices of the longest run of photographs that lead forward in usual steps."""
    points, ahead = cars[:, :2, 3], cars[:, :2, 0]
    steps = np.diff(points, axis=0)
    lengths_m = np.linalg.norm(steps, axis=1)
    usual_m = float(np.median(lengths_m)) if len(steps) else 0.0
    goes_on = (lengths_m <= _LONGEST_STEPS * usual_m) & (
        np.einsum("ij,ij->i", steps, ahead[:-1]) >= _FORWARD * lengths_m * np.linalg.norm(ahead[:-1], axis=1)
    )
    parts = np.split(np.arange(len(points)), np.flatnonzero(~goes_on) + 1)
    return max(parts, key=lambda part: float(lengths_m[part[:-1]].sum()))


def points_of(file: Path) -> Array:
    """x [m], y [m] ``[N, 2]`` of a CSV file with the columns ``x_m`` and ``y_m``.

    Raises:
        ConfigError: The file does not contain such points.
    """
    rows = [(row.number("x_m"), row.number("y_m")) for row in read_csv(file, ("x_m", "y_m"))]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def path_along(points: Array, off_track_m: float, closed: bool) -> ReferencePath:
    """A path along measured points, which are averaged, as poses from pictures are off by millimetres to centimetres.

    Args:
        points: x [m], y [m] ``[N, 2]`` in driving order.
        off_track_m: Half the width of the lane [m].
        closed: Whether it continues from the last point to the first. A second lap, or the beginning of one, is left out.

    Raises:
        WorldError: The points do not form a smooth route.
    """
    if len(points) < _FEWEST:
        raise WorldError(
            f"expected at least {_FEWEST} points along the path, got {len(points)}; put more between them"
        )
    points = _one_lap(points, off_track_m) if closed else points
    try:
        averaged = _averaged(points, _SPACING * off_track_m, closed)
        steps = np.diff(averaged, axis=0)
        if (back := np.flatnonzero((steps[1:] * steps[:-1]).sum(axis=1) < 0.0)).size:
            x_m, y_m = averaged[back[0] + 1]
            raise ValueError(
                f"the path turns back at x = {x_m:.2f} m, y = {y_m:.2f} m; put the points in driving order"
            )
        return path_through(averaged, closed=closed, tolerance_m=_MISS * off_track_m)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise WorldError(
            f"expected points on one smooth way, at most {_SPACING * off_track_m:g} m apart ({_SPACING:g} of off_track_m), "
            f"got {len(points)} points: {error}"
        ) from None


def _one_lap(points: Array, near_m: float) -> Array:
    """The points ``[N, 2]`` up to where they pass the first one again in its direction, if all later ones lie on the beginning."""
    from_first = points - points[0]
    away_m = np.linalg.norm(from_first, axis=1)
    ahead = from_first[int(np.argmax(away_m > near_m))]
    has_left = np.maximum.accumulate(away_m) > 2.0 * near_m
    onward = np.diff(points, axis=0, prepend=points[:1]) @ ahead > 0.0
    again = np.flatnonzero(has_left & onward & (away_m <= near_m) & (from_first @ ahead > 0.0))
    if not again.size:
        return points
    lap, later = np.split(points, again[:1])
    return lap if (cKDTree(lap).query(later)[0] <= near_m).all() else points


def _averaged(points: Array, spacing_m: float, closed: bool) -> Array:
    """Points at equal distances, each on the parabola fitted to its neighbours with Gaussian weights.

    The width is half the distance, or the measured points' distance if they are farther apart; a parabola does not cut corners.
    """
    lengths_m = np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(lengths_m[:-1])])
    round_m = along_m[-1] + lengths_m[-1]
    width_m = max(0.5 * spacing_m, float(np.median(lengths_m[:-1])))
    count = max(3, int(np.ceil((round_m if closed else along_m[-1]) / spacing_m)) + (not closed))
    wanted_m = np.linspace(0.0, round_m if closed else along_m[-1], count, endpoint=not closed)
    if closed:
        points = np.concatenate([points, points, points])
        along_m = np.concatenate([along_m - round_m, along_m, along_m + round_m])
    away = (along_m[None] - wanted_m[:, None]) / width_m
    powers = away[..., None] ** np.arange(3)
    weighted = np.exp(-0.5 * away**2)[..., None] * powers
    normal, wanted = np.einsum("kni,knj->kij", weighted, powers), np.einsum("kni,nd->kid", weighted, points)
    return np.linalg.solve(normal, wanted)[:, 0]
