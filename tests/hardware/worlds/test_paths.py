"""Reference paths as plain data, and paths through points, against the curves the points were taken from."""

import json
import math

import numpy as np
import pytest

from advnerf_core.driving.path import Arc, Line, Path
from hardware.worlds.fitting import path_through
from hardware.worlds.paths import ReferencePath

SQUARE = ReferencePath(
    (-1.0, -2.0, 0.0),
    (("line", 2.0), ("arc", 1.0, 0.5 * math.pi), ("line", 2.0), ("arc", 1.0, 0.5 * math.pi)) * 2,
    closed=True,
)


def driven(reference: ReferencePath) -> Path:
    pieces = [
        Line(piece[1]) if piece[0] == "line" else Arc(piece[1], piece[2]) for piece in reference.segments
    ]
    return Path.from_segments(reference.start_pose, pieces, closed=reference.closed)


def test_a_closed_path_goes_round_again() -> None:
    assert SQUARE.length_m == pytest.approx(8.0 + 2.0 * math.pi)
    for s in np.arange(-3.0, 40.0, 0.7).tolist():
        x, y, yaw = driven(SQUARE).pose_at(s)
        there = SQUARE.pose_at(s)
        assert there[:2] == pytest.approx((x, y), abs=1e-9)
        assert math.cos(there[2] - yaw) == pytest.approx(1.0)


def test_plain_data_brings_the_same_path_back() -> None:
    path = ReferencePath((0.1, 0.2, 0.3), (("line", 1.5), ("arc", 2.0, -0.7)), (0.0, 1.0))
    for each in (path, SQUARE):
        assert ReferencePath.from_dict(json.loads(json.dumps(each.to_dict()))) == each


@pytest.mark.parametrize(
    ("start", "segments"),
    [
        ((0.0, 0.0, 0.0), ()),
        ((0.0, 0.0, math.nan), (("line", 1.0),)),
        ((0.0, 0.0, 0.0), (("line", -1.0),)),
        ((0.0, 0.0, 0.0), (("arc", 0.0, 1.0),)),
        ((0.0, 0.0), (("line", 1.0),)),
    ],
)
def test_what_is_no_path_is_refused(
    start: tuple[float, ...], segments: tuple[tuple[object, ...], ...]
) -> None:
    with pytest.raises(ValueError, match="expected a finite start pose"):
        ReferencePath(start, segments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "data", [{}, {"start_pose": [0, 0, 0], "segments": [["bend", 1.0]], "goal": [], "closed": False}]
)
def test_data_that_is_no_path_is_refused(data: dict[str, object]) -> None:
    with pytest.raises((KeyError, ValueError)):
        ReferencePath.from_dict(data)


@pytest.mark.parametrize("spacing_m", [0.2, 0.5])
def test_a_path_through_points_is_the_curve_they_are_from(spacing_m: float) -> None:
    truth = driven(
        ReferencePath((3.0, -1.0, 2.0), (("line", 4.0), ("arc", 5.0, -1.2), ("line", 3.0), ("arc", 8.0, 0.9)))
    )
    s = np.append(np.arange(0.0, truth.length_m, spacing_m), truth.length_m)
    found = path_through(truth.pose_at(s)[:, :2], goal=(1.0,))
    assert found.goal == (1.0,)
    assert not found.closed
    assert found.start_pose == pytest.approx((3.0, -1.0, 2.0), abs=1e-6)
    along = driven(found).pose_at(np.linspace(0.0, found.length_m, 300))
    at = truth.project(along[:, :2])
    assert np.abs(at.cte_m).max() < 0.03
    assert np.abs(np.angle(np.exp(1j * (at.heading_rad - along[:, 2])))).max() < 0.06
    assert found.length_m == pytest.approx(truth.length_m, rel=0.005)


def test_a_closed_path_through_points_closes() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    ellipse = np.column_stack([6.0 * np.cos(angle), 4.0 * np.sin(angle)])
    found = path_through(ellipse, closed=True, tolerance_m=0.01)
    path = driven(found)  # which refuses a path that misses its start by more than a micrometre
    turned = path.pose_at(path.length_m - 1e-9)[2] - path.pose_at(0.0)[2]
    assert turned == pytest.approx(2.0 * np.pi, abs=1e-4)
    points = path.pose_at(np.linspace(0.0, path.length_m, 500))[:, :2]
    assert np.abs((points[:, 0] / 6.0) ** 2 + (points[:, 1] / 4.0) ** 2 - 1.0).max() < 0.02


@pytest.mark.parametrize(
    ("points", "closed", "told"),
    [
        ([[0.0, 0.0], [1.0, 0.0]], False, "at least three"),
        ([[0.0, 0.0], [1.0, 0.0], [np.nan, 0.0]], False, "at least three"),
        ([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 0.0]], False, "got one twice"),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0]], True, "got one twice"),
        ([[0.0, 0.0], [1.0, 0.0], [0.1, 0.0], [-1.0, 0.0]], False, "smooth way"),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], True, "lead back to the first one|smooth way"),
    ],
)
def test_points_that_are_no_way_are_refused(points: list[list[float]], closed: bool, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        path_through(points, closed=closed)
