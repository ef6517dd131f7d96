"""What `advnerf scene train` decides for its user: contraction, alpha, presets; and an end-to-end training of pictures with alpha."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import load_scene, save_scene
from advnerf_core.scene.intervals import INTERVAL_PX_FROM_OUTSIDE
from advnerf_core.scene.presets import PRESETS
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, train_scene
from nodes.lab import scene_training
from nodes.lab.scene_training import depth_in_mm, sample_intervals, scene_field
from nodes.lab.training_request import TrainingRequest
from nodes.runtime.errors import ConfigError
from tests.support.commands import advnerf

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA = Pinhole(40, 40, 50.0, 50.0, 20.0, 20.0)
RADIUS = 0.5


def ball(T: Array) -> NDArray[np.uint8]:
    """An opaque striped ball, blue first, with alpha; 3 x 3 rays a pixel."""
    wide = Pinhole(120, 120, 150.0, 150.0, 60.0, 60.0)
    o, d = T[:3, 3], wide.directions() @ T[:3, :3].T
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ o
    under = b * b - o @ o + RADIUS**2
    hit = o + (-b - np.sqrt(np.maximum(under, 0.0)))[..., None] * d
    colour = (0.5 + 0.4 * np.sin(6.0 * hit)) * (under > 0.0)[..., None]
    sums = (
        np.concatenate([colour, (under > 0.0)[..., None]], axis=-1).reshape(40, 3, 40, 3, 4).mean(axis=(1, 3))
    )
    sums[..., :3] /= np.maximum(sums[..., 3:], 1e-9)
    return np.rint(255 * sums).astype(np.uint8)


def write_set(folder: Path, count: int, **extra: object) -> Path:
    """Pictures of the ball from all around, and their ``transforms.json``."""
    eyes = np.random.default_rng(0).normal(size=(count, 3))
    eyes *= 1.45 / np.abs(eyes).max(axis=1, keepdims=True)
    frames = []
    for k, eye in enumerate(eyes):
        T = look_at(eye, [0.0, 0.0, 0.0])
        cv2.imwrite(str(folder / f"{k:02d}.png"), ball(T))
        frames.append({"file_path": f"{k:02d}.png", "transform_matrix": (T @ TO_OPENGL).tolist()})
    content = {"fl_x": 50.0, "frames": frames, **extra}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("ball"), 48)


def request_for(folder: Path, **changes: object) -> TrainingRequest:
    return dataclasses.replace(TrainingRequest(folder, folder / "learned"), **changes)  # type: ignore[arg-type]


def test_a_box_larger_than_the_unit_cube_means_unbounded_unless_told_otherwise(tmp_path: Path) -> None:
    listed = load_transforms(write_set(tmp_path, 4, aabb_scale=4))
    field = scene_field(request_for(tmp_path), listed)
    assert field.contraction
    # The unit cube is 1 / 0.33 wide and holds the cameras, which stand at 1.45.
    np.testing.assert_allclose(field.box_high_m, 0.5 / 0.33)
    assert field.grid.finest == 2 * 2048
    bounded = scene_field(request_for(tmp_path, unbounded=False), listed)
    assert not bounded.contraction
    np.testing.assert_allclose(bounded.box_high_m, 4 * 0.5 / 0.33)
    assert not scene_field(request_for(tmp_path), dataclasses.replace(listed, aabb_scale=1.0)).contraction
    # Cameras outside the unit cube make the inner region larger.
    far = [
        dataclasses.replace(f, T_world_from_camera=look_at([5.0, 0.0, 1.0], [0.0, 0.0, 0.0]))
        for f in listed.frames
    ]
    np.testing.assert_allclose(scene_field(request_for(tmp_path), listed.with_frames(far)).box_high_m, 5.0)


def test_a_held_out_image_that_cannot_be_compared_is_said_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_set(tmp_path, 9)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][8]["mask_path"] = "mask.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    cv2.imwrite(str(folder / "mask.png"), np.full((20, 20), 255, np.uint8))
    monkeypatch.setattr(scene_training, "train_scene", lambda *_: pytest.fail("it was trained"))
    with pytest.raises(
        DatasetError, match=r"expected a mask of 40 x 40, the size of .*08\.png, got .*mask\.png of 20 x 20"
    ):
        scene_training.train(request_for(folder), lambda *_: None)


def test_unbounded_needs_no_box(tmp_path: Path) -> None:
    listed = load_transforms(write_set(tmp_path, 4, scale=1.0))
    with pytest.raises(ConfigError, match="or leave out --bounded"):
        scene_field(request_for(tmp_path, unbounded=False), listed)
    places = np.stack([frame.T_world_from_camera[:3, 3] for frame in listed.frames])
    around = scene_field(request_for(tmp_path), listed)
    assert around.contraction
    assert (places > around.box_low_m).all()
    assert (places < around.box_high_m).all()
    field = scene_field(request_for(tmp_path, unbounded=True), listed)
    np.testing.assert_allclose(field.box_high_m, 0.5 + 1.45 - 0.5)
    own = ((-2.0, -2.0, -1.0), (2.0, 2.0, 1.0))
    given = scene_field(request_for(tmp_path, unbounded=True, box_low=own[0], box_high=own[1]), listed)
    assert (given.box_low_m, given.box_high_m) == own


@pytest.mark.parametrize(
    ("preset", "aabb_scale", "sizes"),
    [
        ("room", 1, (8, 4, 17, 16, 2048, 1)),
        ("instant-ngp", 1, (16, 2, 19, 16, 2048, 4)),
        ("instant-ngp", 2, (16, 2, 19, 16, 4096, 4)),
        ("minutes", 1, (8, 4, 18, 16, 2048, 3)),
        ("best", 2, (8, 4, 18, 16, 4096, 3)),
    ],
)
def test_presets_have_their_sizes_train_and_render(
    pictures: Path, preset: str, aabb_scale: int, sizes: tuple[int, ...]
) -> None:
    listed = dataclasses.replace(load_transforms(pictures), aabb_scale=float(aabb_scale))
    images = listed.with_frames(listed.frames[:3]).load()
    field = scene_field(request_for(pictures, preset=preset), listed, images)
    grid = field.grid
    got = (grid.levels, grid.features, grid.log2_entries, grid.coarsest, grid.finest, field.direction_bands)
    assert got == sizes
    march = MarchConfig(
        near_m=0.3, smallest_step_m=0.02, largest_step_m=0.1, step_growth=0.03, max_samples=200
    )
    config = TrainConfig(steps=3, samples_per_step=2048, max_rays=256, occupancy_resolution=8, march=march)
    trained = train_scene(images, field, config)
    rgb, depth_m, alpha = FieldRenderer(trained.scene, trained.occupied, trained.march).render(
        images.T_world_from_camera[:1], CAMERA
    )
    assert rgb.shape == (1, 40, 40, 3)
    assert torch.isfinite(rgb).all()
    assert 0.0 < alpha.mean() <= 1.0
    assert (depth_m > 0.0).all()


@pytest.mark.slow
def test_photographs_of_changing_exposure_are_learned_with_gains(tmp_path: Path) -> None:
    folder = write_set(tmp_path, 24)
    for k, file in enumerate(sorted(folder.glob("*.png"))):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        image[..., :3] = np.rint(image[..., :3] * (0.6 if k % 2 else 1.0))
        cv2.imwrite(str(file), image)
    box = ((-0.8,) * 3, (0.8,) * 3)
    figures = scene_training.train(
        request_for(folder, exposure=True, steps=150, box_low=box[0], box_high=box[1]),
        lambda part, text="": None,
    )
    rows = json.loads((folder / "learned" / scene_training.EXPOSURE).read_text())
    gains = {row["image"]: np.mean(row["gain"]) for row in rows}
    # So few steps find most of the difference.
    dark, bright = ([g for name, g in gains.items() if int(name[:2]) % 2 == odd] for odd in (1, 0))
    assert np.mean(dark) / np.mean(bright) == pytest.approx(0.6, abs=0.15)
    # The held-out pictures are bright ones, which the mean exposure is not.
    assert figures["mean"]["gain_fitted_psnr_db"] > figures["mean"]["psnr_db"] + 1.0


def test_an_unknown_preset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="room, instant-ngp, minutes, best, got 'huge'"):
        request_for(tmp_path, preset="huge")


def test_presets_with_a_time_end_by_it_unless_the_user_says_when(tmp_path: Path) -> None:
    assert request_for(tmp_path, preset="room", steps=None, minutes=None).length == (1000, None)
    assert request_for(tmp_path, preset="minutes", steps=None, minutes=None).length == (None, 3.0)
    assert request_for(tmp_path, preset="best", steps=None, minutes=None).length == (None, 10.0)
    assert request_for(tmp_path, preset="best", steps=50, minutes=None).length == (50, None)
    assert request_for(tmp_path, preset="minutes", steps=None, minutes=7.0).length == (None, 7.0)


@pytest.mark.parametrize(
    ("changes", "opacity"),
    [({}, TrainConfig.opacity), ({"open_scene": True}, 0.0), ({"unbounded": True}, 0.0)],
)
def test_a_preset_sets_how_to_train(pictures: Path, changes: dict[str, bool], opacity: float) -> None:
    request = request_for(pictures, preset="best", steps=None, minutes=2.0, seed=3, **changes)
    field = scene_field(request, dataclasses.replace(load_transforms(pictures), aabb_scale=1.0))
    config = scene_training._train_config(request, field, MarchConfig())
    expected = PRESETS["best"].training
    assert (config.max_seconds, config.seed, config.opacity) == (120.0, 3, opacity)
    assert (config.distortion, config.refine_depth) == (expected.distortion, expected.refine_depth)


def test_alpha_that_is_opaque_everywhere_is_none(pictures: Path) -> None:
    images = load_transforms(pictures).load()
    assert images.transparent
    assert images.alpha is not None
    opaque = dataclasses.replace(images, alpha=np.full_like(images.alpha, 255))
    assert not opaque.transparent


def test_help_says_what_presets_are_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert advnerf(monkeypatch, "scene", "train", "--help") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--unbounded" in text
    assert "instant-ngp" in text
    assert "2^19" in text


@pytest.mark.slow
def test_pictures_with_alpha_are_learned_with_it_end_to_end(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "learned"
    for arguments in (
        [
            "train",
            pictures,
            "-o",
            out,
            "--steps",
            "200",
            "--box-low",
            *["-0.8"] * 3,
            "--box-high",
            *["0.8"] * 3,
        ],
        ["render", out / "scene.safetensors", pictures, "--held-out", "-o", tmp_path / "views"],
    ):
        assert advnerf(monkeypatch, "scene", *arguments) == 0
    assert "images have alpha" in capsys.readouterr().out
    figures = json.loads((out / "held_out.json").read_text())
    assert figures["mean"]["psnr_db"] > 26.0
    for k, row in enumerate(figures["images"]):
        real = cv2.imread(str(pictures / row["image"]), cv2.IMREAD_UNCHANGED) / 255.0
        ours = cv2.imread(str(tmp_path / "views" / f"{k:04d}_{row['image']}"), cv2.IMREAD_UNCHANGED) / 255.0
        assert ours.shape == (40, 40, 4)
        assert np.abs(ours[..., 3] - real[..., 3]).mean() < 0.03
        inside = real[..., 3] == 1.0
        assert np.abs(ours[inside, :3] - real[inside, :3]).mean() < 0.06


def test_intervals_follow_the_images_unless_the_user_says_otherwise(pictures: Path) -> None:
    listed = load_transforms(pictures)
    images = listed.with_frames(listed.frames[:2]).load()

    def chosen(**changes: object) -> MarchConfig:
        request = request_for(pictures, box_low=(-0.8,) * 3, box_high=(0.8,) * 3, **changes)
        return sample_intervals(request, scene_field(request, listed, images), images)

    rule = chosen()
    assert rule == MarchConfig(1.6 * (1 / 80), 1.6 / 1024, 1.6 / 64, INTERVAL_PX_FROM_OUTSIDE / 50.0, 1024)
    assert chosen(interval_px=0.5 * INTERVAL_PX_FROM_OUTSIDE) == dataclasses.replace(
        rule, step_growth=0.5 * rule.step_growth
    )
    assert chosen(near=0.3) == dataclasses.replace(rule, near_m=0.3)


@pytest.mark.slow
def test_options_of_intervals_reach_training_and_renderer(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*arguments: object) -> str:
        assert advnerf(monkeypatch, "scene", *arguments) == 0
        return capsys.readouterr().out

    # A thin box has few cells: after one step all of them are occupied, and each is looked into.
    box = ("--box-low", -0.8, -0.1, -0.1, "--box-high", 0.8, 0.1, 0.1)
    text = run("train", pictures, "-o", tmp_path, "--steps", 1, "--size", 16, 16, *box, "--interval-px", 8)
    growth = 8 / (50.0 * 16 / 40)  # the lens of the resized pictures
    assert f"{growth:.3g} of the distance between" in text
    scene = tmp_path / "scene.safetensors"
    assert FieldRenderer.from_file(scene).march.step_growth == pytest.approx(growth)
    # After one step nothing is dense enough to be kept; haze shows intervals as well as walls do.
    field, occupied, metadata = load_scene(scene)
    save_scene(scene, field, np.ones_like(occupied), metadata)
    small = (scene, pictures, "--size", 16, 16)
    assert (
        run("eval", *small)
        == run("eval", *small, "--interval-scale", 1)
        != run("eval", *small, "--interval-scale", 20)
    )
    run("render", *small, "--held-out", "-o", tmp_path / "fine")
    run("render", *small, "--held-out", "-o", tmp_path / "coarse", "--interval-scale", 20)
    fine, coarse = ((tmp_path / name / "0000_00.png").read_bytes() for name in ("fine", "coarse"))
    assert fine != coarse


def test_impossible_intervals_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--interval-px above 0"):
        request_for(tmp_path, interval_px=0.0)


def test_a_depth_that_a_file_cannot_hold_is_unknown_and_not_another_depth() -> None:
    depth_m = np.array([[0.0, 1.2344, 65.535], [65.536, 90.0, np.inf]], np.float32)
    assert depth_in_mm(depth_m).tolist() == [[0, 1234, 65535], [0, 0, 0]]
