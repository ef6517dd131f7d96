"""Unbounded scenes: kernels against plain torch in contracted space, a far environment, and scene files from before there were any."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.render.march import MarchConfig, Marcher, Samples
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.render.rays import poses_in_box
from advnerf_core.scene.bake import bake
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.field import SceneField, SceneFieldConfig, load_scene, save_scene, scene_hash
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.torch_step import TorchStep, render_rays
from advnerf_core.scene.train import TrainConfig, Trainer, train_scene
from advnerf_core.scene.train_step import CpuStep, distortion_distances
from tests.support.contraction import contract
from tests.support.fields import random_field

GRID = HashGridConfig(levels=6, features=4, log2_entries=13, coarsest=8, finest=192)
FIELD = SceneFieldConfig(
    (-1.0, -1.0, -0.5), (1.0, 1.0, 0.5), GRID, hidden=16, features=7, direction_bands=2, contraction=True
)
MARCH = MarchConfig(near_m=0.05, smallest_step_m=0.01, largest_step_m=0.05, step_growth=0.03, max_samples=256)
WIDE = MarchConfig(near_m=0.05, smallest_step_m=0.03, largest_step_m=0.1, step_growth=0.06, max_samples=128)
CAMERA = Pinhole(40, 30, 22.0, 22.0, 20.0, 15.0)
RUNS = Path(__file__).resolve().parents[3] / "runs"


def some_rays(count: int, seed: int) -> tuple[NDArray[np.float32], Samples]:
    """Rays of which half of the cells, near and far, are occupied."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= FIELD.extent_m * np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.concatenate([rng.uniform(0.2, 0.8, (count, 3)), directions], axis=1).astype(np.float32)
    leaps = leap_distances(rng.random((32, 32, 32)) > 0.5, np.full(3, 32.0))
    samples, kept = Marcher(1 << 18, MARCH, FIELD.box_high, True)(
        rays, rng.random(count, dtype=np.float32), leaps
    )
    assert len(kept) == count
    return rays, samples


def test_world_points_go_to_the_cube() -> None:
    # The cube around the flat box is the inner region: z from -1 to 1.
    points = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [4.0, 1.0, -2.0]])
    expected = [[0.5, 0.5, 0.5], [0.75, 0.25, 0.75], [(1.75 + 2) / 4, (0.25 + 2) / 4, (-0.5 + 2) / 4]]
    np.testing.assert_allclose(contract((points - FIELD.origin_m) / FIELD.extent_m), expected)
    np.testing.assert_allclose(poses_in_box(np.eye(4)[None], FIELD.origin_m, FIELD.extent_m)[0, :, 3], 0.5)


def test_hand_written_gradients_agree_with_automatic_differentiation() -> None:
    rays, samples = some_rays(200, seed=1)
    assert contract(rays[:, :3]).min() >= 0.25
    assert (np.abs(samples.points - 0.5).max(axis=1) > 0.25).mean() > 0.3, (
        "many samples lie outside the inner region"
    )
    targets = np.random.default_rng(2).integers(0, 256, (200, 3)).astype(np.uint8)
    kernels = CpuStep(random_field(FIELD, 3), 0.1, distortion=0.3, opacity=0.02)
    plain = TorchStep(random_field(FIELD, 3), 0.1, distortion=0.3, opacity=0.02)
    first, second = kernels.step(rays, targets, samples), plain.step(rays, targets, samples)
    assert first.samples == second.samples
    assert second.loss == pytest.approx(first.loss, rel=1e-4)
    for name, gradient in plain.grads.items():
        scale = gradient.abs().max().item()
        np.testing.assert_allclose(kernels.grads[name], gradient, atol=5e-5 * scale, err_msg=name)
    distances, lengths = distortion_distances(samples, FIELD)
    assert distances.max() < 2.0
    assert lengths.max() <= samples.widths.max()


def test_the_renderer_agrees_with_plain_torch_in_colour_and_planar_depth() -> None:
    scene, rng = random_field(FIELD, 4), np.random.default_rng(5)
    occupied = rng.random((32, 32, 32)) > 0.6
    T = look_at([0.3, -0.2, 0.1], [2.0, 1.0, 0.4])
    rgb, depth_m, alpha = FieldRenderer(scene, occupied, MARCH, least_transmittance=1e-4).render(
        T[None], CAMERA
    )
    directions = CAMERA.directions()
    cosine = 1.0 / np.linalg.norm(directions, axis=-1)
    pose = poses_in_box(T[None], FIELD.origin_m, FIELD.extent_m)[0]
    rays = np.empty((30 * 40, 6), np.float32)
    rays[:, :3], rays[:, 3:] = pose[:, 3], ((directions * cosine[..., None]) @ pose[:, :3].T).reshape(-1, 3)
    leaps = leap_distances(occupied, np.full(3, 32.0))
    samples, kept = Marcher(1 << 20, MARCH, FIELD.box_high, True)(
        rays, np.full(len(rays), 0.5, np.float32), leaps
    )
    assert len(kept) == len(rays)
    with torch.no_grad():
        colours, weights, opacity = render_rays(scene, torch.from_numpy(rays), samples)
    difference = (colours.reshape(30, 40, 3) - rgb[0]).abs()
    assert difference.mean() < 1e-3
    ray_of = np.repeat(np.arange(len(rays)), np.diff(samples.begins))
    mean_t = np.bincount(ray_of, weights.numpy() * samples.t_mid_m, len(rays)) / opacity.numpy()
    error = np.abs(mean_t.reshape(30, 40) * cosine - depth_m[0].numpy())
    assert np.median(error) < 1e-3
    assert depth_m.max() > 3.0, "some of what is seen lies outside the inner region"
    assert (alpha[0] - opacity.reshape(30, 40)).abs().median() < 1e-4


def test_a_baked_scene_looks_like_its_contracted_field(tmp_path: Path) -> None:
    """A smooth field that fills all space, so that what is seen lies on both sides of the inner region's border."""
    smooth = HashGridConfig(levels=3, features=4, log2_entries=13, coarsest=6, finest=14)
    config = dataclasses.replace(FIELD, grid=smooth, direction_bands=1)
    scene = random_field(config, 4)
    with torch.no_grad():
        scene.density_2.bias[0] = -0.3
        scene.colour_2.weight *= 3.0
    field = FieldRenderer(scene, np.ones((32, 32, 32), np.bool_), WIDE)
    poses = environment_poses(8, 3)
    baked = bake(field, poses, CAMERA)
    (rgb, depth_m, alpha), (field_rgb, field_depth_m, field_alpha) = (
        each.render(poses, CAMERA) for each in (baked, field)
    )
    assert psnr(rgb.numpy(), field_rgb.numpy()) > 45.0
    assert field_rgb.std() > 0.1
    far = field_depth_m > 2.5
    assert 0.1 < far.float().mean() < 0.9
    for part in (far, ~far):
        assert ((depth_m - field_depth_m).abs() / field_depth_m)[part].median() < 0.01
    assert (alpha - field_alpha).abs().mean() < 0.01
    baked.save(tmp_path / "baked.safetensors")
    again = BakedScene.load(tmp_path / "baked.safetensors").render(poses, CAMERA)[0]
    assert torch.equal(again, rgb)


def environment(T: Array, radius_m: float = 8.0) -> NDArray[np.uint8]:
    """A textured ball of 0.4 m in the middle of a large sphere whose inside is painted finely."""
    o, d = T[:3, 3], CAMERA.directions() @ T[:3, :3].T
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ o
    far = o + (-b + np.sqrt(b * b - o @ o + radius_m**2))[..., None] * d
    rgb = 0.5 + 0.4 * np.sin(4.0 * far[..., [1, 2, 0]] / radius_m + 6.0 * far / radius_m + [0.0, 1.0, 2.0])
    under = b * b - o @ o + 0.4**2
    hit = (under > 0.0) & (b < 0.0)
    near = o + (-b - np.sqrt(np.maximum(under, 0.0)))[..., None] * d
    ball = 0.5 + 0.4 * np.sin(8.0 * near + [2.0, 0.0, 1.0])
    return np.rint(255 * np.where(hit[..., None], ball, rgb)).astype(np.uint8)


def environment_poses(count: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    eyes = rng.normal(size=(count, 3))
    eyes *= rng.uniform(0.7, 0.95, (count, 1)) / np.linalg.norm(eyes, axis=1, keepdims=True)
    return np.stack([look_at(eye, rng.uniform(-0.4, 0.4, 3)) for eye in eyes])


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_a_far_environment_is_learned_only_with_the_contraction(backend: str) -> None:
    poses, held_out = environment_poses(150, 0), environment_poses(6, 1)
    images = ImageSet(np.stack([environment(T) for T in poses]), (CAMERA,) * 150, poses)
    real = np.stack([environment(T) for T in held_out]) / 255.0
    config = TrainConfig(
        steps=600,
        samples_per_step=1 << 14,
        max_rays=1024,
        occupancy_resolution=32,
        warmup_steps=40,
        march=WIDE,
        opacity=0.0,
        distortion=2e-3,
        backend=backend,
    )
    field = dataclasses.replace(FIELD, box_low_m=(-1.0, -1.0, -1.0), box_high_m=(1.0, 1.0, 1.0))
    reached = {}
    for contraction in (False, True):
        trained = train_scene(images, dataclasses.replace(field, contraction=contraction), config)
        rendered, depth_m, _ = FieldRenderer(trained.scene, trained.occupied, trained.march).render(
            held_out, CAMERA
        )
        reached[contraction] = psnr(rendered.numpy(), real)
    assert reached[True] > 23.0
    assert reached[True] > reached[False] + 8.0
    assert depth_m[torch.isfinite(depth_m)].median() > 4.0, (
        "the environment is seen far outside the inner region"
    )


def test_a_contracted_scene_survives_its_file_and_an_interruption(tmp_path: Path) -> None:
    poses = environment_poses(4, 2)
    images = ImageSet(np.stack([environment(T) for T in poses]), (CAMERA,) * 4, poses)
    config = TrainConfig(
        steps=20,
        samples_per_step=2048,
        max_rays=256,
        occupancy_resolution=16,
        warmup_steps=4,
        march=MARCH,
        opacity=0.0,
    )
    whole = train_scene(images, FIELD, config)
    half = Trainer(images, FIELD, config)
    with torch.no_grad():
        for _ in range(11):
            half.train_step()
        half.save(tmp_path / "checkpoint.safetensors")
        resumed = Trainer(images, FIELD, config).run(checkpoint=tmp_path / "checkpoint.safetensors")
    content = save_scene(tmp_path / "scene.safetensors", whole.scene, whole.occupied)
    assert scene_hash(resumed.scene, resumed.occupied) == content
    scene, occupied, metadata = load_scene(tmp_path / "scene.safetensors")
    assert scene.config == FIELD
    assert scene_hash(scene, occupied) == metadata["scene_hash"] == content
    other = SceneField(dataclasses.replace(FIELD, contraction=False))
    other.load_state_dict(scene.state_dict())
    assert scene_hash(other, occupied) != content


def test_configurations_survive_json() -> None:
    assert SceneFieldConfig.from_dict(json.loads(json.dumps(FIELD.to_dict()))) == FIELD


@pytest.mark.skipif(not list(RUNS.glob("**/scene*.safetensors")), reason="needs a scene of an earlier run")
def test_stored_scenes_keep_their_hashes() -> None:
    for path in sorted(RUNS.glob("**/scene*.safetensors")):
        with safe_open(str(path), framework="pt") as file:
            stored = file.metadata()["scene_hash"]
        scene, occupied, _ = load_scene(path)
        assert scene_hash(scene, occupied) == stored, path
