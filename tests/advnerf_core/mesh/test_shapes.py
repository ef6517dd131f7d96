"""Shapes of meshes: the preconditioner, the bound, and the projective gradient against finite differences of ray-cast pictures."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.path import Line, Path
from advnerf_core.geometry import Pinhole, camera_mount, make_transform
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.large_steps import LargeSteps, laplacian
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.scene.surrogate import Surrogate

from .conftest import PINHOLE, POSE, coloured_sphere

BATCH = np.eye(4)[None]


def backdrop(near_m=5.0):
    x, y = np.meshgrid(np.linspace(0, 0.5, 80), np.linspace(0, 1, 40))
    rgb = torch.tensor(np.stack([x, y, 0.2 + 0 * x], axis=-1)[None], dtype=torch.float32)
    depth = torch.full((1, 40, 80), 5.0)
    depth[:, :, :45] = near_m
    return rgb, depth


def smooth_seed():
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(80) / 80, np.arange(40) / 40)
    waves = [np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in rng.uniform(-2, 2, (3, 3))]
    return torch.tensor(np.stack(waves)[None], dtype=torch.float32)


def sensor_of(mesh, near_m=5.0, supersample=2, **limits):
    field = MeshField(mesh, POSE)
    scene = Surrogate(lambda p, c: backdrop(near_m), PINHOLE, np.eye(4), field, 0.0, supersample)
    return ShapeSensor(scene, ShapeLimits(**limits))


@pytest.mark.parametrize(
    ("coloured", "near_m"),
    [
        (False, 1.2),
        pytest.param(False, 5.0, marks=pytest.mark.slow),
        pytest.param(True, 5.0, marks=pytest.mark.slow),
    ],
)
def test_the_vertex_gradient_is_that_of_finite_differences(coloured, near_m):
    # What is nearer than the ball hides half of it; colours are fine enough to be continuous where charts meet.
    mesh = coloured_sphere(resolution=160) if coloured else unwrapped(sphere(0.4, (0.9, 0.2, 0.6), 2), 16)
    sensor = sensor_of(mesh, near_m, 16, bound_m=1e6, smoothness=0.0, samples=16, boundary_samples=16)
    seed, plain = smooth_seed(), torch.zeros(sensor.theta_shape)
    # The seed of the samples follows the theta, so hardly different thetas are independent estimates.
    gradients = [sensor.render(BATCH, plain + 1e-7 * k).vjp(seed).double() for k in range(8)]
    gradient = torch.stack(gradients).mean(0)
    vertices = torch.tensor(mesh.vertices)
    directions = {
        "along x": torch.tensor([1.0, 0.0, 0.0]).expand_as(vertices),
        "along y": torch.tensor([0.0, 1.0, 0.0]).expand_as(vertices),
        "larger": vertices - torch.tensor([0.0, 0.0, 0.4]),
        "waves": torch.sin(vertices @ torch.tensor([[5.0, 1, 0], [0, 3, 2], [1, 0, 4]], dtype=torch.float64)),
    }
    got, expected = [], []
    for direction in directions.values():
        step = (4e-3 * direction).float()
        up, down = (sensor.render(BATCH, s * step).images for s in (1, -1))
        expected.append(float(((up - down).double() * seed).sum() / 8e-3))
        got.append(float((gradient * direction).sum()))
    error = np.linalg.norm(np.subtract(got, expected)) / np.linalg.norm(expected)
    assert error < 0.04, (got, expected)


def test_the_same_seed_gives_the_same_bits_and_the_picture_is_the_surrogates():
    sensor = sensor_of(coloured_sphere())
    theta = sensor.initial_theta(torch.Generator().manual_seed(0))
    first, again = sensor.render(BATCH, theta), sensor.render(BATCH, theta)
    assert torch.equal(first.vjp(smooth_seed()), again.vjp(smooth_seed()))
    assert torch.equal(first.images, again.images)
    plain = sensor.surrogate.render(BATCH, sensor.colours).images
    assert (first.images - plain).abs().max() < 0.3  # the noise of the start moves an edge by a ray at most
    assert (first.images - plain).abs().mean() < 1e-3


def test_several_meshes_have_each_its_own_gradient():
    mesh = unwrapped(sphere(0.3, (0.9, 0.2, 0.6), 1), 16)
    other = unwrapped(sphere(0.2, (0.1, 0.8, 0.3), 1), 24)
    aside = make_transform(np.eye(3), [-0.7, 0.1, 1.8])
    scene = Surrogate(
        lambda p, c: backdrop(), PINHOLE, np.eye(4), [MeshField(mesh, POSE), MeshField(other, aside, 1.5)]
    )
    limits = ShapeLimits(samples=16, boundary_samples=16)
    both = ShapeSensor(scene, limits).render(BATCH, torch.zeros(42 * 2, 3)).vjp(smooth_seed())
    for k, field in enumerate(scene.objects):
        alone = (
            ShapeSensor(scene.with_objects([field]), limits)
            .render(BATCH, torch.zeros(42, 3))
            .vjp(smooth_seed())
        )
        part = both[42 * k : 42 * (k + 1)]
        assert torch.norm(part - alone) < 0.15 * torch.norm(alone)


def test_the_preconditioner_is_that_of_large_steps():
    mesh = unwrapped(sphere(0.4, (0, 0, 0), 1))
    n, rng = len(mesh.vertices), np.random.default_rng(0)
    dense = np.zeros((n, n))
    for face in mesh.faces:
        for a, b in ((0, 1), (1, 2), (2, 0)):
            dense[face[a], face[b]] = dense[face[b], face[a]] = -1.0
    dense -= np.diag(dense.sum(1))
    assert np.array_equal(laplacian(n, mesh.faces).toarray(), dense)
    right = rng.standard_normal((n, 3))
    expected = np.linalg.solve(np.eye(n) + 19.0 * dense, right)
    steps = LargeSteps(n, mesh.faces, 19.0)
    np.testing.assert_allclose(steps.solve(right), expected, atol=1e-12)
    # A shift of all vertices passes unchanged; it is its own transpose.
    np.testing.assert_allclose(steps.solve(np.ones((n, 3))), np.ones((n, 3)), atol=1e-12)
    other = rng.standard_normal((n, 3))
    assert np.isclose((other * steps.solve(right)).sum(), (right * steps.solve(other)).sum())


def test_no_vertex_leaves_its_bound_or_the_ground():
    sensor = sensor_of(unwrapped(sphere(0.4, (0, 0, 0), 2)), bound_m=0.1)
    (moved,) = sensor.vertices(
        100.0 * torch.randn(sensor.theta_shape, generator=torch.Generator().manual_seed(0))
    )
    distance = (moved - torch.tensor(sensor.meshes[0].mesh.vertices)).norm(dim=1)
    assert 0.08 < float(distance.max()) <= 0.1 + 1e-12
    assert float(moved[:, 2].min()) >= 0.0


def test_the_pull_back_is_the_derivative_of_the_vertices():
    sensor = sensor_of(unwrapped(sphere(0.4, (0, 0, 0), 1)), bound_m=0.05)
    generator = torch.Generator().manual_seed(0)
    theta, along = (
        torch.randn(sensor.theta_shape, generator=generator, dtype=torch.float64) for _ in range(2)
    )
    slopes = torch.randn(sensor.theta_shape, generator=generator, dtype=torch.float64)
    up, down = (sensor.vertices(theta + s * 1e-6 * along)[0] for s in (1, -1))
    expected = float(((up - down) * slopes).sum() / 2e-6)
    assert np.isclose(float((sensor._pulled_back(theta, slopes) * along).sum()), expected, rtol=1e-6)


class _Wheel(torch.nn.Module):
    """Steers by where the picture is bright: smooth, with a gradient everywhere."""

    stateless = True
    goal_size = 0

    def forward(self, images, goals=None):
        ramp = torch.linspace(-1, 1, images.shape[-1], dtype=images.dtype)
        return 0.3 * torch.tanh(8.0 * (images.mean((1, 2)) * ramp).mean(-1))


@pytest.fixture
def problem():
    lens = Pinhole(50, 16, 26.0, 26.0, 25.0, 7.0)
    grey = torch.full((1, 16, 50, 3), 0.3), torch.full((1, 16, 50), 6.0)
    field = MeshField(
        unwrapped(sphere(0.3, (0.9, 0.9, 0.9), 2), 8), make_transform(np.eye(3), [2.0, 0.25, 0.0])
    )
    mount = camera_mount(0.1, 0.0, 0.25)
    scene = Surrogate(
        lambda p, c: tuple(part.expand(len(p), *part.shape[1:]) for part in grey), lens, mount, field
    )
    path = Path.from_segments((0.0, 0.0, 0.0), [Line(6.0)], closed=False)
    starts = torch.tensor([[0.0, 0.02, 0.0]], dtype=torch.float64)
    sensor = ShapeSensor(scene, ShapeLimits(bound_m=0.15, smoothness=4.0))
    return AttackProblem(_Wheel().eval(), sensor, Ackermann(0.3, 1.0, 0.1, (-0.4, 0.4)), path, starts, 8)


@pytest.mark.slow  # its parts are in the other tests here, and nodes/experiment/node resumes shapes by default
def test_an_attack_on_shapes_gains_and_resumes_to_the_bit(problem, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # sums over samples keep their order all the same
    rate = problem.sensor.learning_rate
    whole = gradient_attack(problem, 6, rate, run=SearchRun(state_path=tmp_path / "whole.safetensors"))
    totals = [evaluation.predicted_total_cte_m for evaluation in whole.history]
    assert max(totals) > 1.05 * totals[0]
    cut = tmp_path / "cut.safetensors"
    gradient_attack(problem, 3, rate, run=SearchRun(state_path=cut))
    fresh = dataclasses.replace(problem, sensor=ShapeSensor(problem.sensor.surrogate, problem.sensor.limits))
    resumed = gradient_attack(fresh, 6, rate, run=SearchRun(state_path=cut))
    assert torch.equal(resumed.theta, whole.theta)
    assert [e.loss_m for e in resumed.history] == [e.loss_m for e in whole.history]


def test_the_adjoint_of_a_shape_renders_again_what_it_did_not_keep(problem):
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    kept = adjoint_gradient(problem, theta)
    again = adjoint_gradient(dataclasses.replace(problem, cache_bytes=0, time_batch=3), theta)
    assert again.rerendered == problem.steps
    assert kept.loss == again.loss
    assert torch.allclose(kept.gradient, again.gradient, rtol=1e-4, atol=1e-9)
    assert float(kept.gradient.norm()) > 0.0


def test_what_has_no_free_shape_is_refused():
    scene = Surrogate(lambda p, c: backdrop(), PINHOLE, np.eye(4))
    with pytest.raises(ValueError, match="one or more meshes"):
        ShapeSensor(scene)
    with pytest.raises(ValueError, match="bound above zero"):
        ShapeLimits(bound_m=0.0)
    with pytest.raises(ValueError, match="one sample a pixel"):
        ShapeLimits(samples=0)
    with pytest.raises(ValueError, match="theta of shape"):
        sensor_of(unwrapped(sphere(0.4, (0, 0, 0), 0))).vertices(torch.zeros(1, 3))
    with pytest.raises(ValueError, match="smoothness"):
        LargeSteps(3, np.array([[0, 1, 2]], np.int32), -1.0)
