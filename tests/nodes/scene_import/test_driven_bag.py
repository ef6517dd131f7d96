import json

import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import camera_mount, planar_pose
from calibration.degeneracy import DegenerateDataError
from hardware.worlds.lab.config import LabConfig
from nodes.cli import main as cli
from nodes.lab.importing.driven_bag import BagConfig, choose_by_motion, take_frames
from nodes.lab.importing.errors import ImportRecordingError

from .conftest import START_NS, state_at

EVERY_FRAME = BagConfig(step_m=0.0, step_rad=0.0)


def quiet(share, text=""):
    pass


def test_frames_get_the_pose_at_their_stamp_times_the_mount(tmp_path, write_bag):
    taken = take_frames(write_bag(), tmp_path / "images", BagConfig(step_m=0.0), quiet)
    camera = LabConfig().camera
    mount = camera_mount(camera.x_m, camera.y_m, camera.z_m, camera.pitch_down_rad)
    assert len(taken.files) == taken.recorded == 30
    for pose, file in zip(taken.T_world_from_camera, taken.files, strict=True):
        stamp = int(file.stem)
        true = planar_pose(*state_at((stamp - START_NS) / 1e9)) @ mount
        # Between two poses 10 ms apart on a circle the chord is 2 micrometres inside.
        np.testing.assert_allclose(pose, true, atol=5e-6)


def test_a_data_set_of_a_bag_reads_back_with_frames_poses_and_camera(tmp_path, write_bag):
    bag, output = write_bag(), tmp_path / "set"
    arguments = ["scene", "from-bag", str(bag), "-o", str(output), "--step", "0.2", "--margin", "2"]
    result = CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "of 30 frames used, 0 had no motion-capture pose" in result.output
    listed = load_transforms(output)
    positions = np.stack([f.T_world_from_camera[:3, 3] for f in listed.frames])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert len(listed.frames) >= 6
    assert (steps > 0.1).all()
    assert listed.camera_ids == ("car",)
    assert listed.frames[0].pinhole == LabConfig().camera.pinhole
    loaded = listed.load()
    numbers = [(int(f.path.stem) - START_NS) // 100_000_000 for f in listed.frames]
    assert [int(image[0, 0, 0]) for image in loaded.rgb] == numbers, "each pose has its own frame"
    low, high = listed.box()
    assert (low <= positions.min(axis=0) - 1.99).all()
    assert (high >= positions.max(axis=0) + 1.99).all()
    told = json.loads((output / "import.json").read_text())
    assert told["taken_frames"] == len(listed.frames)
    assert told["ground_at_zero"], "an audit there need not ask for the camera's height"


def test_frames_in_a_gap_of_the_motion_capture_are_left_out_and_counted(tmp_path, write_bag):
    # Poses at 0.993 and 1.503 s bound the gap; the frames at 1.0 to 1.5 s lie in it.
    taken = take_frames(write_bag(gap=[(1.0, 1.5)]), tmp_path / "images", EVERY_FRAME, quiet)
    assert (taken.recorded, taken.without_pose) == (30, 6)
    assert not any(1.0e9 <= int(file.stem) - START_NS <= 1.5e9 for file in taken.files)


def test_a_second_run_leaves_finished_files_and_removes_strangers(tmp_path, write_bag):
    bag = write_bag()
    first = take_frames(bag, tmp_path / "images", EVERY_FRAME, quiet)
    stamps = [file.stat().st_mtime_ns for file in first.files]
    again = take_frames(bag, tmp_path / "images", EVERY_FRAME, quiet)
    assert [file.stat().st_mtime_ns for file in again.files] == stamps
    few = take_frames(bag, tmp_path / "images", BagConfig(step_m=0.3), quiet)
    assert sorted((tmp_path / "images").iterdir()) == sorted(few.files)
    assert len(few.files) < len(first.files)


@pytest.mark.parametrize(
    ("bag", "message"),
    [
        ({"calibrated": False}, r"expected the camera's calibration: .*give its file with --calibration"),
        ({"size": (100, 50)}, r"expected frames of 336 x 188, as calibrated, got 100 x 50"),
        ({"state": lambda t: (1000.0 * t, 0.0, 0.0)}, r"within 1000 m, got .* are they in mm\?"),
        (
            {"state": lambda t: (1.0, 2.0, 0.3)},
            r"from several places, got 30 within 0.02 m of one: the car stood",
        ),
        ({"gap": [(-1.0, 10.0)]}, r"has no topic /vicon/car|frames without any pose"),
    ],
)
def test_what_a_bag_lacks_is_one_error(tmp_path, write_bag, bag, message):
    with pytest.raises(Exception, match=message) as caught:
        take_frames(write_bag(**bag), tmp_path / "images", BagConfig(step_m=0.02), quiet)
    assert isinstance(caught.value, (ImportRecordingError, DegenerateDataError)) or "has no topic" in str(
        caught.value
    )


def test_choice_by_motion_counts_turning_too():
    poses = np.stack([planar_pose(0.0, 0.0, 0.01 * k) for k in range(101)])
    assert choose_by_motion(poses, BagConfig(step_m=0.1, step_rad=0.0995)) == list(range(0, 101, 10))
    assert len(choose_by_motion(poses, BagConfig(step_m=0.1, step_rad=0.0995, most=4))) == 4
