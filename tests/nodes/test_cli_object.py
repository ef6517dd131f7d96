"""The commands `advnerf scene object ...` as a user types them."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from advnerf_core.objects.voxel.build import mesh_views
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.model import load_object
from tests.support.commands import advnerf


@pytest.fixture
def command(monkeypatch, capsys):
    def call(*arguments):
        return advnerf(monkeypatch, *arguments), *capsys.readouterr()

    return call


def test_build_and_show(command, tmp_path):
    path = tmp_path / "hydrant.object.safetensors"
    code, output, _ = command(
        "scene", "object", "build", "--generate", "hydrant", "--resolution", 16, "--steps", 2, "-o", path
    )
    assert code == 0
    assert "on held-out views" in output
    size_m = hydrant().size_m
    assert load_object(path).about["source"] == {
        "generator": "hydrant",
        "size_m": pytest.approx(size_m, abs=1e-6),
    }
    code, output, _ = command("scene", "object", "show", path, "-o", tmp_path / "h.png")
    assert code == 0
    assert " x ".join(f"{side:.3f}" for side in size_m) + " m " in output
    assert output.endswith(f"{tmp_path / 'h.png'}\n")
    sheet = cv2.imread(str(tmp_path / "h.png"))
    assert sheet.shape == (480, 960, 3)
    red = (sheet[..., 2] > 120) & (sheet[..., 1] < 80)
    assert 0.02 < red.mean() < 0.3


def test_a_mesh_has_its_own_size_and_not_that_of_its_voxels(command, tmp_path):
    trimesh.creation.box((200, 100, 400)).export(tmp_path / "box.stl")
    build = ("scene", "object", "build", tmp_path / "box.stl", "--unit", "mm", "--steps", 2)
    code, output, _ = command(*build, "--resolution", 8, "-o", tmp_path / "a.object.safetensors")
    assert code == 0
    assert "0.20 x 0.10 x 0.40 m, " in output
    assert "warning: its shortest side is 1.0 voxels: it looks wider than it is" in output
    assert command(*build, "--resolution", 32, "-o", tmp_path / "b.object.safetensors")[1].count("wider") == 0


def write_pictures(folder, count, pixels=48, file="transforms.json", phase=0.0, spoilt=False):
    """Cut-out pictures of the hydrant; spoilt ones show it green."""
    views = mesh_views(hydrant(), count, pixels, phase)
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for k, (image, pose) in enumerate(zip(views.images, views.T_object_from_camera, strict=True)):
        rgb = image[..., :3] / np.maximum(image[..., 3:], 1e-6)
        if spoilt:
            rgb = rgb[..., [1, 0, 2]]
        values = np.rint(255 * np.concatenate([rgb[..., ::-1], image[..., 3:]], axis=-1)).astype(np.uint8)
        name = f"{file[:-5]}_{k}.png"
        cv2.imwrite(str(folder / name), values)
        frames.append({"file_path": name, "transform_matrix": (pose @ to_opengl).tolist()})
    lens = views.pinholes[0]
    (folder / file).write_text(json.dumps({"fl_x": lens.fx, "cx": lens.cx, "cy": lens.cy, "frames": frames}))
    return folder


def test_build_from_cut_out_pictures(command, tmp_path):
    path = tmp_path / "o.object.safetensors"
    transforms = write_pictures(tmp_path, 8) / "transforms.json"
    code, output, errors = command(
        "scene", "object", "build", "--images", transforms, "--resolution", 16, "--steps", 3, "-o", path
    )
    assert (code, errors) == (0, "")
    assert "8 training, 0 held-out images" in output
    assert "dB on training views" in output
    assert "held-out views" not in output
    assert "warning: " in output  # three steps are no fit
    np.testing.assert_allclose(load_object(path).size_m, hydrant().size_m, atol=0.3)


def test_a_data_sets_own_split_is_followed(command, tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    write_pictures(folder, 10, file="transforms_train.json")
    write_pictures(folder, 2, file="transforms_val.json", phase=0.3, spoilt=True)
    write_pictures(folder, 14, file="transforms_test.json", phase=0.6, spoilt=True)
    path = tmp_path / "o.object.safetensors"
    arguments = (
        "scene",
        "object",
        "build",
        "--images",
        folder,
        "--resolution",
        16,
        "--steps",
        40,
        "-o",
        path,
    )
    code, output, errors = command(*arguments)
    assert (code, errors) == (0, "")
    assert "10 training, 16 held-out images (split of the data set)" in output
    model = load_object(path)
    assert model.name == "set"
    assert model.about["pictures"] == 10
    # Had the green pictures been learned from, the object would be less red, and they would agree better.
    assert model.about["train_psnr_db"] > model.about["held_out_psnr_db"] + 3.0
    assert "held-out pictures agree worse" in output


def test_sixteen_pictures_hold_out_two_and_can_be_made_smaller(command, tmp_path):
    path = tmp_path / "o.object.safetensors"
    write_pictures(tmp_path, 16, pixels=64)
    code, output, errors = command(
        "scene",
        "object",
        "build",
        "--images",
        tmp_path,
        "--resolution",
        16,
        "--minutes",
        0.01,
        "--size",
        32,
        32,
        "-o",
        path,
    )
    assert (code, errors) == (0, "")
    assert "14 training, 2 held-out images" in output
    assert load_object(path).about["steps"] < 600
    assert "held_out_psnr_db" in load_object(path).about


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected exactly one of FILE, --generate and --images"),
        (["--generate", "tree"], "expected --generate to be one of hydrant, car; got 'tree'"),
        (["--generate", "car", "--height", "-1"], "height above zero"),
        (["--generate", "car", "--minutes", "1"], "--minutes only with --images"),
        (["--generate", "car", "--unit", "mm"], "expected --unit only with FILE, got it with --generate"),
        (["--generate", "car", "--up", "y"], "expected --up only with FILE"),
        (["--images", "{folder}", "--height", "2"], "expected --height only with FILE or --generate"),
        (["--generate", "car", "--coarse-to-fine"], "--coarse-to-fine only with --images"),
        (["--images", "{folder}", "--minutes", "1", "--steps", "5"], "either --steps or --minutes"),
    ],
)
def test_mistakes_are_one_line(command, tmp_path, arguments, message):
    code, _, errors = command("scene", "object", "build", *(a.format(folder=tmp_path) for a in arguments))
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1
