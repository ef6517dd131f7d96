"""`advnerf scene train|eval|render|view` as a user types them, on a small set of pictures of a car."""

import json
import shutil
import subprocess
import sys
import urllib.request

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.geometry import Pinhole
from advnerf_core.objects.voxel.build import mesh_views
from advnerf_core.objects.voxel.generators import hydrant, small_car
from advnerf_core.scene.render_field import FieldRenderer
from nodes.lab.scene_view import SceneView
from tests.support.commands import advnerf
from tests.support.waiting import wait_for

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
BOX = ("--box-low", "-2.2", "-2.2", "-0.4", "--box-high", "2.2", "2.2", "2.0")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    views = mesh_views(small_car(), 24, 64)
    frames = []
    for k, (image, pose) in enumerate(zip(views.images, views.T_object_from_camera, strict=True)):
        white = image[..., :3] + 1.0 - image[..., 3:]
        cv2.imwrite(str(folder / f"{k:02d}.png"), np.rint(255 * white[..., ::-1]).astype(np.uint8))
        frames.append({"file_path": f"{k:02d}.png", "transform_matrix": (pose @ TO_OPENGL).tolist()})
    lens = views.pinholes[0]
    content = {"fl_x": lens.fx, "cx": lens.cx, "cy": lens.cy, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def command(monkeypatch, capsys):
    def call(*arguments):
        return advnerf(monkeypatch, "scene", *arguments), *capsys.readouterr()

    return call


def train(pictures, folder, steps):
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "scene",
        "train",
        str(pictures),
        "-o",
        str(folder),
        "--steps",
        str(steps),
    ]
    done = subprocess.run([*command, *BOX, "--open", "--near", "1"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.fixture(scope="module")
def trained(pictures, tmp_path_factory):
    """A scene of few steps: the commands matter here, not what was learned."""
    return train(pictures, tmp_path_factory.mktemp("scene"), 12)


@pytest.mark.slow
def test_figures_are_of_the_held_out_images(trained):
    figures = json.loads((trained / "held_out.json").read_text())
    assert [row["image"] for row in figures["images"]] == ["00.png", "08.png", "16.png"]
    assert figures["mean"]["psnr_db"] == pytest.approx(np.mean([row["psnr_db"] for row in figures["images"]]))


@pytest.mark.slow
def test_training_learns_what_it_did_not_see(pictures, tmp_path):
    figures = json.loads((train(pictures, tmp_path, 400) / "held_out.json").read_text())
    assert figures["mean"]["psnr_db"] > 24.0
    assert 0.9 < figures["mean"]["ssim"] <= 1.0


@pytest.mark.slow
def test_a_finished_training_is_not_repeated_and_other_settings_are_refused(command, trained, pictures):
    before = (trained / "scene.safetensors").read_bytes()
    arguments = ("train", pictures, "-o", trained, *BOX, "--open", "--near", "1")
    assert command(*arguments, "--steps", "12")[0] == 0
    assert (trained / "scene.safetensors").read_bytes()[-1000:] == before[-1000:]
    code, _, errors = command(*arguments, "--steps", "130")
    assert code == 2
    assert "delete it to train anew" in errors


@pytest.mark.slow
def test_a_killed_training_goes_on_and_ends_the_same(trained, pictures, tmp_path):
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "scene",
        "train",
        str(pictures),
        "-o",
        str(tmp_path),
        "--steps",
        "12",
    ]
    command += [*BOX, "--open", "--near", "1", "--checkpoint-every", "0"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    wait_for((tmp_path / "checkpoint.safetensors").exists, "a checkpoint", 300.0)
    process.kill()
    process.wait()
    assert not (tmp_path / "scene.safetensors").exists()
    assert subprocess.run(command, stdout=subprocess.DEVNULL).returncode == 0
    ours, theirs = (json.loads((f / "held_out.json").read_text())["mean"] for f in (tmp_path, trained))
    assert ours == theirs


@pytest.mark.slow
def test_eval_and_render(command, trained, pictures, tmp_path):
    code, output, _ = command("eval", trained / "scene.safetensors", pictures)
    assert code == 0
    assert "08.png" in output
    code, output, _ = command(
        "render",
        trained / "scene.safetensors",
        pictures,
        "--held-out",
        "-o",
        tmp_path,
        "--video",
        tmp_path / "v.mp4",
    )
    assert code == 0
    figures = json.loads((trained / "held_out.json").read_text())["images"]
    written, real = (cv2.imread(str(path)) for path in (tmp_path / "0001_08.png", pictures / "08.png"))
    assert cv2.PSNR(written, real) == pytest.approx(figures[1]["psnr_db"], abs=0.1)
    depth_mm = cv2.imread(str(tmp_path / "0001_08_depth_mm.png"), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == np.uint16
    video = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert sum(video.read()[0] for _ in range(4)) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "5", "--bounded"], "has no aabb_scale"),
        (["--steps", "5", "--minutes", "1", *BOX], "either --steps or --minutes"),
        (["--steps", "5", *BOX[:4]], "both --box-low and --box-high"),
        (["--steps", "5", *BOX[:5], "-5", "-5", "-5"], "low < high"),
    ],
)
def test_mistakes_are_one_line(command, pictures, tmp_path, arguments, message):
    code, _, errors = command("train", pictures, "-o", tmp_path, *arguments)
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1
    assert not (tmp_path / "scene.safetensors").exists()


def test_masks_decide_what_is_learned_from(pictures, tmp_path):
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.errors import AdvnerfError
    from advnerf_core.scene.field import SceneFieldConfig
    from advnerf_core.scene.train import TrainConfig, Trainer

    images = load_transforms(pictures).load()
    valid = np.zeros(images.rgb.shape[:3], dtype=bool)
    box = SceneFieldConfig((-2.2, -2.2, -0.4), (2.2, 2.2, 2.0))
    with pytest.raises(AdvnerfError, match="masks leave none"):
        Trainer(type(images)(images.rgb, images.pinholes, images.T_world_from_camera, None, valid), box)
    valid[:, :32] = True
    spoilt = images.rgb.copy()
    spoilt[:, 32:] = 0
    results = []
    for rgb in (images.rgb, spoilt):
        masked = type(images)(rgb, images.pinholes, images.T_world_from_camera, None, valid)
        with torch.no_grad():
            trainer = Trainer(masked, box, TrainConfig(steps=4))
            results.append([trainer.train_step().loss for _ in range(4)])
    assert results[0] == results[1]


@pytest.fixture
def view(trained, pictures, tmp_path):
    from advnerf_core.objects.voxel.build import build_from_mesh
    from advnerf_core.objects.voxel.model import save_object

    save_object(tmp_path / "h.object.safetensors", build_from_mesh(hydrant().scaled(4.0), "hydrant", 16, 0))
    shown = SceneView(
        trained / "scene.safetensors", pictures, [tmp_path / "h.object.safetensors"], port=18080
    )
    yield shown
    shown.close()


@pytest.mark.slow
def test_the_viewer_serves_a_page_and_draws_objects_into_the_scene(view, trained, pictures):
    with urllib.request.urlopen(f"http://127.0.0.1:{view.port}") as page:
        assert b"<html" in page.read().lower()
    views = mesh_views(small_car(), 24, 64)
    pose, lens = views.T_object_from_camera[3], Pinhole(48, 48, 60.0, 60.0, 24.0, 24.0)
    picture, depth = view.picture(pose, lens)
    bare = FieldRenderer.from_file(trained / "scene.safetensors").render(pose[None], lens)[0][0].numpy()
    changed = np.abs(picture / 255.0 - bare).max(axis=-1) > 0.1
    assert 0.01 < changed.mean() < 0.6  # the hydrant, and only that
    assert not changed[:, :4].any()
    assert depth.shape == (48, 48)
    assert view.picture(pose, lens, "depth")[0].shape == (48, 48, 3)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_gets_pictures(view, tmp_path):
    url, shot = f"http://127.0.0.1:{view.port}", tmp_path / "shot.png"
    flags = [
        "--headless",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--window-size=800,600",
    ]
    subprocess.run(
        ["chromium", *flags, "--virtual-time-budget=12000", f"--screenshot={shot}", url],
        check=True,
        timeout=600,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    assert view.rendered >= 2  # a small one while it moved, a full one when it rested
    assert cv2.imread(str(shot)).std() > 10.0
