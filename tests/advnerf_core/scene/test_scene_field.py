"""The scene field end to end on a room whose images are known in closed form."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, look_at
from advnerf_core.parallel import set_thread_count
from advnerf_core.render.march import MarchConfig, Marcher
from advnerf_core.render.march_kernels import span_in_box
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.render.volume_kernels import MAX_LOG_DENSITY
from advnerf_core.scene.bake import NotBakedError, bake
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.baked_kernels import LOG_STEP, LOWEST_LOG
from advnerf_core.scene.colour import ColourMap
from advnerf_core.scene.field import SceneField, SceneFieldConfig, SceneFileError, load_scene, save_scene
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.torch_step import render_rays
from advnerf_core.scene.train import CheckpointError, TrainConfig, TrainedScene, Trainer
from advnerf_core.scene.train_step import CpuStep
from tests.support.colour_room import CAMERA, room_images, room_poses, room_view

BOX = ((-1.05, -1.05, -0.55), (1.05, 1.05, 0.55))
FIELD = SceneFieldConfig(
    *BOX, grid=HashGridConfig(levels=6, features=2, log2_entries=12, coarsest=8, finest=96), hidden=16
)
FIELD = dataclasses.replace(FIELD, grid=dataclasses.replace(FIELD.grid, features=4), features=7)
MARCH = MarchConfig(near_m=0.05, smallest_step_m=0.01, largest_step_m=0.05, step_growth=0.02, max_samples=128)
TRAIN = TrainConfig(
    steps=500, samples_per_step=1 << 13, max_rays=1024, occupancy_resolution=32, warmup_steps=60, march=MARCH
)


@pytest.fixture(scope="module")
def trained() -> TrainedScene:
    return Trainer(room_images(), FIELD, TRAIN).run()


def test_it_learns_colours_and_depth_of_views_it_never_saw(trained: TrainedScene) -> None:
    poses = room_poses(4, seed=1)
    rgb, depth_m, alpha = FieldRenderer(trained.scene, trained.occupied, trained.march).render(poses, CAMERA)
    views = [room_view(T) for T in poses]
    assert psnr(rgb.numpy(), np.stack([v[0] for v in views]) / 255.0) > 24.0
    error_m = np.abs(depth_m.numpy() - np.stack([v[1] for v in views]))
    assert np.median(error_m) < 0.06
    assert alpha.mean() > 0.85


def test_rendering_agrees_with_plain_torch_and_is_the_same_each_time(trained: TrainedScene) -> None:
    renderer = FieldRenderer(trained.scene, trained.occupied, trained.march, least_transmittance=1e-4)
    poses = room_poses(2, seed=2)
    first, again = renderer.render(poses, CAMERA), renderer.render(torch.from_numpy(poses), CAMERA)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    alone = renderer.render(poses[1:], CAMERA)
    assert torch.equal(alone[0][0], first[0][1]), "a view does not depend on the batch it is in"

    rays = np.empty((2 * 36 * 48, 6), np.float32)
    directions = CAMERA.directions() / np.linalg.norm(CAMERA.directions(), axis=-1, keepdims=True)
    for k, T in enumerate(poses):
        part = slice(k * 36 * 48, (k + 1) * 36 * 48)
        rays[part, :3] = (T[:3, 3] - np.array(BOX[0])) / FIELD.extent_m
        rays[part, 3:] = (directions @ T[:3, :3].T).reshape(-1, 3) / FIELD.extent_m
    leaps = leap_distances(trained.occupied, np.array(trained.occupied.shape) / FIELD.box_high)
    samples, kept = Marcher(1 << 20, trained.march, FIELD.box_high)(
        rays, np.full(len(rays), 0.5, np.float32), leaps
    )
    assert len(kept) == len(rays)
    with torch.no_grad():
        plain = render_rays(trained.scene, torch.from_numpy(rays), samples)[0]
    difference = (plain.reshape(first[0].shape) - first[0]).abs()
    assert difference.mean() < 1e-4
    assert difference.max() < 2e-2  # a ray that grazes a cell's edge may gain or lose a sample to rounding


def test_hand_written_gradients_agree_with_automatic_differentiation() -> None:
    scene, rng = SceneField(dataclasses.replace(FIELD, direction_bands=3), seed=1), np.random.default_rng(3)
    with torch.no_grad():
        for parameter in scene.parameters():
            parameter.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(4))
    directions = rng.normal(size=(300, 3))
    directions *= 0.5 / np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.concatenate([rng.uniform(0.1, 0.4, (300, 3)), directions], axis=1).astype(np.float32)
    leaps = leap_distances(rng.random((32, 32, 17)) > 0.5, np.array([32, 32, 17]) / FIELD.box_high)
    samples, kept = Marcher(1 << 16, MARCH, FIELD.box_high)(rays, rng.random(300, dtype=np.float32), leaps)
    assert len(kept) == 300
    targets = rng.integers(0, 256, (300, 3)).astype(np.uint8)

    step = CpuStep(scene, huber=0.1)
    packed, encoded = step.visible(samples, least_weight=0.0)
    result = step.gradients(rays, targets, packed, encoded)
    colours = render_rays(scene, torch.from_numpy(rays), packed)[0]
    loss = torch.nn.functional.huber_loss(colours, torch.from_numpy(targets) / 255.0, delta=0.1)
    loss.backward()
    assert result.loss == pytest.approx(loss.item(), rel=1e-5)
    for name, parameter in scene.named_parameters():
        assert parameter.grad is not None
        scale = parameter.grad.abs().max().item()
        np.testing.assert_allclose(step.grads[name], parameter.grad, atol=2e-5 * scale, err_msg=name)


def test_an_interrupted_training_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    short = dataclasses.replace(TRAIN, steps=40)
    images, path = room_images(6), tmp_path / "checkpoint.safetensors"
    whole = Trainer(images, FIELD, short)
    whole.run()
    half = Trainer(images, FIELD, short)
    for _ in range(23):  # not a multiple of the occupancy interval
        half.train_step()
    half.save(path)
    resumed = Trainer(images, FIELD, short)
    resumed.run(checkpoint=path)
    assert resumed.step == 40
    for name, value in whole.stepper.values.items():
        np.testing.assert_array_equal(resumed.stepper.values[name], value, err_msg=name)


def test_unusable_checkpoints_are_refused_with_the_way_out(tmp_path: Path) -> None:
    images, path = room_images(3), tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"half a file")
    with pytest.raises(CheckpointError, match="delete it"):
        Trainer(images, FIELD, TRAIN).run(checkpoint=path)
    Trainer(images, FIELD, TRAIN).save(path)
    with pytest.raises(CheckpointError, match="one of others"):
        Trainer(images, FIELD, dataclasses.replace(TRAIN, seed=1)).restore(path)


def test_a_checkpoint_of_cameras_with_other_intrinsics_is_refused(tmp_path: Path) -> None:
    images, path = room_images(3), tmp_path / "checkpoint.safetensors"
    Trainer(images, FIELD, TRAIN).save(path)
    corrected = tuple(dataclasses.replace(each, cx=each.cx + 4.0) for each in images.pinholes)
    with pytest.raises(CheckpointError, match="one of others"):
        Trainer(dataclasses.replace(images, pinholes=corrected), FIELD, TRAIN).restore(path)
    Trainer(images, FIELD, TRAIN).restore(path)


def test_time_limit_ends_a_training() -> None:
    trainer = Trainer(room_images(3), FIELD, dataclasses.replace(TRAIN, steps=10**6, max_seconds=0.3))
    trainer.run()
    assert trainer.elapsed_s < 60.0
    assert trainer.step < 10**6


def test_scene_files_survive_and_damage_is_reported(tmp_path: Path, trained: TrainedScene) -> None:
    path = tmp_path / "scene.safetensors"
    content = save_scene(path, trained.scene, trained.occupied, {"march": dataclasses.asdict(trained.march)})
    scene, occupied, metadata = load_scene(path)
    assert metadata["scene_hash"] == content
    np.testing.assert_array_equal(occupied, trained.occupied)
    pose = room_poses(1, seed=5)
    loaded = FieldRenderer.from_file(path).render(pose, CAMERA)[0]
    exact = FieldRenderer(trained.scene, trained.occupied, trained.march).render(pose, CAMERA)[0]
    rounded = copy.deepcopy(trained.scene)
    with torch.no_grad():
        rounded.grid.table.copy_(rounded.grid.table.half())
    assert torch.equal(
        loaded, FieldRenderer(rounded, trained.occupied, trained.march).render(pose, CAMERA)[0]
    )
    assert float((loaded - exact).abs().max()) < 0.5 / 255  # half precision is not seen
    with torch.no_grad():
        scene.background += 1.0
    assert save_scene(tmp_path / "other.safetensors", scene, occupied) != content
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(SceneFileError, match="train the scene again"):
        load_scene(path)


def test_rays_outside_the_box_see_nothing(trained: TrainedScene) -> None:
    away = look_at([5.0, 0.0, 0.0], [9.0, 0.0, 0.0])[None]
    _, depth_m, alpha = FieldRenderer(trained.scene, trained.occupied, trained.march).render(away, CAMERA)
    assert torch.isinf(depth_m).all()
    assert not alpha.any()
    start, end = span_in_box(np.array([2, 2, 2, 1, 0, 0], np.float32), FIELD.box_high, np.float32(0.0))
    assert start > end


def test_a_baked_scene_looks_like_its_field(tmp_path: Path, trained: TrainedScene) -> None:
    field = FieldRenderer(trained.scene, trained.occupied, trained.march)
    poses = room_poses(12, seed=5)
    baked, rough = (bake(field, room_poses(60, seed=8), CAMERA, part_px) for part_px in (0.7, 1e3))
    (fine_db, depth_m), (rough_db, _) = (compared(each, field, poses) for each in (baked, rough))
    assert fine_db > 30.0
    assert fine_db > rough_db  # with bricks it is finer
    assert depth_m < 0.01
    file = tmp_path / "baked.safetensors"
    baked.save(file)
    again = BakedScene.load(file)
    for ours, theirs in zip(baked.render(poses, CAMERA), again.render(poses, CAMERA), strict=True):
        assert torch.equal(ours, theirs)
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(SceneFileError, match="bake the scene again"):
        BakedScene.load(file)


def compared(baked: BakedScene, field: FieldRenderer, poses: Array) -> tuple[float, float]:
    """PSNR against the field's pictures, and the median difference of depth [m]."""
    (rgb, depth_m, _), (field_rgb, field_depth_m, _) = (each.render(poses, CAMERA) for each in (baked, field))
    return psnr(rgb.numpy(), field_rgb.numpy()), float((depth_m - field_depth_m).abs().nanmedian())


def test_baked_pictures_depend_neither_on_threads_nor_on_their_batch(trained: TrainedScene) -> None:
    field = FieldRenderer(trained.scene, trained.occupied, trained.march)
    poses = room_poses(3, seed=5)
    baked = bake(field, poses, CAMERA)
    together = baked.render(poses, CAMERA)[0]
    set_thread_count(1)
    try:
        again = bake(field, poses, CAMERA)
        alone = torch.cat([again.render(pose[None], CAMERA)[0] for pose in poses])
    finally:
        set_thread_count(0)
    assert torch.equal(together, alone)


def test_baked_values_are_those_of_the_field_at_the_corners(trained: TrainedScene) -> None:
    """Against the field's own arithmetic in torch; a byte is a step of 0.07 in the logarithm of density."""
    colours = ColourMap(((0.8, 0.1, 0.0), (0.0, 0.9, 0.05), (0.1, 0.0, 0.7)), (0.02, 0.0, 0.01), 1.3)
    field = FieldRenderer(trained.scene, trained.occupied, trained.march, colours)
    baked = bake(field, np.zeros((0, 4, 4)), CAMERA)
    shape = np.array(baked.leaps.distance.shape)
    cells = np.argwhere(baked.leaps.distance == 0)[::7]
    rows = np.ravel_multi_index(tuple(cells.T), tuple(shape + 1))
    points = torch.from_numpy((cells / baked.leaps.cells).astype(np.float32))
    with torch.no_grad():
        density, features = trained.scene.density_and_features(points)
        rgb = trained.scene.decode(features, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(points), 3))
    logs = LOWEST_LOG + LOG_STEP * baked.voxels.values[rows, 0].astype(float)
    wanted = np.log(density.numpy()).clip(LOWEST_LOG, MAX_LOG_DENSITY)
    np.testing.assert_allclose(logs, wanted, atol=0.51 * LOG_STEP)
    np.testing.assert_allclose(
        baked.voxels.values[rows, 1:] / 255.0, colours.apply(rgb.numpy()), atol=0.51 / 255
    )


@pytest.mark.parametrize("change", [{"direction_bands": 2}, {"learned_background": False}])
def test_what_cannot_be_baked_is_refused(change: dict[str, bool]) -> None:
    scene = SceneField(dataclasses.replace(FIELD, **change))
    field = FieldRenderer(scene, np.ones((8, 8, 4), np.bool_))
    with pytest.raises(NotBakedError, match=f"{next(iter(change))} = {next(iter(change.values()))}"):
        bake(field, room_poses(1, seed=0), CAMERA)
