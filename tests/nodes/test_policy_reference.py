import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx import TensorProto
from typer.testing import CliRunner

from advnerf_core.data.image_files import write_image
from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.driving.expert import Expert
from advnerf_core.driving.path import Arc
from advnerf_core.driving.path import Path as ReferencePath
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Pinhole, planar_pose
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.conformance import FAILURE, OK, WARNING, Finding
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.guess import guess_contract
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration, save_calibration
from nodes.bags.writer import BagWriter
from nodes.cli.main import app
from nodes.lab.policy_camera import same_camera
from nodes.lab.policy_reference import from_bag, from_run, from_scene, from_twin, judged_by_drives
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import encode, image_message, pose_message
from tests.support.onnx_models import mean_model, save_beside

ROOT = Path(__file__).parents[2]
TWIN = ROOT / "calibration" / "twin"
ROOM = TWIN / "room.yaml"
VIEW = PolicyView(load_calibration(CameraCalibration, TWIN / "camera.yaml").pinhole)
T0, MS = 1_800_000_000_000_000_000, 1_000_000


def write_bag(folder, poses, size=(188, 336)):
    """Poses at 50 Hz, an image of its own grey at every fifth, 7 ms after it."""
    with BagWriter(folder) as writer:
        for i, pose in enumerate(poses):
            t = T0 + i * 20 * MS
            writer.write("/vicon/car", encode(pose_message(planar_pose(*pose), t)), t, t, i)
            if i % 5 == 0:
                image = np.full((*size, 3), i, np.uint8)
                stamp = t + 7 * MS
                writer.write(
                    "/camera/image_raw", encode(image_message(image, stamp, "camera")), stamp, stamp, i // 5
                )
    return folder


def test_frames_of_a_bag_are_labelled_by_the_expert_at_their_own_stamps(tmp_path):
    expert = Expert(load_calibration(RoomCalibration, ROOM).reference_path)
    poses = expert.path.pose_at(0.02 * 0.8 * np.arange(200)) + np.array([0.0, 0.1, 0.05])
    reference = from_bag(write_bag(tmp_path / "bag", poses), ROOM, VIEW, count=20)
    numbers = reference.images[:, 0, 0, 0].astype(int)
    assert len(numbers) == 20
    assert numbers[0] == 0
    assert (np.diff(numbers) > 0).all()
    between = poses[numbers] + 7 / 20 * (poses[numbers + 1] - poses[numbers])
    np.testing.assert_allclose(reference.steering_rad, expert.steer_states(between), atol=1e-4)


def test_a_bag_that_is_of_no_use_is_one_error(tmp_path):
    with pytest.raises(BagError, match="varying steering"):
        from_bag(write_bag(tmp_path / "still", [(0.0, -2.0, 0.0)] * 60), ROOM, VIEW)
    moving = [(0.01 * i, -2.0 + 0.002 * i, 0.0) for i in range(60)]
    with pytest.raises(ConfigError, match=r"expected images of 336 x 188, .* got 60 x 40"):
        from_bag(write_bag(tmp_path / "small", moving, (40, 60)), ROOM, VIEW)


def about(path):
    """Car states round a path, turned from it to both sides."""
    states = path.pose_at(np.linspace(0.0, path.length_m, 12))
    states[:, 2] += 0.05 * (-1.0) ** np.arange(12)
    return states


def run_folder(folder, steer_path=None):
    """What the capture stage of an experiment leaves, in an empty learned scene; every frame has a ramp from top to bottom."""
    calibration = folder / "capture" / "calibration"
    calibration.mkdir(parents=True)
    for name in ("camera", "room", "vehicle"):
        shutil.copy(TWIN / f"{name}.yaml", calibration)
    camera = load_calibration(CameraCalibration, TWIN / "camera.yaml")
    room = load_calibration(RoomCalibration, TWIN / "room.yaml")
    if steer_path is not None:
        room = room.model_copy(update={"path": steer_path.to_dict()})
        save_calibration(room, calibration / "room.yaml")
    states = about(room.reference_path)
    ramp = np.repeat(np.arange(188, dtype=np.uint8)[:, None, None], 336, 1).repeat(3, 2)
    poses = [planar_pose(*state) @ camera.mount for state in states]
    write_posed_images(
        folder / "capture" / "held_out", poses, camera.pinhole, lambda i: ramp + np.uint8(i), "png"
    )
    grid = HashGridConfig(levels=2, features=2, log2_entries=8, coarsest=4, finest=8)
    scene = SceneField(SceneFieldConfig((-4.0, -4.0, 0.0), (4.0, 4.0, 2.5), grid=grid, hidden=16))
    (folder / "scene").mkdir()
    save_scene(folder / "scene" / "scene.safetensors", scene, np.zeros((4, 4, 4), bool), {})
    return folder


def test_a_run_folder_is_seen_through_the_policys_own_crop(tmp_path):
    folder = run_folder(tmp_path / "run")
    usual, high = from_run(folder, VIEW), from_run(folder, replace(VIEW, crop_top_px=0))
    assert usual.images.shape == high.images.shape == (12, 66, 200, 3)
    np.testing.assert_allclose(usual.images[0, 0, :, 0], 24, atol=1)
    np.testing.assert_allclose(high.images[0, 0, :, 0], 0, atol=1)
    narrow = from_run(folder, replace(VIEW, crop_left_px=100, crop_width_px=100, width=100))
    assert narrow.images.shape == (12, 66, 100, 3)
    room = load_calibration(RoomCalibration, ROOM)
    wanted = Expert(room.reference_path).steer_states(about(room.reference_path))
    np.testing.assert_allclose(usual.steering_rad, wanted, atol=1e-6)
    # A rounded declaration is of the same camera; 0.005 px move a picture by less than its noise.
    rounded = replace(VIEW.camera, fx=round(VIEW.camera.fx, 2), fy=round(VIEW.camera.fy, 2))
    assert rounded != VIEW.camera
    assert same_camera(rounded, VIEW.camera)
    with pytest.raises(ConfigError, match="expected the camera that the policy"):
        from_run(folder, replace(VIEW, camera=replace(VIEW.camera, fx=200.0)))
    with pytest.raises(ConfigError, match="expected the run folder of an experiment"):
        from_run(tmp_path / "nothing", VIEW)


class Circling(torch.nn.Module):
    """Steers by one angle whatever it sees, and a little by the light."""

    def __init__(self, steering_rad):
        super().__init__()
        self.steering_rad = steering_rad

    def forward(self, images):
        return self.steering_rad + 1e-3 * images.mean(dim=(1, 2, 3))


def circling(steering_rad, view=VIEW):
    return adapt(Circling(steering_rad).eval(), PolicyContract(view))


def test_a_policy_is_driven_round_the_path_in_the_scene(tmp_path):
    circle = ReferencePath.from_segments((0.0, -2.0, 0.0), [Arc(2.0, np.pi / 2)] * 4)
    reference = from_run(run_folder(tmp_path / "run", circle), VIEW)
    on_it = circling(float(np.arctan(0.25 / 2.0)))
    clean = reference.drives(on_it, ())
    assert len(clean.total_cte_m) == 4
    assert clean.ticks * 4 * 0.08 == pytest.approx(circle.length_m, abs=0.4)
    assert clean.drives, clean.lines
    straight = reference.drives(circling(0.0), ())
    assert not straight.drives
    assert all(straight.off_track)
    right = [Finding("mode", OK, ""), Finding("expert", WARNING, "far off")]
    assert judged_by_drives(on_it, reference, right)[-1].verdict == OK
    failed = judged_by_drives(circling(0.0), reference, right)[-1]
    assert (failed.name, failed.verdict) == ("drive", FAILURE)
    assert "does not drive here" in failed.text
    assert judged_by_drives(circling(0.0), replace(reference, asked=False), right)[-1].verdict == WARNING
    # Of what the check has found before, nothing is lost.
    found = judged_by_drives(circling(math.nan), reference, right)
    assert found[:-1] == right
    assert (found[-1].name, found[-1].verdict) == ("drive", FAILURE)
    assert "finite steering from the policy, got nan at tick 0" in found[-1].text
    bag = replace(reference, drives=None)
    assert [f.verdict for f in judged_by_drives(on_it, bag, right)] == [OK, FAILURE]
    wrong = [Finding("mode", FAILURE, "")]
    assert judged_by_drives(on_it, reference, wrong) == wrong


def test_a_scene_gives_views_of_the_policys_own_size_and_drives(tmp_path):
    folder = run_folder(
        tmp_path / "run", ReferencePath.from_segments((0.0, -2.0, 0.0), [Arc(2.0, np.pi / 2)] * 4)
    )
    calibration = folder / "capture" / "calibration"
    narrow = replace(VIEW, width=100)
    reference = from_scene(folder / "scene" / "scene.safetensors", calibration, narrow, count=6)
    assert reference.images.shape == (6, 66, 100, 3)
    assert np.ptp(reference.steering_rad) > 0.1
    assert reference.asked
    assert not reference.drives(circling(-0.1, narrow), ()).drives


def test_the_command_fails_for_a_policy_that_does_not_drive_where_it_was_asked_to(tmp_path, monkeypatch):
    circle = ReferencePath.from_segments((0.0, -2.0, 0.0), [Arc(2.0, np.pi / 2)] * 4)
    folder = run_folder(tmp_path / "run", circle)
    for name, steering_rad in (("good", 0.1244), ("bad", -0.1)):
        source = f"from test_policy_reference import circling\n\n\ndef factory():\n    return circling({steering_rad})\n"
        (tmp_path / f"circling_{name}.py").write_text(source)
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, code in (("bad", 1), ("good", 0)):
        done = CliRunner().invoke(
            app, ["policy", "check", f"circling_{name}:factory", "--folder", str(folder)]
        )
        assert done.exit_code == code, done.output
        assert ("NO DRIVE" in done.output) == (code == 1)


def test_a_file_without_a_declaration_is_given_one_to_correct_and_then_checked_on_a_picture(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "300")
    file = save_beside(mean_model([0.5, 0.25], columns=True, kind=TensorProto.UINT8), tmp_path / "mine.onnx")
    beside = tmp_path / "mine.onnx.policy.yaml"
    beside.unlink()
    asked = CliRunner().invoke(app, ["policy", "check", str(file)])
    assert asked.exit_code == 1
    before, _, declaration = asked.output.partition(":\n\n")
    assert "takes images [B, 3, 8, 12] uint8 and gives steering [B, 2] float32" in before
    for comment in (
        "# steering [B, 2] float32 has 2 columns: which one steers?",
        "# To which side",
        "# In which unit",
    ):
        assert comment in declaration
    assert "value_max: 255.0" in declaration, "eight bits leave one range"
    assert "layout" not in declaration, "what the file says and is the default"
    beside.write_text(declaration.replace("output_column: 0", "output_column: 1").replace('"rad"', '"deg"'))
    assert guess_contract(file)[1] == []
    picture = np.full((8, 12, 3), 100, np.uint8)
    picture[:4] = 200
    write_image(tmp_path / "seen.png", picture)
    checked = CliRunner().invoke(app, ["policy", "check", str(file), "--picture", str(tmp_path / "seen.png")])
    steering_rad = np.deg2rad(0.25 * 150)
    assert f"to the first image {steering_rad:+.3f} rad, 37.5 degrees to the left" in checked.output
    assert checked.exit_code == 0, checked.output


def test_the_twin_gives_left_and_right(monkeypatch):
    pytest.importorskip("mujoco")
    reference = from_twin(VIEW, count=8)
    assert reference.images.shape == (8, 66, 200, 3)
    assert reference.images.std() > 10
    assert reference.steering_rad.min() < 0.0 < reference.steering_rad.max()
    with pytest.raises(ConfigError, match="give frames of the policy's camera"):
        from_twin(PolicyView(Pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)), count=1)
