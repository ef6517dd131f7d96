import json
import subprocess
import sys

import numpy as np
import pytest

from advnerf_core.data.lens import Lens
from advnerf_core.data.similarity import Similarity, align_poses, extent
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Pinhole, look_at, make_transform, rotation_x, rotation_z
from benchmarks.lab_recordings import lab_with_phone, photograph, record_drive, video_poses
from calibration.photo_model import Model, Registered, SfmConfig
from calibration.world_axes import extent_scale, on_ground
from hardware.worlds.lab.lab import Lab
from nodes.lab.importing.data_set import from_media
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import MediaConfig
from nodes.lab.importing.metric_options import MetricOptions


def walk(count=40):
    angles = np.linspace(0.0, 6.0, count)
    return np.stack([look_at([3.0 * np.cos(a), 3.0 * np.sin(a), 1.5], [0.0, 0.0, 1.0]) for a in angles])


def model_of(poses):
    images = [
        Registered(f"{k}", "phone", pose, Pinhole(4, 3, 3.0, 3.0, 2.0, 1.5), Lens())
        for k, pose in enumerate(poses)
    ]
    return Model(tuple(images), (), np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [9.0, 2.0, 3.0]]), 0.5, 1)


def test_a_walk_is_put_upright_centred_and_to_scale():
    tilted = Similarity(0.2, make_transform(rotation_x(1.0) @ rotation_z(0.4), [5.0, -3.0, 2.0]))
    model = model_of(tilted.poses(walk()))
    found = on_ground(model, None, extent_scale(model, 5.0))
    poses = found.poses(model.poses)
    assert extent(poses[:, :3, 3]) == pytest.approx(5.0)
    assert np.ptp(poses[:, 2, 3]) < 2e-3, "all at one height again"
    assert (poses[:, 2, 1] < -0.5).all(), "the cameras' y axes point down"
    np.testing.assert_allclose(found.points([2.0, 2.0, 3.0]), 0.0, atol=1e-9)


def run(*arguments):
    command = [sys.executable, "-m", "nodes.cli", "scene", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def test_an_error_is_one_line_and_exit_code_2(tmp_path):
    (tmp_path / "empty").mkdir()
    result = run("from-images", tmp_path / "empty", "-o", tmp_path / "out")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: expected photographs")


def test_pictures_of_a_person_are_never_touched(tmp_path):
    mine = tmp_path / "holiday" / "images" / "phone" / "000001.jpg"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b"precious")
    for media, message in ((mine.parent, "outside"), (tmp_path / "other", "has other files")):
        media.mkdir(exist_ok=True)
        with pytest.raises(ImportRecordingError, match=message):
            from_media(
                [media],
                tmp_path / "holiday",
                MediaConfig(),
                SfmConfig(),
                4.0,
                MetricOptions(),
                lambda share, text="": None,
            )
    assert mine.read_bytes() == b"precious"


@pytest.mark.slow
def test_photographs_of_the_lab_become_a_data_set(tmp_path):
    config = lab_with_phone(800)
    poses = video_poses(config, 120)[:18]
    with Lab(config) as lab:
        files = photograph(lab, poses, tmp_path / "phone")
    result = run("from-images", tmp_path / "phone", "-o", tmp_path / "set", "--extent", "3")
    assert (result.returncode, result.stderr) == (0, "")
    assert "18 of 18 images placed" in result.stdout
    listed = load_transforms(tmp_path / "set", require_all=True)
    assert [frame.path.name for frame in listed.frames] == [file.name for file in files]
    found = np.stack([frame.T_world_from_camera for frame in listed.frames])
    aligned = align_poses(found, np.stack(poses), 0.3, 0.1, 1.0)
    assert aligned.rms_position_m < 0.01 * aligned.extent_m
    assert np.rad2deg(aligned.rms_rotation_rad) < 0.6
    assert listed.frames[0].pinhole.fx == pytest.approx(config.phone.pinhole.fx, rel=0.02)
    low, high = listed.box()
    assert ((found[:, :3, 3] > low) & (found[:, :3, 3] < high)).all()
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert report["structure_from_motion"]["registered"] == 18
    # The same again reads what is there.
    assert run("from-images", tmp_path / "phone", "-o", tmp_path / "set", "--extent", "3").returncode == 0
    np.testing.assert_allclose(
        np.stack([f.T_world_from_camera for f in load_transforms(tmp_path / "set").frames]), found
    )
    length_m = float(np.linalg.norm(poses[0][:3, 3] - poses[-1][:3, 3]))
    known = (files[0].name, files[-1].name, str(length_m))
    assert run("from-images", tmp_path / "phone", "-o", tmp_path / "set", "--length", *known).returncode == 0
    found = np.stack([f.T_world_from_camera for f in load_transforms(tmp_path / "set").frames])
    aligned = align_poses(found, np.stack(poses), 0.3, 0.1, 1.0)
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.02)
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert report["scale_from"] == "length"
    assert report["ground_at_zero"], "the floor of the lab"
    np.testing.assert_allclose(found[:, 2, 3], np.stack(poses)[:, 2, 3], atol=0.05)


@pytest.mark.slow
def test_phone_and_car_come_out_metric_in_the_motion_capture_world(tmp_path):
    config = lab_with_phone(800)
    # A third of a lap, round the first corner: high and inwards, high and outwards, low and ahead.
    frames = [lap * 50 + k for lap in range(3) for k in range(16)]
    poses = [video_poses(config, 150)[k] for k in frames]
    with Lab(config) as lab:
        files = photograph(lab, poses, tmp_path / "phone")
        record_drive(lab, tmp_path / "drive", laps=0.3)
    result = run(
        "from-phone-and-car", tmp_path / "phone", "--bag", tmp_path / "drive", "-o", tmp_path / "set"
    )
    assert (result.returncode, result.stderr) == (0, "")
    truth = {file.name: pose for file, pose in zip(files, poses, strict=True)}
    phone = load_transforms(tmp_path / "set" / "transforms_phone.json", require_all=True)
    assert phone.camera_ids == ("phone",)
    assert len(phone.frames) >= 40
    # No alignment here: the poses themselves must be in the world of motion capture.
    off_m = [np.linalg.norm((f.T_world_from_camera - truth[f.path.name])[:3, 3]) for f in phone.frames]
    assert np.median(off_m) < 0.04
    assert load_transforms(tmp_path / "set").camera_ids == ("phone", "car")
    car = load_transforms(tmp_path / "set" / "transforms_car.json")
    assert car.frames[0].pinhole == config.camera.pinhole
    placing = json.loads((tmp_path / "set" / "import.json").read_text())["placing"]
    assert placing["inliers"] >= 0.8 * placing["cameras"]
    assert placing["rms_position_m"] < 0.05
