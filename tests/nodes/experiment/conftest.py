import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole, VehicleState, planar_pose
from advnerf_core.objects.voxel.model import save_object
from advnerf_core.policies.architecture import PilotNetConfiguration
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from hardware.worlds.junction.car import DubinsCar
from hardware.worlds.junction.config import DubinsConfig, IntersectionConfig
from hardware.worlds.junction.scene import Intersection
from hardware.worlds.world import World, WorldDescription
from nodes.experiment.plan.victims import HARDENED, NAIVE
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_spec
from nodes.experiment.show.learned_scene import scene_file
from nodes.experiment.show.objects import build, object_file
from nodes.experiment.steps.run import load_experiment
from tests.support.set_ups import folder_of_all_workers, made_once
from tests.support.setting_reads import recording
from tests.support.stage_versions import measured

LAUNCH = Path(__file__).parents[3] / "launch" / "junction.experiment.yaml"
TINY: dict[str, Any] = {
    "capture": {"photos": 9, "held_out": 3},
    "scene": {"steps": 20, "log2_entries": 10, "finest": 32, "occupancy": 32},
    "object": {"car_resolution": 12, "hydrant_resolution": 10, "fit_steps": 0},
    "policy": {
        "deployed_stills": 4, "surrogate_stills": 4, "deployed_drives": 1, "surrogate_drives": 1, "drive_steps": 2,
        "first_steps": 2, "round_steps": 2, "naive_steps": 2, "hidden": [16, 8, 4],
    },
    "attack": {"evaluations": 2, "population": 4, "time_batch": 2},
    "measure": {"starts": 1},
}  # fmt: skip


def write_file(folder: Path, **changes: Any) -> Path:
    """An experiment file like ours with a setting small enough for a test."""
    data = yaml.safe_load(LAUNCH.read_text())
    data["settings"] = {"tiny": TINY}
    file = folder / "tiny.experiment.yaml"
    file.write_text(yaml.safe_dump({**data, "horizon": 3, "gate": None, **changes}))
    return file


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """Everything that an attack needs, untrained: an empty field, rough objects, policies with random weights."""
    folder = tmp_path_factory.mktemp("intersection")
    experiment = load_experiment(write_file(folder), "tiny", [], folder / "run")
    torch.manual_seed(0)
    field = SceneField(
        SceneFieldConfig(
            (-60.0, -60.0, -1.0), (60.0, 60.0, 36.0), HashGridConfig(levels=8, features=4, log2_entries=8)
        )
    )
    for stage in ("scene", "object", "policy", "cells"):
        experiment.stage_folder(stage).mkdir(parents=True)
    save_scene(scene_file(experiment), field, np.zeros((16, 16, 5), dtype=bool))
    for kind in ("small_car", "hydrant"):
        save_object(object_file(experiment, kind), build(experiment, kind))
    for victim in (HARDENED, NAIVE):
        policy = PilotNet(3, 1.2, PilotNetConfiguration(hidden=(16, 8, 4))).eval()
        save_policy(Path(victim_spec(experiment, victim)), policy, experiment.view, {"victim": victim})
    return experiment


@pytest.fixture(scope="session")
def tiny_room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], dict[str, set[str]]]:
    """The run folder of a tiny experiment in the lab, run whole, the numbers that sum it up, and the settings that its stages read."""
    made = folder_of_all_workers(tmp_path_factory) / "tiny_room"
    with made_once(made) as folder:
        if folder is not None:
            with recording() as reads:
                found = measured(folder / "run", reads)
            listed = {stage: sorted(names) for stage, names in reads.of.items()}
            (folder / "found.json").write_text(json.dumps([found, listed]))
    # Each worker has a copy, as tests write into it.
    own = tmp_path_factory.mktemp("room") / "run"
    shutil.copytree(made / "run", own)
    found, listed = json.loads((made / "found.json").read_text())
    return own, found, {stage: set(names) for stage, names in listed.items()}


@dataclass
class Wall:
    """A world in closed form: grey ground, and a wall across the world at ``wall_x_m``."""

    wall_x_m: float = 20.0
    blocked_beyond_m: float = np.inf

    def __post_init__(self) -> None:
        world = IntersectionConfig()
        self.camera_pinhole: Pinhole = world.camera.pinhole
        self.photo_pinhole: Pinhole = world.photo.pinhole
        self.T_car_from_camera: Array = world.camera.T_car_from_camera
        self._car = DubinsCar(DubinsConfig.ideal(), lambda x, y, yaw: x <= self.blocked_beyond_m)

    @property
    def state(self) -> VehicleState:
        return self._car.state

    @property
    def blocked(self) -> bool:
        return self._car.blocked

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        return self._car.reset(x_m, y_m, yaw_rad)

    def step(self, control: float, speed_mps: float, duration_s: float) -> VehicleState:
        return self._car.advance(control, speed_mps, duration_s)

    def observe(self, depth: bool = True) -> tuple[Any, Any]:
        return self.observe_at(self.state.x_m, self.state.y_m, self.state.yaw_rad, depth)

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> tuple[Any, Any]:
        T = planar_pose(x_m, y_m, yaw_rad) @ self.T_car_from_camera
        rays = self.camera_pinhole.directions()  # with z = 1, so distances along them are planar depth
        world = rays @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            ground, wall = -T[2, 3] / world[..., 2], (self.wall_x_m - T[0, 3]) / world[..., 0]
        ground, wall = (np.where(part > 0.0, part, np.inf) for part in (ground, wall))
        rgb = np.where((ground < wall)[..., None], (90, 90, 90), (150, 170, 200)).astype(np.uint8)
        return rgb, np.minimum(ground, wall).astype(np.float32) if depth else None

    def describe(self) -> WorldDescription:
        return Intersection().describe()

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        raise NotImplementedError("nothing is learned from this world")

    def photograph(self, T_world_from_camera: Array) -> Any:
        raise NotImplementedError("nothing is learned from this world")

    def __enter__(self) -> "Wall":
        return self

    def __exit__(self, *_: object) -> None:
        pass


@pytest.fixture
def wall() -> Wall:
    """A scene with its defaults."""
    scene = Wall()
    assert isinstance(scene, World)
    return scene


@pytest.fixture
def make_wall() -> type[Wall]:
    """For scenes with other walls."""
    return Wall


@pytest.fixture
def tiny_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes an experiment file with changes."""
    return lambda **changes: write_file(tmp_path, **changes)
