"""What the world of Duckietown makes of the facts of its simulator, without the simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hardware.worlds.duckietown.config import DuckietownConfig
from hardware.worlds.duckietown.world import Duckietown


def test_drives_begin_where_the_configuration_says_in_both_directions() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    facts = {"simulator": "none", "ways": [48, 48], "tile_m": 0.585, "size_m": [3.0, 3.0]}
    arrays = {"ways": np.concatenate([ring, ring[::-1]])}
    configs = (DuckietownConfig(), DuckietownConfig(drives_from_m=0.5))
    plain, moved = (Duckietown(config).description_of(facts, arrays).paths for config in configs)
    # On a circle of 1 m, half a metre is half a radian.
    for name, turned_rad in (("left", 0.5), ("right", -0.5)):
        x, y, yaw = plain[name].start_pose
        assert plain[name].drive_start == plain[name].start_pose == moved[name].start_pose
        c, s = math.cos(turned_rad), math.sin(turned_rad)
        expected = (c * x - s * y, s * x + c * y, yaw + turned_rad)
        assert moved[name].drive_start == pytest.approx(expected, abs=1e-3)
