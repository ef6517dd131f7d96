"""The expert, and objects composed by depth, in a CARLA scene behind the scripted server."""

import numpy as np
import pytest
import torch

from advnerf_core.driving.metrics import Horizon
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import make_transform
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds import CarlaConfig, CarlaScene
from nodes.experiment.show.deployed import DressedScene, SelfDriving, drive_deployed
from nodes.lab.worlds.expert_drive import as_path, drive_expert, lane_expert


@pytest.mark.parametrize("name", ["straight", "right", "left"])
def test_the_expert_keeps_its_lane_through_the_junction(library, settings, name):
    """With the deployed car's lag and gain error, from a start beside the lane's middle."""
    config = CarlaConfig.model_validate(settings)
    with CarlaScene(config, library) as scene:
        reference = scene.paths[name]
        expert = lane_expert(as_path(reference), config.car.description, 0.1)
        x, y, yaw = reference.start_pose
        drive = drive_expert(scene, expert, (x - 0.4 * np.sin(yaw), y + 0.4 * np.cos(yaw), yaw), 70, 0.1)
        off_track_m = scene.off_track_m
    assert drive.cte_m[0] == pytest.approx(0.4, abs=0.01)
    assert np.abs(drive.cte_m).max() < 0.45 < off_track_m
    assert np.abs(drive.cte_m[-10:]).max() < 0.1
    assert drive.blocked_tick is None
    assert np.hypot(*np.diff(drive.states[:, :2], axis=0).T) == pytest.approx(0.6, abs=0.01)


def test_the_expert_runs_into_a_wall(library, settings, carla):
    config = CarlaConfig.model_validate(settings)
    with CarlaScene(config, library) as scene:
        ends = [scene.drives.frame.carla_point([-5.0, y, 0.0])[:2] for y in (-8.0, 8.0)]
        library.world.walls = [(*ends, carla.CityObjectLabel.Walls)]
        reference = scene.paths["straight"]
        expert = lane_expert(as_path(reference), config.car.description, 0.1)
        drive = drive_expert(scene, expert, reference.start_pose, 60, 0.1)
    assert 22 < drive.blocked_tick < 28  # (19 - 3.85) m at 0.6 m a tick
    assert drive.states[-1, 0] < -5.0 - 3.85 + 1e-6


def box(x_m, y_m, half_m=0.6):
    """A solid cube of one free colour that stands on the ground."""
    low, high = np.full(3, -half_m), np.full(3, half_m)
    pose = make_transform(np.eye(3), [x_m, y_m, half_m])
    return VoxelGridObject(np.zeros((1, 1, 1), np.int32), (1, 3), np.zeros((0, 3)), low, high, pose)


def hit_m(box, T_world_from_camera, pinhole):
    """Planar depth at which each pixel's ray enters a box, by slabs; infinite where it does not."""
    eye = T_world_from_camera[:3, 3] - box.T_world_from_object[:3, 3]
    rays = pinhole.directions() @ T_world_from_camera[:3, :3].T
    near, far = (box.box_min - eye) / rays, (box.box_max - eye) / rays
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return np.where((enter < leave) & (enter > 0.0), enter, np.inf)


def test_objects_are_composed_by_carlas_depth(library, settings, carla):
    """One cube before a wall of CARLA's, one behind it: the first is seen whole, of the second only what no wall hides."""
    config = CarlaConfig.model_validate(
        {**settings, "camera": {**settings["camera"], "width": 168, "height": 94}}
    )
    with CarlaScene(config, library) as scene:
        ends = [scene.drives.frame.carla_point([-6.0, y, 0.0])[:2] for y in (-10.0, 0.0)]
        library.world.walls = [(*ends, carla.CityObjectLabel.Walls)]
        scene.reset(*scene.paths["straight"].start_pose)
        rgb, depth = scene.observe()
        T = scene.state.T_world_from_car @ scene.T_car_from_camera
        cubes = [box(-9.0, -3.0), box(-3.0, 0.3)]
        surrogate = Surrogate(
            None, scene.camera_pinhole, scene.T_car_from_camera, cubes, supersample=1, opaque=True
        )
        theta = torch.full((2, 3), 9.0)  # white; nothing that the server paints is so blue
        image = (
            surrogate.overlay(rgb[None] / np.float32(255.0), depth[None], T[None], theta)[0]
            .permute(1, 2, 0)
            .numpy()
        )
    white = (image > 0.99).all(-1)
    front, back = (hit_m(cube, T, scene.camera_pinhole) for cube in cubes)
    expected = (front < depth) | (back < depth)
    assert (front < depth).sum() > 60
    assert (back < depth).sum() > 5
    assert (np.isfinite(back) & (back > depth)).sum() > 5  # the wall hides a part of it
    assert (white != expected).mean() < 0.001
    np.testing.assert_allclose(image[~white], rgb[~white] / 255.0, atol=1e-6)


def test_the_intersections_own_loop_drives_in_carla(library, settings):
    """Observe, put the object in by depth, crop for the policy, command: the loop of the experiment, unchanged."""
    config = CarlaConfig.model_validate(
        {**settings, "camera": {**settings["camera"], "width": 336, "height": 188}}
    )
    seen = []

    def policy(images, goals):
        seen.append(images)
        return torch.full((1,), 0.2)

    with CarlaScene(config, library) as scene:
        reference = scene.paths["left"]
        x, y, yaw = reference.start_pose
        cube = box(x + 14.0 * np.cos(yaw), y + 14.0 * np.sin(yaw))
        dressed = DressedScene(scene, PolicyView(scene.camera_pinhole), [cube])
        limits = Horizon(4, 0.1, scene.off_track_m, 6.0)
        arguments = (
            dressed,
            policy,
            reference.goal,
            np.array(reference.start_pose),
            as_path(reference),
            limits,
            SelfDriving(scene, 6.0, limits.dt_s),
        )
        drive = drive_deployed(*arguments, torch.full_like(dressed.plain_theta(), 9.0))
    assert drive.states.shape == (5, 3)
    assert np.hypot(*np.diff(drive.states[:, :2], axis=0).T) == pytest.approx(0.6, abs=0.01)
    assert drive.metrics.total_cte_m == pytest.approx(
        np.abs(as_path(reference).project(drive.states[1:, :2]).cte_m).sum(), rel=0.01
    )
    white = [(image > 0.95).all(1).sum().item() for image in seen]
    assert min(white) > 20  # the cube is in every picture
    assert white[-1] > white[0]  # and comes nearer
