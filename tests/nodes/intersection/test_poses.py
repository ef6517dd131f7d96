"""Places and colours searched together at the junction: where objects may go, and what a cell says."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advnerf_core.attack.spaces.placement import footprint
from advnerf_core.geometry import rotation_z, yaw_of
from advnerf_core.policies.pilotnet import load_policy
from hardware.worlds.junction.config import IntersectionConfig
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.policy import HARDENED, victim_file
from nodes.experiment.junction.poses import PoseSettings, bounds_of, lanes_of, pose_cell, random_placements

SMALL = PoseSettings(samples=1, steps=1)


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


def test_objects_move_about_their_places_and_off_the_lanes(trained: Experiment) -> None:
    things = trained.world.objects
    moved = random_placements(trained, 12, seed=3)
    assert len(moved) == 12
    for objects in moved:
        for thing, there in zip(things, objects, strict=True):
            offset_m = there.T_world_from_object[:2, 3] - [thing.x_m, thing.y_m]
            assert np.abs(offset_m).max() <= PoseSettings().move_m + 1e-9
            low, high = (there.scale * corner for corner in footprint(there))
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            yaw_rad = yaw_of(there.T_world_from_object)
            corners = corners @ rotation_z(yaw_rad)[:2, :2].T + there.T_world_from_object[:2, 3]
            assert not any(
                IntersectionConfig().on_road(*corner) for corner in corners
            )  # they stand on pavements, so high
            place = (*there.T_world_from_object[:2, 3], yaw_of(there.T_world_from_object), there.scale)
            assert lanes_of(trained).distance_m(place, footprint(there)) >= trained.site.off_track_m
    places = np.array([[each.T_world_from_object[:3, 3] for each in objects] for objects in moved])
    assert np.ptp(places[..., :2], axis=0).min() > 0.0
    assert np.ptp(places[..., 2], axis=0).max() == 0.0  # they stay on the ground
    assert random_placements(trained, 0, seed=3) == []


def test_cars_turn_a_little_and_hydrants_all_the_way(trained: Experiment) -> None:
    for thing, bound in zip(trained.world.objects, bounds_of(trained.world.objects, SMALL), strict=True):
        assert bound.yaw_rad is not None
        width_rad = bound.yaw_rad[1] - bound.yaw_rad[0]
        assert width_rad == pytest.approx(2 * np.pi if thing.kind == "hydrant" else 2 * SMALL.turn_rad)
        assert bound.scale is None


@pytest.mark.parametrize("method", ["random", "gradient"])
def test_a_cell_is_searched_once_and_says_where_things_stand(
    trained: Experiment, wall: Any, tmp_path: Path, method: Any
) -> None:
    victim = load_policy(victim_file(trained, HARDENED))
    short = replace(trained, config=trained.config.model_copy(update={"horizon": 4}))
    cell = pose_cell(short, victim, "right", method, 0, tmp_path, silent, wall, SMALL)
    assert cell["extra"]["evaluations"] == 1
    placements = np.array(cell["extra"]["placements"])
    assert placements.shape == (len(trained.world.objects), 4)
    hand = np.array([[thing.x_m, thing.y_m] for thing in trained.world.objects])
    assert 0.0 < np.abs(placements[:, :2] - hand).max() <= SMALL.move_m + 1e-9
    # The surrogate's own prediction is what is driven again.
    assert np.mean(cell["surrogate"]["total_cte_m"]) == pytest.approx(cell["extra"]["curve_total_cte_m"][0], rel=1e-6)
    plain = pose_cell(short, victim, "right", "none", 0, tmp_path, silent, wall, SMALL)
    assert plain["deployed"]["total_cte_m"] == cell["deployed"]["none_total_cte_m"]
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*.cell.json")}
    assert pose_cell(short, victim, "right", method, 0, tmp_path, silent, wall, SMALL) == json.loads(json.dumps(cell))
    assert {file: file.stat().st_mtime_ns for file in tmp_path.glob("*.cell.json")} == kept
    longer = replace(short, config=short.config.model_copy(update={"horizon": 5}))
    anew = pose_cell(longer, victim, "right", method, 0, tmp_path, silent, wall, SMALL)
    assert anew["settings_hash"] != cell["settings_hash"]
    assert anew["deployed"] != cell["deployed"]
