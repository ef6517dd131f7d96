import numpy as np

from advnerf_core.data.image_files import read_stored
from advnerf_core.geometry import planar_pose, wrap_angle
from benchmarks.lab_recordings import FRAME_PERIOD_S, START_NS, car_state, lab_with_phone, record_drive
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.bags.reader import read_info
from nodes.lab.importing.driven_bag import BagConfig, take_frames


def test_the_car_of_the_drive_goes_where_it_looks():
    config, step_s = LabConfig(), 1e-4
    for time_s in np.linspace(0.0, 17.0, 40):
        x, y, yaw = car_state(config, time_s)
        ahead = car_state(config, time_s + step_s)
        along = np.array([ahead[0] - x, ahead[1] - y]) / step_s
        # It weaves across the line, which stretches its way by the curvature a little; the heading is the way's tangent.
        assert abs(wrap_angle(np.arctan2(along[1], along[0]) - yaw)) < 0.05
        assert 0.6 < np.linalg.norm(along) < 1.0


def test_a_recorded_drive_has_frames_and_poses_at_their_stamps(tmp_path):
    with Lab(lab_with_phone(320)) as lab:
        bag = record_drive(lab, tmp_path / "drive", laps=0.05)
        rgb, _ = lab.observe_at(*car_state(lab.config, 3 * FRAME_PERIOD_S), depth=False)
    counts = {topic.name: topic.count for topic in read_info(bag).topics}
    assert counts["/vicon/car"] == 10 * counts["/camera/image_raw"]
    taken = take_frames(bag, tmp_path / "images", BagConfig(step_m=0.0), lambda share, text="": None)
    config = LabConfig()
    for file, T in zip(taken.files, taken.T_world_from_camera, strict=True):
        true = (
            planar_pose(*car_state(config, (int(file.stem) - START_NS) / 1e9))
            @ config.camera.T_car_from_camera
        )
        assert np.abs(T - true).max() < 0.004, "within the noise of the motion capture"
    assert (read_stored(taken.files[3])[0] == rgb).all(), (
        "frames are stored without loss, each at its own stamp"
    )
