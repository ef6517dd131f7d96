"""`advnerf scene eval|render|view|match-colours` with sets of photographs of all kinds, in a scene that nobody trained."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.objects.voxel.mesh import SurfaceMesh, part_from_colours
from advnerf_core.objects.voxel.model import ObjectModel, save_object
from advnerf_core.objects.voxel.voxelise import voxelise
from advnerf_core.scene.render_field import FieldRenderer
from nodes.lab.scene_training import evaluate
from nodes.lab.scene_view import SceneView
from tests.support.commands import advnerf
from tests.support.opaque_scene import CAMERA, INSIDE, write_frames, write_scene

Command = Callable[..., tuple[object, str, str]]
TURNED = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about the vertical


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene.safetensors")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Exit code, output and errors of ``advnerf scene ...``."""

    def call(*words: object) -> tuple[object, str, str]:
        monkeypatch.setenv("COLUMNS", "200")
        code = advnerf(monkeypatch, "scene", *words)
        return code, *capsys.readouterr()

    return call


def stereo(scene: Path, file: Path) -> Path:
    names = [f"{side}/{k}.png" for k in range(len(INSIDE)) for side in ("left", "right")]
    right = [pose.copy() for pose in INSIDE]
    for pose in right:
        pose[:3, 3] += 0.02 * pose[:3, 0]
    poses = [pose for pair in zip(INSIDE, right, strict=True) for pose in pair]
    return write_frames(scene, file, poses, names=names)


@pytest.mark.parametrize("half", [1.0, 100.0])
def test_depth_that_no_picture_can_hold_is_told(command: Command, tmp_path: Path, half: float) -> None:
    """Depth pictures are in millimetres; those of a scene in millimetres were black, without a word."""
    scene = write_scene(tmp_path / "scene.safetensors", half=half)
    outside = [look_at([3.0 * half, 0.1 * half, 0.1 * half], [0.0, 0.0, 0.0])]
    write_frames(scene, tmp_path / "transforms.json", outside)
    code, said, _ = command("render", scene, tmp_path, "-o", tmp_path / "views")
    assert code == 0
    depth_mm = cv2.imread(str(tmp_path / "views" / "0000_0_depth_mm.png"), cv2.IMREAD_UNCHANGED)
    assert bool(depth_mm.any()) is (half == 1.0)
    assert ("100 % of the pixels of surfaces are 0 in the depth pictures" in said) is (half == 100.0)


def test_both_images_of_a_stereo_camera_are_shown(scene: Path, tmp_path: Path) -> None:
    view = SceneView(scene, stereo(scene, tmp_path / "transforms.json"), port=18090)
    try:
        assert len({frustum.name for frustum in view._frustums}) == 10
    finally:
        view.close()


@pytest.mark.slow
def test_files_of_a_training_name_both_images_of_a_stereo_camera(
    scene: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "learned"
    images = stereo(scene, tmp_path / "transforms.json")
    box = ("--box-low", -1, -1, -1, "--box-high", 1, 1, 1)
    assert command("train", images, "-o", out, "--steps", 2, "--exposure", "--near", 0.05, *box)[0] == 0
    gains, figures = (json.loads((out / name).read_text()) for name in ("exposure.json", "held_out.json"))
    held_out = {row["image"] for row in figures["images"]}
    # Sorted by the name alone, 0.png of either side comes first; every 8th is held out.
    assert held_out == {"left/0.png", "left/4.png"}
    assert {row["image"] for row in gains} | held_out == {
        f"{side}/{k}.png" for k in range(5) for side in ("left", "right")
    }


def test_a_black_picture_is_named_and_has_no_gain(scene: Path, tmp_path: Path, command: Command) -> None:
    file = write_frames(scene, tmp_path / "transforms.json", [*INSIDE, INSIDE[0] @ TURNED])
    cv2.imwrite(str(tmp_path / "0.png"), np.full((30, 40, 3), 3, np.uint8))
    code, output, _ = command("eval", scene, file, "--every", 3)
    assert code == 0
    assert "no gain can be fitted to black or empty pictures: 0.png; take them out" in output
    rows = {line.split()[0]: line for line in output.splitlines() if "dB" in line}
    assert rows["0.png"].split()[3] == "-"
    assert rows["mean"].split()[3] == rows["3.png"].split()[3], "of the other picture"
    listed = load_transforms(file).training_and_held_out(3)[1]
    figures = evaluate(FieldRenderer.from_file(scene), listed, listed.load())
    assert figures["images"][0]["gain_fitted_psnr_db"] is None
    json.dumps(figures, allow_nan=False)


@pytest.fixture
def mixed(scene: Path, tmp_path: Path) -> Path:
    """Photographs of two sizes, the second through a lens of its own."""
    cameras = [CAMERA, Pinhole(80, 40, 50.0, 50.0, 40.0, 20.0), CAMERA]
    return write_frames(scene, tmp_path / "transforms.json", INSIDE[:3], cameras=cameras)


def test_photographs_of_several_sizes_are_rendered_each_in_its_own(
    scene: Path, mixed: Path, tmp_path: Path, command: Command
) -> None:
    assert command("render", scene, mixed, "-o", tmp_path / "views")[0] == 0
    for k in range(3):
        ours, real = (cv2.imread(str(tmp_path / f)) for f in (f"views/{k:04d}_{k}.png", f"{k}.png"))
        assert ours.shape == real.shape
        assert np.abs(ours.astype(int) - real).max() <= 1
    film = ("render", scene, mixed, "-o", tmp_path / "film", "--video", tmp_path / "film.mp4")
    code, _, errors = command(*film)
    assert code == 2
    assert "cameras of one size for a video, got [(40, 30), (80, 40)]; give --size WIDTH HEIGHT" in errors
    assert not (tmp_path / "film").exists()
    assert command(*film, "--size", 40, 30)[0] == 0


def test_photographs_of_several_sizes_are_shown_each_in_its_own(scene: Path, mixed: Path) -> None:
    view = SceneView(scene, mixed, port=18092)
    try:
        assert [frustum.aspect for frustum in view._frustums] == pytest.approx([4 / 3, 2.0, 4 / 3])
    finally:
        view.close()


def test_cameras_outside_the_scene_are_named(scene: Path, tmp_path: Path, command: Command) -> None:
    poses = [pose.copy() for pose in INSIDE]
    poses[3][:3, 3] *= 1000.0  # in millimetres
    file = write_frames(scene, tmp_path / "transforms.json", poses)
    code, output, _ = command("render", scene, file, "-o", tmp_path / "views")
    assert code == 0
    assert (
        "1 of 5 cameras are outside the box of the scene, [-1.0, -1.0, -1.0] .. [1.0, 1.0, 1.0]: 3.png; if"
        in output
    )
    inside = write_frames(scene, tmp_path / "inside.json", INSIDE)
    assert "warning" not in command("render", scene, inside, "-o", tmp_path / "views")[1]


@pytest.mark.parametrize("full", [False, True])
def test_the_depth_that_is_sent_and_shown_has_the_objects_in_it(tmp_path: Path, full: bool) -> None:
    """Seen along y from 0.9 m, a box of 0.4 m is 0.7 m away and 0.4 / 0.7 of the focal length wide; or matter hides it."""
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    mesh = SurfaceMesh((part_from_colours(box.triangles, np.full((12, 3), 0.5)),))
    save_object(tmp_path / "box.object.safetensors", ObjectModel("box", voxelise(mesh, 32)))
    scene = write_scene(tmp_path / "scene.safetensors", full)
    pose, lens = look_at([0.0, -0.9, 0.0], [0.0, 0.0, 0.0]), Pinhole(70, 70, 70.0, 70.0, 35.0, 35.0)
    view, bare = (
        SceneView(scene, objects=objects, port=18094)
        for objects in ([tmp_path / "box.object.safetensors"], [])
    )
    try:
        depth_m, without_m = (each.picture(pose, lens)[1] for each in (view, bare))
        shown, plain = (each.picture(pose, lens, "depth")[0] for each in (view, bare))
    finally:
        view.close()
        bare.close()
    changed = depth_m != without_m
    assert (shown == plain).all() == full
    if full:
        assert not changed.any()
    else:
        assert depth_m[changed] == pytest.approx(0.7, abs=0.02)
        assert changed.sum() == pytest.approx(40**2, rel=0.1)
