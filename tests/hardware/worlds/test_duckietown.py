"""What the world of Duckietown makes of the facts of its simulator, without the simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hardware.worlds.duckietown.config import DuckietownConfig, StretchConfig
from hardware.worlds.duckietown.world import Duckietown
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import WorldDescription, WorldError


def ring_of(config: DuckietownConfig) -> WorldDescription:
    """A circle of 1 m in both directions."""
    angles = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    facts = {"simulator": "none", "ways": [48, 48], "tile_m": 0.585, "size_m": [3.0, 3.0]}
    return Duckietown(config).description_of(facts, {"ways": np.concatenate([ring, ring[::-1]])})


def test_drives_begin_where_the_configuration_says_in_both_directions() -> None:
    configs = (DuckietownConfig(), DuckietownConfig(drives_from_m=0.5))
    plain, moved = (ring_of(config).paths for config in configs)
    # On a circle of 1 m, half a metre is half a radian.
    for name, turned_rad in (("left", 0.5), ("right", -0.5)):
        x, y, yaw = plain[name].start_pose
        assert plain[name].drive_start == plain[name].start_pose == moved[name].start_pose
        c, s = math.cos(turned_rad), math.sin(turned_rad)
        expected = (c * x - s * y, s * x + c * y, yaw + turned_rad)
        assert moved[name].drive_start == pytest.approx(expected, abs=1e-3)


def test_a_stretch_is_the_only_path_and_the_box_keeps_to_it() -> None:
    whole = ring_of(DuckietownConfig())
    # It passes the end of the route, of 2 pi m.
    found = ring_of(DuckietownConfig(stretch=StretchConfig(route="left", from_m=6.0, length_m=1.0)))
    (path,) = found.paths.values()
    assert not path.closed
    assert path.length_m == pytest.approx(1.0)
    for s_m in np.linspace(0.0, 1.0, 7):
        assert path.pose_at(s_m) == pytest.approx(whole.paths["left"].pose_at(6.0 + s_m), abs=1e-6)
    points = np.array([path.pose_at(s_m)[:2] for s_m in np.linspace(0.0, 1.0, 200)])
    assert np.allclose(found.box.min_m[:2], points.min(axis=0) - 0.3, atol=1e-3)
    assert np.allclose(found.box.max_m[:2], points.max(axis=0) + 0.3, atol=1e-3)
    with pytest.raises(
        WorldError, match=r"stretch\.route to be one of left, right of small_loop, got middle"
    ):
        ring_of(DuckietownConfig(stretch=StretchConfig(route="middle")))


def test_a_stretch_of_an_open_path_ends_before_the_path() -> None:
    path = ReferencePath((1.0, 2.0, 0.5), (("line", 1.0), ("arc", 0.5, -1.0), ("line", 2.0)))
    part = path.stretch(0.7, 1.5)
    assert [each[0] for each in part.segments] == ["line", "arc", "line"]
    for s_m in np.linspace(0.0, 1.5, 9):
        assert part.pose_at(s_m) == pytest.approx(path.pose_at(0.7 + s_m))
    with pytest.raises(ValueError, match=r"path of 3\.50 m, got 3 m from 1 m"):
        path.stretch(1.0, 3.0)
