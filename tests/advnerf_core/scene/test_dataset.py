import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Pinhole, look_at

PINHOLE = Pinhole(64, 48, 50.0, 51.0, 31.0, 25.0)


def write_image(path: Path, width: int = 64, height: int = 48) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((height, width, 3), 40, np.uint8)
    image[:, : width // 2] = (10, 20, 230)  # blue, green, red
    cv2.imwrite(str(path), image)


def write_set(folder: Path, count: int = 3, **shared: float) -> Path:
    poses = np.stack([look_at([3.0, k, 1.0], [0.0, 0.0, 0.5]) for k in range(count)])
    for k in range(count):
        write_image(folder / "images" / f"{k}.png")
    path = folder / "transforms.json"
    write_transforms(path, [f"images/{k}.png" for k in range(count)], poses, PINHOLE, extra={"aabb_scale": 4})
    content = {**json.loads(path.read_text()), **shared}
    path.write_text(json.dumps(content))
    return path


def test_written_sets_read_back(tmp_path: Path) -> None:
    listed = load_transforms(write_set(tmp_path))
    loaded = listed.load()
    assert loaded.rgb.shape == (3, 48, 64, 3)
    assert loaded.rgb[0, 10, 5].tolist() == [230, 20, 10], "channels are red, green, blue"
    assert loaded.pinholes[0] == PINHOLE
    np.testing.assert_allclose(
        loaded.T_world_from_camera[1], look_at([3.0, 1.0, 1.0], [0.0, 0.0, 0.5]), atol=1e-9
    )
    assert listed.aabb_scale == 4
    np.testing.assert_allclose(listed.box()[1], 2.0 / 0.33)


def test_files_hold_opengl_axes(tmp_path: Path) -> None:
    content = json.loads(write_set(tmp_path).read_text())
    matrix = np.array(content["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(
        matrix @ OPENGL_FROM_OPENCV, look_at([3.0, 0.0, 1.0], [0.0, 0.0, 0.5]), atol=1e-9
    )
    assert matrix[2, 1] > 0.5, "the file's y axis points up"


def test_field_of_view_stands_in_for_missing_intrinsics(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png")
    frame = {"file_path": "./a", "transform_matrix": np.eye(4).tolist()}  # blender files leave the suffix out
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": [frame]}))
    pinhole = load_transforms(tmp_path).frames[0].pinhole
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (64, 48, 32.0, 24.0)
    assert pinhole.fx == pinhole.fy == pytest.approx(32.0)


def test_own_intrinsics_of_a_frame_win(tmp_path: Path) -> None:
    path = write_set(tmp_path)
    content = json.loads(path.read_text())
    content["frames"][1] |= {"fl_x": 77.0, "fl_y": 78.0}
    path.write_text(json.dumps(content))
    assert [f.pinhole.fx for f in load_transforms(path).frames] == [50.0, 77.0, 50.0]
    assert [f.pinhole.fy for f in load_transforms(path).frames] == [51.0, 78.0, 51.0]


def test_missing_images_are_reported_or_refused(tmp_path: Path) -> None:
    path = write_set(tmp_path)
    (tmp_path / "images" / "1.png").unlink()
    listed = load_transforms(path)
    assert [f.path.name for f in listed.frames] == ["0.png", "2.png"]
    assert [p.name for p in listed.missing] == ["1.png"]
    with pytest.raises(DatasetError, match=r"1 are missing, the first is .*1\.png"):
        load_transforms(path, require_all=True)
    for name in ("0.png", "2.png"):
        (tmp_path / "images" / name).unlink()
    with pytest.raises(DatasetError, match="3 are missing"):
        load_transforms(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected valid JSON"),
        ("[]", "expected a JSON object"),
        ("{}", "expected a list 'frames'"),
        ('{"frames": [{"file_path": "a.png"}]}', "frame 0"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    write_image(tmp_path / "a.png")
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DatasetError, match=message):
        load_transforms(tmp_path)
    with pytest.raises(DatasetError, match="nowhere"):
        load_transforms(tmp_path / "nowhere" / "transforms.json")


def test_damaged_image_is_named(tmp_path: Path) -> None:
    path = write_set(tmp_path)
    (tmp_path / "images" / "2.png").write_bytes(b"not a picture")
    with pytest.raises(DatasetError, match=r"2\.png"):
        load_transforms(path).load()


def test_undistortion_straightens_projected_lines(tmp_path: Path) -> None:
    k1, k2, p1, p2 = 0.2, -0.05, 0.004, -0.003
    path = write_set(tmp_path, count=1, k1=k1, k2=k2, p1=p1, p2=p2)
    # Paint a dot where the lens puts a known direction; after undistortion the ideal pinhole must put it in the same place.
    direction = np.array([0.35, -0.22, 1.0])
    x, y = direction[:2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = PINHOLE.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + PINHOLE.cx
    v = PINHOLE.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + PINHOLE.cy
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    dot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 8.0)
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.repeat((255 * dot)[..., None], 3, -1).astype(np.uint8))
    loaded = load_transforms(path).load()
    seen = loaded.rgb[0, ..., 0].astype(float)
    found = np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()
    np.testing.assert_allclose(found, loaded.pinholes[0].project(direction), atol=0.1)


def test_resizing_scales_intrinsics(tmp_path: Path) -> None:
    loaded = load_transforms(write_set(tmp_path)).load(size=(32, 24))
    assert loaded.rgb.shape == (3, 24, 32, 3)
    assert loaded.pinholes[0] == PINHOLE.resized(32, 24)


def test_split_holds_out_every_nth(tmp_path: Path) -> None:
    training, held_out = load_transforms(write_set(tmp_path, count=7)).sorted_by_name().split(3)
    assert [f.path.name for f in held_out.frames] == ["0.png", "3.png", "6.png"]
    assert len(training.frames) == 4
