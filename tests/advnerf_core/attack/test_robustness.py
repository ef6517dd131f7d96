"""Disturbed attacks: the gradient against finite differences under the same draws, and what a draw depends on."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from advnerf_core.attack.health import (
    central_slopes,
    frozen_loss,
    random_directions,
    relative_error,
    slopes_of,
)
from advnerf_core.attack.robustness import Disturbances, Smoothness
from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.fields.voxel_grid import VoxelGridObject, squash
from tests.support.attack_toy import face, toy_problem

EVERYTHING = Disturbances(noise=0.02, gain=0.1, brightness=0.02, jitter_m=0.01, jitter_rad=0.01, seed=3)


@pytest.fixture(scope="module")
def problem():
    return toy_problem(5, time_batch=2)


@pytest.fixture(scope="module")
def theta(problem):
    return torch.randn(
        problem.sensor.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )


def slopes_agree(problem, theta, result):
    directions = random_directions(theta, 3)
    numeric = central_slopes(lambda t: frozen_loss(problem, t, result.rollout), theta, directions, 1e-4)
    return relative_error(slopes_of(result.gradient, directions), numeric)


def test_disturbed_gradient_equals_finite_differences_under_the_same_draws(problem, theta):
    disturbed = dataclasses.replace(problem, disturbances=EVERYTHING, draw=4)
    result = adjoint_gradient(disturbed, theta)
    assert slopes_agree(disturbed, theta, result) <= 1e-5
    # The undisturbed derivative is another one.
    assert slopes_agree(problem, theta, result) > 1e-3


def test_the_backward_pass_meets_the_frames_of_the_forward_pass(problem, theta):
    disturbed = dataclasses.replace(problem, disturbances=EVERYTHING)
    kept = adjoint_gradient(disturbed, theta)
    again = adjoint_gradient(dataclasses.replace(disturbed, cache_bytes=0), theta)
    assert again.rerendered == 5
    torch.testing.assert_close(again.gradient, kept.gradient, rtol=1e-10, atol=1e-14)


def test_draws_depend_on_seed_and_number_only(problem, theta):
    def total(**changes):
        disturbances = dataclasses.replace(EVERYTHING, seed=changes.pop("seed", 3))
        return evaluate(dataclasses.replace(problem, disturbances=disturbances, **changes), theta)[
            1
        ].total_cte_m

    assert torch.equal(total(draw=1), total(draw=1))
    assert not torch.equal(total(draw=1), total(draw=2))
    assert not torch.equal(total(draw=1), total(draw=1, seed=4))
    assert torch.equal(total(draw=1, steps=5), total(draw=1))


def test_disturbances_have_the_spreads_that_were_asked_for(problem, theta):
    states = problem.start_states[:1].repeat(200, 1)
    clean = problem.sensor.sense(states[:1], theta).images
    exposed = (
        Disturbances(gain=0.1, brightness=0.01).disturb(problem.sensor.sense(states, theta), (0,), 0).images
    )
    # A line through exposed = gain * clean + brightness for every drive; dark pixels, where nothing clips.
    pixels = clean.flatten()[clean.flatten() < 0.6]
    seen = exposed.flatten(1)[:, clean.flatten() < 0.6]
    slope, offset = np.polyfit(pixels.numpy(), seen.T.numpy(), 1)
    assert abs(np.log(slope).std() - 0.1) < 0.02
    assert abs(offset.std() - 0.01) < 0.003
    noisy = (
        Disturbances(noise=0.02).disturb(problem.sensor.sense(states[:2], theta), (0, 1), 0).images - clean
    )
    assert abs(noisy.std().item() - 0.02) < 1e-3
    assert abs(np.corrcoef(noisy[0].flatten(), noisy[1].flatten())[0, 1]) < 0.02
    poses = np.tile(np.eye(4), (500, 1, 1))
    moved = Disturbances(jitter_m=0.05, jitter_rad=0.02).camera_poses(poses, (7,), 0)
    np.testing.assert_allclose(moved[:, :3, 3].std(0), 0.05, rtol=0.15)
    angles = np.arccos((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2)
    np.testing.assert_allclose(np.sqrt((angles**2).mean() / 3), 0.02, rtol=0.1)


def test_clipped_pixels_have_no_gradient(problem, theta):
    bright = Disturbances(brightness=50.0, seed=1)
    rendered = bright.disturb(problem.sensor.sense(problem.start_states, theta), (0,), 0)
    assert set(rendered.images.unique().tolist()) <= {0.0, 1.0}
    assert not rendered.vjp(torch.ones_like(rendered.images)).any()


def test_the_delayed_lagging_car_has_the_right_gradient_too(problem, theta):
    car = ActuatedAckermann(0.25, 0.8, 0.1, delay_s=0.13, lag_s=0.06, slew_radps=2.0)
    starts = torch.nn.functional.pad(problem.start_states, (0, car.state_size - 3))
    slow = dataclasses.replace(problem, dynamics=car, start_states=starts, steps=7)
    result = adjoint_gradient(slow, theta)
    assert slopes_agree(slow, theta, result) <= 1e-5


def test_total_variation_written_out_and_its_gradient():
    field = face(4)
    pairs = field.neighbours()
    assert len(pairs) == 2 * 4 * 3  # a 4 x 4 grid has 24 edges; the depth of the slab shows the same rows
    theta = torch.randn(field.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    smooth = Smoothness([field], weight=2.0)
    colours = squash(theta)
    across, down = colours[:, 1:] - colours[:, :-1], colours[1:] - colours[:-1]
    soft = sum(float((torch.sqrt(d**2 + 1e-4) - 1e-2).sum()) for d in (across, down))
    value, gradient = smooth(theta)
    np.testing.assert_allclose(value, 2.0 * soft / 24, rtol=1e-12)
    directions = random_directions(theta, 4)
    numeric = central_slopes(lambda t: smooth(t)[0], theta, directions, 1e-5)
    assert relative_error(slopes_of(gradient, directions), numeric) <= 1e-8


def test_smoothness_of_a_volume_counts_its_neighbours_in_space():
    slots = np.arange(8, dtype=np.int32).reshape(2, 2, 2)
    slots[1, 1, 1] = 7  # the last is fixed
    cube = VoxelGridObject(slots, (7, 3), np.zeros((1, 3)), np.zeros(3), np.ones(3), np.eye(4))
    assert sorted(map(tuple, cube.neighbours())) == [
        (0, 1),
        (0, 2),
        (0, 4),
        (1, 3),
        (1, 5),
        (2, 3),
        (2, 6),
        (4, 5),
        (4, 6),
    ]


def test_smoothness_joins_loss_and_gradient(problem, theta):
    smooth = dataclasses.replace(problem, regulariser=Smoothness(problem.sensor.objects, 3.0))
    plain, result = adjoint_gradient(problem, theta), adjoint_gradient(smooth, theta)
    value, gradient = smooth.regulariser(theta)
    assert result.loss == plain.loss + value
    torch.testing.assert_close(result.gradient, plain.gradient + gradient)
    assert slopes_agree(smooth, theta, result) <= 1e-5


def test_a_sensor_whose_camera_cannot_move_is_refused(problem):
    class Fixed:
        theta_shape = problem.sensor.theta_shape
        sense = problem.sensor.sense

    with pytest.raises(ValueError, match="expected a sensor with camera_poses and render"):
        dataclasses.replace(problem, sensor=Fixed(), disturbances=EVERYTHING)
    with pytest.raises(ValueError, match="expected finite spreads"):
        Disturbances(noise=-1.0)
