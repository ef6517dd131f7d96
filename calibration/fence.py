"""The fence: a simple polygon on the floor that the car may not leave."""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = tuple[float, float]
# Smaller than any car, and larger than any test track.
_LEAST_AREA_M2, _LARGEST_SPAN_M = 0.01, 1000.0


def inside(point_m: Point, polygon_m: Sequence[Point]) -> bool:
    """Whether a point lies inside a simple polygon, convex or not (even-odd rule). False for points that are not finite."""
    x, y = point_m
    if not (math.isfinite(x) and math.isfinite(y)):
        return False
    result = False
    for (ax, ay), (bx, by) in _edges(polygon_m):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            result = not result
    return result


def edge_distance_m(point_m: Point, polygon_m: Sequence[Point]) -> float:
    """Distance from a point to the nearest edge of a polygon [m]."""
    return min(_segment_distance_m(point_m, a, b) for a, b in _edges(polygon_m))


def require_simple(polygon_m: Sequence[Point]) -> None:
    """Refuse a fence whose inside is not well defined, because its edges cross, or that has none.

    Raises:
        ValueError: It is not simple.
    """
    edges = _edges(polygon_m)
    area_m2 = 0.5 * abs(sum(ax * by - bx * ay for (ax, ay), (bx, by) in edges))
    for i, (a, b) in enumerate(edges):
        for j in range(i + 1, len(edges)):
            neighbours = j == i + 1 or (i == 0 and j == len(edges) - 1)
            if not neighbours and _cross(a, b, *edges[j]):
                raise ValueError(
                    f"expected a fence whose edges do not cross, but edge {i + 1} ({a} to {b}) crosses edge {j + 1}"
                    f" ({edges[j][0]} to {edges[j][1]}); put the corners of fence_m in order"
                )
    if area_m2 < _LEAST_AREA_M2:
        raise ValueError(
            f"expected a fence around an area, got corners on a line or a point ({area_m2:.2g} m^2)"
        )
    span_m = max(max(values) - min(values) for values in zip(*polygon_m, strict=True))
    if span_m > _LARGEST_SPAN_M:
        raise ValueError(
            f"expected a fence in m, at most {_LARGEST_SPAN_M:g} m wide, got {span_m:.0f} m; is it in mm?"
        )


def _edges(polygon_m: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(polygon_m, [*polygon_m[1:], polygon_m[0]], strict=True))


def _segment_distance_m(p: Point, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    length2 = dx * dx + dy * dy
    along = 0.0 if length2 == 0.0 else min(1.0, max(0.0, ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / length2))
    return math.hypot(p[0] - a[0] - along * dx, p[1] - a[1] - along * dy)


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0
