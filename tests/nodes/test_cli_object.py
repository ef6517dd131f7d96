"""The commands `advnerf object ...` as a user types them."""

import json
import sys

import cv2
import numpy as np
import pytest

from advnerf_core.objects.build import mesh_views
from advnerf_core.objects.generators import hydrant
from advnerf_core.objects.model import load_object
from nodes import cli


@pytest.fixture
def command(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["advnerf", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return call


def test_build_show_and_info(command, tmp_path):
    path = tmp_path / "hydrant.object.safetensors"
    code, output, _ = command("object", "build", "--generate", "hydrant", "--resolution", 16, "--steps", 2, "-o", path)
    assert code == 0
    assert "on held-out views" in output
    assert load_object(path).about["source"] == {"generator": "hydrant"}
    assert command("object", "show", path, "-o", tmp_path / "h.png")[0] == 0
    sheet = cv2.imread(str(tmp_path / "h.png"))
    assert sheet.shape == (480, 960, 3)
    red = (sheet[..., 2] > 120) & (sheet[..., 1] < 80)
    assert 0.02 < red.mean() < 0.3
    code, output, _ = command("object", "info", path)
    assert code == 0
    assert "0.75" in output


def test_build_from_cut_out_pictures(command, tmp_path):
    views = mesh_views(hydrant(), 8, 48)
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for k, (image, pose) in enumerate(zip(views.images, views.T_object_from_camera, strict=True)):
        rgb = image[..., :3] / np.maximum(image[..., 3:], 1e-6)
        pixels = np.rint(255 * np.concatenate([rgb[..., ::-1], image[..., 3:]], axis=-1)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{k}.png"), pixels)
        frames.append({"file_path": f"{k}.png", "transform_matrix": (pose @ to_opengl).tolist()})
    lens = views.pinholes[0]
    (tmp_path / "transforms.json").write_text(
        json.dumps({"fl_x": lens.fx, "cx": lens.cx, "cy": lens.cy, "frames": frames})
    )
    path = tmp_path / "o.object.safetensors"
    code, _, errors = command(
        "object", "build", "--images", tmp_path / "transforms.json", "--resolution", 16, "--steps", 3, "-o", path
    )
    assert (code, errors) == (0, "")
    np.testing.assert_allclose(load_object(path).size_m, hydrant().size_m, atol=0.3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected one of FILE, --generate and --images"),
        (["--generate", "tree"], "expected --generate to be one of hydrant, car; got 'tree'"),
        (["{folder}/none.glb"], "found none"),
        (["--generate", "car", "--height", "-1"], "height above zero"),
    ],
)
def test_mistakes_are_one_line(command, tmp_path, arguments, message):
    code, _, errors = command("object", "build", *(a.format(folder=tmp_path) for a in arguments))
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1
