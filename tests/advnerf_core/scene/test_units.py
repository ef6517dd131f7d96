"""The same pictures give the same scene in any unit of length, and a training that learns nothing says so."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Pinhole
from advnerf_core.scene.bake import NotBakedError, bake
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.learning_check import LearningCheck, held_out_problem, one_colour_db
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainingReport, train_scene

LENS = Pinhole(24, 18, 16.0, 16.0, 12.0, 9.0)
SIDE = 2.0


def room(unit, count=12):
    """A cube of 4 m around the origin, whose walls have the colour of their place, from inside; lengths in ``unit`` per metre."""
    rng = np.random.default_rng(0)
    poses, images = [], []
    v, u = np.mgrid[: LENS.height, : LENS.width] + 0.5
    rays = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones_like(u)], -1)
    for _ in range(count):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose = np.eye(4)
        pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
        place = rng.uniform(-0.8, 0.8, 3)
        directions = rays @ pose[:3, :3].T
        reach = ((np.sign(directions) * SIDE - place) / directions).min(axis=-1, keepdims=True)
        images.append(np.rint(255 * ((place + reach * directions) / (2 * SIDE) + 0.5)).astype(np.uint8))
        pose[:3, 3] = unit * place
        poses.append(pose)
    return ImageSet(np.stack(images), (LENS,) * count, np.stack(poses))


def learned(unit, count=12, inverse=False, **changes):
    images, side = room(unit, count), 1.05 * SIDE * unit
    if inverse:
        images = dataclasses.replace(images, T_world_from_camera=np.linalg.inv(images.T_world_from_camera))
    grid = HashGridConfig(levels=4, features=4, log2_entries=13, finest=64)
    field = SceneFieldConfig((-side,) * 3, (side,) * 3, grid)
    config = TrainConfig(
        steps=120,
        samples_per_step=1 << 13,
        max_rays=512,
        occupancy_resolution=32,
        warmup_steps=30,
        backend="numba",
    )
    told, check = [], LearningCheck(images)
    config = dataclasses.replace(config, **changes)
    trained = train_scene(images, field, config, progress=lambda at: told.append(check(at)))
    renderer = FieldRenderer(trained.scene, trained.occupied, trained.march)
    rgb, depth, _ = renderer.render(images.T_world_from_camera[:4], LENS)
    return rgb.numpy(), depth.numpy() / unit, [text for text in told if text], renderer


def test_the_same_pictures_give_the_same_scene_in_any_unit():
    metres = learned(1.0)
    truth = room(1.0).rgb[:4] / 255.0
    error = np.abs(metres[0] - truth).mean()
    assert error < 0.06
    for unit in (0.005, 1000.0):
        rgb, depth, told, renderer = learned(unit)
        assert np.abs(rgb - truth).mean() < error + 0.02
        assert np.abs(rgb - metres[0]).mean() < 0.05
        assert np.median(np.abs(depth / metres[1] - 1.0)) < 0.1
        assert told == []
        with pytest.raises(NotBakedError, match="a longest side of"):
            bake(renderer, room(unit).T_world_from_camera, LENS)
    assert metres[2] == []


def test_the_nearest_place_is_a_share_of_the_box():
    images = room(1.0)
    for unit in (0.005, 1.0, 1000.0):
        field = SceneFieldConfig((-SIDE * unit,) * 3, (SIDE * unit,) * 3)
        march = pixel_intervals(images.pinholes, unit * images.T_world_from_camera, field)
        assert march.near_m == pytest.approx(0.05 * unit)
        with pytest.raises(ValueError, match=r"near below .*unit of the cameras"):
            pixel_intervals(images.pinholes, images.T_world_from_camera, field, near_m=4.0 * unit)


def test_a_training_that_learns_nothing_says_so_once():
    _, _, told, _ = learned(1.0, near_m=4.0)  # nothing is nearer than the walls
    assert len(told) == 1
    assert "steps nothing is learned" in told[0]


def test_poses_from_world_to_camera_are_told_by_what_was_held_out():
    held_out = room(1.0, 104)
    for inverse in (False, True):
        _, _, told, renderer = learned(1.0, 100, inverse, steps=200)
        assert told == [], "pictures are learned one by one"
        poses = held_out.T_world_from_camera[100:]
        poses = np.linalg.inv(poses) if inverse else poses
        shown = renderer.render(poses, LENS)[0].numpy().reshape(held_out.rgb[100:].shape)
        psnr_db = -10.0 * np.log10(((shown - held_out.rgb[100:] / 255.0) ** 2).mean())
        problem = held_out_problem(psnr_db, held_out)
        assert (problem is not None) is inverse, psnr_db
    assert f"{psnr_db:.1f} dB, one colour for all gives {one_colour_db(held_out.rgb):.1f} dB" in problem
    assert "from camera to world and not the inverse" in problem


def test_what_one_colour_reaches_follows_from_the_spread_of_colours():
    rgb = np.zeros((1, 10, 10, 3), np.uint8)
    rgb[:, :5] = 255
    images = ImageSet(rgb, (LENS,), np.eye(4)[None])
    assert one_colour_db(images.rgb) == pytest.approx(-10 * np.log10(0.25))
    check = LearningCheck(images)
    at = TrainingReport(100, 0.5, 6.5, 1.0)
    assert check(dataclasses.replace(at, step=50)) is None
    assert "6.5 dB on training rays, one colour for all gives 6.0 dB" in check(at)
    assert check(at) is None, "told once"
    assert LearningCheck(images)(dataclasses.replace(at, psnr_db=9.0)) is None


def test_an_alpha_channel_that_is_opaque_everywhere_switches_no_check_off():
    rgb = np.zeros((1, 10, 10, 3), np.uint8)
    rgb[:, :5] = 255
    alpha = np.full((1, 10, 10), 255, np.uint8)
    at = TrainingReport(100, 0.5, 6.5, 1.0)
    opaque = ImageSet(rgb, (LENS,), np.eye(4)[None], alpha)
    assert LearningCheck(opaque)(at) is not None
    assert held_out_problem(6.5, opaque) is not None
    alpha[0, 0, 0] = 254
    cut_out = dataclasses.replace(opaque, alpha=alpha)
    assert LearningCheck(cut_out)(at) is None
    assert held_out_problem(6.5, cut_out) is None


def test_a_psnr_of_pictures_in_the_dark_says_nothing():
    rgb = np.zeros((1, 10, 10, 3), np.uint8)
    rgb[:, :5] = 2
    images = ImageSet(rgb, (LENS,), np.eye(4)[None])
    plain_db = -20 * np.log10(1 / 255)  # each pixel is one level off their mean
    problem = held_out_problem(43.8, images)
    assert f"43.8 dB, one colour for all gives {plain_db:.1f} dB: they are nearly of one colour" in problem
    assert held_out_problem(plain_db + 4.0, images) is None


@pytest.mark.parametrize(
    ("offset", "spread", "good"),
    [(0.0, 1.0, True), (5e3, 1.0, True), (5e3, 0.005, False), (5e6, 1000.0, True), (6e5, 1.0, False)],
)
def test_a_far_origin_is_measured_by_the_spread_of_the_cameras(tmp_path, offset, spread, good):
    frames = []
    for k in range(8):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((4, 4, 3), np.uint8))
        pose = np.eye(4)
        pose[:3, 3] = [offset + spread * k, 0, 0]
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 4.0, "frames": frames}))
    if good:
        load_transforms(tmp_path)
        frames[3]["transform_matrix"][0][3] += 1e6 * spread  # one image that lies elsewhere
        (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 4.0, "frames": frames}))
        with pytest.raises(DatasetError, match=r"frame 3\.png: .* times the spread of the cameras"):
            load_transforms(tmp_path)
    else:
        with pytest.raises(DatasetError, match="times the spread of the cameras"):
            load_transforms(tmp_path)
