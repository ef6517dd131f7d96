"""Panels that stand by a rule, against pictures of them drawn by composition."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.files import write_json
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.experiment.plan.placed import PlacedObject
from nodes.experiment.show.context import PLACED, Experiment
from nodes.experiment.show.deployed import DressedScene
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.show.placing import place_by_rule
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

ROOM = Path(__file__).parents[3] / "launch" / "room.experiment.yaml"


def room(folder: Path, rule: str = "{}", scale: float = 0.25) -> Experiment:
    changes = [
        "carrier={kind: composed}",
        "deploy.through=world",
        "object.panel_resolution=8",
        "horizon=45",
        f"objects=[{{name: board, kind: panel, scale: {scale}, stands: {rule}}}]",
    ]
    return load_experiment(ROOM, "demo", changes, folder)


def placed(experiment: Experiment, world: Lab) -> PlacedObject:
    (spot,) = place_by_rule(experiment, world)
    file = experiment.stage_folder("capture") / PLACED
    write_json(file, [spot.place])
    return spot


@pytest.fixture(scope="module")
def lab():
    with Lab(LabConfig(supersampling=1)) as world:
        # Every search for a spot looks from the same poses.
        world.observe_at = lru_cache(maxsize=None)(world.observe_at)
        yield world


def test_a_panel_stands_where_a_drive_sees_it_for_two_seconds(lab: Lab, tmp_path: Path) -> None:
    experiment = room(tmp_path)
    with pytest.raises(ConfigError, match="run that stage first"):
        _ = experiment.objects
    spot = placed(experiment, lab)
    assert experiment.objects == (spot,)
    # Counted in pictures: how much of the panel the car's camera sees, of what nothing in the room hides.
    path, start = experiment.paths["track"], lab.describe().paths["track"].drive_start
    begin_m = float(path.project(np.array(start[:2])).s_m)
    there, alone = (
        DressedScene(scene, experiment.view, placed_objects(experiment)) for scene in (lab, _Nothing(lab))
    )
    colours = torch.full_like(there.plain_theta(), 0.0)
    colours[..., 0], colours[..., 1:] = 9.0, -9.0
    seen = []
    for tick in range(experiment.config.horizon + 1):
        state = np.asarray(path.pose_at(begin_m + 0.8 * 0.1 * tick))
        shown, whole = (
            _red(each.policy_images(each.prepare(state[None]), colours)[0]) for each in (there, alone)
        )
        seen.append(whole > 40 and shown > 0.85 * whole)
    assert sum(seen) >= 19
    assert np.hypot(spot.x_m - start[0], spot.y_m - start[1]) < 4.0


def test_the_rule_is_obeyed_or_refused(lab: Lab, tmp_path: Path) -> None:
    left = placed(room(tmp_path / "left", "{side: left, seen_s: 1.0, least_px: 4}", 0.1), lab)
    path = room(tmp_path / "path").paths["track"]
    assert float(path.project(np.array([left.x_m, left.y_m])).cte_m) > 0.4
    longer = placed(room(tmp_path / "longer", "{seen_s: 3.0}"), lab)
    first = placed(room(tmp_path / "first"), lab)
    assert (longer.x_m, longer.y_m) != (first.x_m, first.y_m)
    with pytest.raises(ConfigError, match=r"a spot beside the path track .* seen for 30 s, got none"):
        placed(room(tmp_path / "never", "{seen_s: 30}"), lab)
    # The second of two stands beside the first.
    two = room(tmp_path / "two", "{seen_s: 1.0}", 0.12)
    (wanted,) = two.config.objects
    again = wanted.model_copy(update={"name": "other"})
    both = place_by_rule(replace(two, config=two.config.model_copy(update={"objects": (wanted, again)})), lab)
    assert np.hypot(both[0].x_m - both[1].x_m, both[0].y_m - both[1].y_m) >= 0.24


def test_the_largest_view_is_larger_than_any_other(lab: Lab, tmp_path: Path) -> None:
    """Counted in pictures of the panel alone in a void, which the first spot's are, too."""
    totals = {}
    for rule in ("first", "largest_view"):
        experiment = room(tmp_path / rule, f"{{seen_s: 1.5, choose: {rule}}}")
        placed(experiment, lab)
        alone = DressedScene(_Nothing(lab), experiment.view, placed_objects(experiment))
        colours = torch.full_like(alone.plain_theta(), 0.0)
        colours[..., 0], colours[..., 1:] = 9.0, -9.0
        path, start = experiment.paths["track"], lab.describe().paths["track"].drive_start
        begin_m = float(path.project(np.array(start[:2])).s_m)
        along_m = begin_m + 0.08 * np.arange(experiment.config.horizon + 1)
        states = np.asarray(path.pose_at(along_m))
        totals[rule] = sum(_red(each) for each in alone.policy_images(alone.prepare(states), colours))
    assert totals["largest_view"] > 1.2 * totals["first"]


def test_outside_is_where_a_car_goes_that_misses_the_turn(lab: Lab, tmp_path: Path) -> None:
    """The room's track turns left all the way round: its outside is on the right, and there is none of a straight part."""
    experiment = room(tmp_path, "{side: outside, seen_s: 1.0, least_px: 4}", 0.1)
    spot, path = placed(experiment, lab), experiment.paths["track"]
    assert float(path.project(np.array([spot.x_m, spot.y_m])).cte_m) < -0.4
    along_m = float(path.project(np.array([spot.x_m, spot.y_m])).s_m)
    yaws = np.asarray(path.pose_at(np.array([along_m - 0.8, along_m])))[:, 2]
    assert np.remainder(yaws[1] - yaws[0], 2 * np.pi) > 0.2


def test_a_spot_is_no_farther_from_the_path_than_the_rule_allows(lab: Lab, tmp_path: Path) -> None:
    """Half a lane of the room is 0.4 m; the largest view is at two of them, and nearer spots are in the lane."""

    def away_half_lanes(within: str) -> float:
        experiment = room(tmp_path / within, f"{{choose: largest_view, within_half_lanes: {within}}}")
        spot = placed(experiment, lab)
        return abs(float(experiment.paths["track"].project(np.array([spot.x_m, spot.y_m])).cte_m)) / 0.4

    assert away_half_lanes("6.0") == pytest.approx(2.0, abs=0.01)
    assert 1.0 < away_half_lanes("1.9") < 1.9
    with pytest.raises(ConfigError, match="expected a spot beside the path track where board fits"):
        away_half_lanes("1.3")


def test_a_solid_object_stands_by_the_rule_too(lab: Lab, tmp_path: Path) -> None:
    changes = [
        "carrier={kind: composed}",
        "deploy.through=world",
        "objects=[{name: hydrant, kind: hydrant, scale: 0.4, stands: {seen_s: 1.0, least_px: 4}}]",
    ]
    experiment = load_experiment(ROOM, "demo", changes, tmp_path)
    spot = placed(experiment, lab)
    assert (spot.kind, spot.scale) == ("hydrant", 0.4)
    assert abs(float(experiment.paths["track"].project(np.array([spot.x_m, spot.y_m])).cte_m)) > 0.4


def test_what_is_captured_depends_on_the_rule_and_on_no_place_by_hand(tmp_path: Path) -> None:
    def settings(experiment: Experiment) -> str:
        return json.dumps(stages_of(experiment)[0].settings.keyed, sort_keys=True)

    assert settings(room(tmp_path)) != settings(room(tmp_path, "{side: left}"))
    by_hand = [
        "carrier={kind: composed}",
        "deploy.through=world",
        "objects=[{name: board, kind: panel, x_m: 2.0, y_m: -2.8, scale: 0.2}]",
    ]
    plain = load_experiment(ROOM, "demo", by_hand[:2], tmp_path / "plain")
    assert settings(load_experiment(ROOM, "demo", by_hand, tmp_path / "hand")) == settings(plain)
    with pytest.raises(ConfigError, match=r"objects.*x_m"):
        load_experiment(ROOM, "demo", [*by_hand[:2], "objects=[{name: a, kind: panel}]"], tmp_path / "x")
    with pytest.raises(ConfigError, match="expected no cube by a rule"):
        load_experiment(
            ROOM, "demo", [*by_hand[:2], "objects=[{name: a, kind: cube, stands: {}}]"], tmp_path / "x"
        )
    with pytest.raises(ConfigError, match="pannel"):
        load_experiment(
            ROOM, "demo", [*by_hand[:2], "objects=[{name: a, kind: pannel, stands: {}}]"], tmp_path / "x"
        )


class _Nothing:
    """The lab's cameras in a void: nothing hides what is composed."""

    def __init__(self, lab: Lab) -> None:
        self.T_car_from_camera, self.camera_pinhole = lab.T_car_from_camera, lab.camera_pinhole

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True):
        shape = (self.camera_pinhole.height, self.camera_pinhole.width)
        return np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf, np.float32)


def _red(image: np.ndarray) -> int:
    return int(((image[..., 0] > 150) & (image[..., 1] < 80) & (image[..., 2] < 80)).sum())
