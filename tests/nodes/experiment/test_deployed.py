"""What is composed into a scene that gives colours and depth, and the drive of its own car."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Line, Path
from advnerf_core.errors import NotFiniteError
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import make_transform
from advnerf_core.objects.voxel.model import load_object
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.view import PolicyView
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import DressedScene, IdealDriving, SelfDriving, drive_deployed
from nodes.experiment.show.objects import object_file

STRAIGHT = Path.from_segments((0.0, 0.0, 0.0), [Line(60.0)], closed=False)


class Steady:
    """A policy that turns as its goal says, whatever it sees, and remembers how bright that was."""

    stateless = True

    def __init__(self) -> None:
        self.brightness: list[float] = []

    def __call__(self, images: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        assert goals is not None
        assert images.shape == (1, 3, 66, 200)
        self.brightness.append(float(images.mean()))
        return goals[:, 0]


@pytest.fixture(scope="module")
def car(trained: Experiment) -> VoxelGridObject:
    """A parked car, 10 m ahead of the origin and 3 m to its left."""
    return load_object(object_file(trained, "small_car")).placed(make_transform(np.eye(3), [10.0, 3.0, 0.0]))


def dressed(scene: Any, *objects: VoxelGridObject) -> DressedScene:
    return DressedScene(scene, PolicyView(scene.camera_pinhole), objects)


def test_nearer_of_scene_and_object_wins(car: VoxelGridObject, make_wall: Any) -> None:
    state, red = np.zeros(3), torch.full((car.parameter_count, 3), -9.0)
    red[:, 0] = 9.0
    bare = dressed(make_wall(20.0)).camera_image(state, None)
    before_wall = dressed(make_wall(20.0), car).camera_image(state, red)
    behind_wall = dressed(make_wall(6.0), car).camera_image(state, red)
    is_red = (before_wall == [255, 0, 0]).all(axis=2)
    # Opaque: a pixel shows the object or the scene, never a mixture.
    assert (before_wall[~is_red] == bare[~is_red]).all()
    assert 600 < is_red.sum() < 4000
    np.testing.assert_array_equal(behind_wall, dressed(make_wall(6.0)).camera_image(state, None))
    # It is where a car 10 m ahead and 3 m to the left is: left of the middle, about the horizon.
    rows, columns = np.nonzero(is_red)
    assert columns.max() < 168
    scene = make_wall()
    T_camera_from_world = np.linalg.inv(scene.T_car_from_camera)
    middle = scene.camera_pinhole.project((T_camera_from_world @ [10.0, 3.0, 0.8, 1.0])[:3])
    assert np.hypot(columns.mean() - middle[0], rows.mean() - middle[1]) < 8.0


def test_policy_sees_the_resized_window_of_the_camera_image(car: VoxelGridObject, wall: Any) -> None:
    scene = wall
    there, view = dressed(scene, car), PolicyView(scene.camera_pinhole)
    state = np.array([1.0, 0.3, 0.1])
    expected = view.image(there.camera_image(state, there.plain_theta()))
    np.testing.assert_array_equal(there.policy_images(there.prepare(state[None]), None)[0], expected)
    scene.reset(*state)
    np.testing.assert_array_equal(there.seen_now(there.plain_theta()), expected)
    assert not np.array_equal(expected, view.image(cv2.convertScaleAbs(scene.observe()[0])))


def own_car(scene: Any) -> SelfDriving:
    return SelfDriving(scene, 6.0, 0.1)


def test_drive_is_that_of_the_scenes_own_car(wall: Any) -> None:
    policy, limits = Steady(), Horizon(ticks=5, dt_s=0.1, off_track_m=1.75, held_cap_m=6.0)
    done = drive_deployed(dressed(wall), policy, (0.4,), np.zeros(3), STRAIGHT, limits, own_car(wall), None)
    states, ideal = torch.zeros(1, 3, dtype=torch.float64), Dubins(6.0, 0.1)
    for tick in range(5):
        np.testing.assert_allclose(done.states[tick], states[0].numpy(), atol=1e-9)
        states = ideal.step(states, torch.tensor([0.4], dtype=torch.float64))
    assert done.metrics.total_cte_m == pytest.approx(float(np.abs(done.states[1:, 1]).sum()))
    assert done.controls.tolist() == pytest.approx([0.4] * 5)
    assert policy.brightness[-1] > policy.brightness[0]  # the bright wall comes nearer


def test_a_policy_without_goals_is_given_none(wall: Any) -> None:
    class Goalless(Steady):
        def __call__(self, images: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
            assert goals is None
            return super().__call__(images, torch.full((1, 1), 0.4))

    limits = Horizon(ticks=3, dt_s=0.1, off_track_m=1.75, held_cap_m=6.0)
    alone = drive_deployed(dressed(wall), Goalless(), (), np.zeros(3), STRAIGHT, limits, own_car(wall), None)
    told = drive_deployed(dressed(wall), Steady(), (0.4,), np.zeros(3), STRAIGHT, limits, own_car(wall), None)
    assert np.array_equal(alone.states, told.states)


def test_an_ideal_car_does_what_it_is_told_in_any_world(make_wall: Any, car: VoxelGridObject) -> None:
    limits = Horizon(ticks=6, dt_s=0.1, off_track_m=1.75, held_cap_m=6.0)
    # Its own car would be stopped; and what the policy sees is where the ideal one is.
    scene, policy = make_wall(blocked_beyond_m=2.0), Steady()
    ideal = IdealDriving(Dubins(6.0, 0.1), fence_m=3.0)
    done = drive_deployed(dressed(scene), policy, (0.4,), np.zeros(3), STRAIGHT, limits, ideal, None)
    yaw = 0.04 * np.arange(7)
    chord = 2.0 * 15.0 * np.sin(0.02)  # of the circle of 6 m/s and 0.4 rad/s
    steps = chord * np.stack([np.cos(yaw[:-1] + 0.02), np.sin(yaw[:-1] + 0.02)], axis=1)
    expected = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    np.testing.assert_allclose(done.states, np.c_[expected, yaw], atol=1e-9)
    assert (done.blocked_tick, done.collided_with) == (6, "obstacle")  # the fence: 3.6 m after six ticks
    assert policy.brightness[-1] > policy.brightness[0]
    assert scene.state.x_m == 0.0
    # Attacked: every picture is the composed one.
    there, seen = dressed(make_wall(), car), []

    def watching(images: torch.Tensor, goals: torch.Tensor | None) -> torch.Tensor:
        seen.append(images)
        return torch.full((1,), 0.4)

    colours = torch.full_like(there.plain_theta(), 9.0)
    ideal = IdealDriving(Dubins(6.0, 0.1), fence_m=None)
    again = drive_deployed(there, watching, (0.4,), np.zeros(3), STRAIGHT, limits, ideal, colours)
    assert again.blocked_tick is None
    for state, image in zip(again.states, seen, strict=False):
        wanted = there.view.image(there.camera_image(state, colours))
        assert torch.equal(image, images_to_tensor(wanted))


def test_a_blocked_car_is_charged_what_it_had(make_wall: Any) -> None:
    limits = Horizon(ticks=6, dt_s=0.1, off_track_m=1.75, held_cap_m=6.0)
    done, free = (
        drive_deployed(dressed(scene), Steady(), (1.0,), np.zeros(3), STRAIGHT, limits, own_car(scene), None)
        for scene in (make_wall(blocked_beyond_m=2.0), make_wall())
    )
    assert free.blocked_tick is None
    assert done.blocked_tick == 4
    assert done.metrics.held_ticks == 2
    last = abs(done.metrics.ctes_m[3])
    assert done.metrics.total_cte_m == pytest.approx(sum(map(abs, done.metrics.ctes_m[:4])) + 2 * last)
    assert done.metrics.total_cte_m < free.metrics.total_cte_m


def test_a_command_that_is_no_number_ends_a_drive_of_a_world_with_the_reason(make_wall: Any) -> None:
    """A world's usual clamp passes NaN on, and its car then seems to be blocked: a policy that fails would have driven well."""

    class Broken(Steady):
        def __call__(self, images, goals=None):
            return torch.full((len(images),), math.nan)

    limits = Horizon(ticks=6, dt_s=0.1, off_track_m=1.75, held_cap_m=6.0)
    scene = make_wall()
    with pytest.raises(NotFiniteError, match="finite steering from the policy, got nan at tick 0"):
        drive_deployed(dressed(scene), Broken(), (1.0,), np.zeros(3), STRAIGHT, limits, own_car(scene), None)
