"""The live twin end to end: bytes on the pty move the car that VICON packets and pictures show."""

import time

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import VehicleState, yaw_of
from hardware.emulators.live import LiveLab, LiveLabConfig, PoseHistory
from hardware.emulators.vicon_emulator import ViconEmulatorConfig
from hardware.errors import HardwareError
from hardware.mocap.vicon import SubjectTracker, ViconConfig, ViconReceiver
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.motor.vesc import Vesc
from hardware.worlds.lab.lab import Lab
from tests.support.faulty_devices import OCCLUSION_FORMS, FaultyLab, FaultyViconFrames
from tests.support.sockets import connected
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def receiver():
    with ViconReceiver(ViconConfig(subjects=("car", "board"), port=0)) as receiver:
        yield receiver


@pytest.fixture(scope="module")
def lab(receiver, tmp_path_factory):
    config = LiveLabConfig(vicon=ViconEmulatorConfig(port=receiver.port))
    with FaultyLab(config, tmp_path_factory.mktemp("run")) as lab:
        yield lab


def poses_of(receiver, name, duration_s):
    receiver.read(0.0)
    poses, deadline = [], time.monotonic() + duration_s
    while time.monotonic() < deadline or not poses:
        poses += [p for p in receiver.read(0.05) if p.name == name]
    return poses


def test_history_interpolates_over_the_cut_of_the_circle():
    history = PoseHistory(200.0)
    history.add(1_000, VehicleState(0.0, 0.0, 3.1))
    history.add(2_000, VehicleState(1.0, 2.0, -3.1))
    middle = history.at(1_500)
    assert (middle.x_m, middle.y_m) == (0.5, 1.0)
    assert abs(middle.yaw_rad) == pytest.approx(np.pi)
    assert history.at(5_000).x_m == 1.0
    assert history.at(500).x_m == 0.0
    history.clear()
    assert history.at(1_500) is None


@pytest.mark.parametrize("form", [None, *OCCLUSION_FORMS])
def test_every_form_of_occlusion_is_recognised(form):
    frames = FaultyViconFrames(ViconEmulatorConfig())
    tracker = SubjectTracker(ViconConfig(subjects=("car",)))
    seen = []
    for k in range(60):
        if k == 20:
            frames.occlude("car", form)
        for datagram in frames.next({"car": np.eye(4) + 0.0}):
            seen.append(len(tracker.update(datagram, 0, k * 10_000_000)))
    # Noise makes a standing car look alive; "frozen" needs five equal frames to be noticed.
    assert sum(seen[:20]) == 20
    assert sum(seen[30:]) == (30 if form is None else 0)


def test_vicon_rate_noise_and_truth(lab, receiver):
    # A machine that is held up leaves out poses for a moment, and never sends more.
    windows = [poses_of(receiver, "car", 0.5) for _ in range(4)]
    assert 4 <= max(map(len, windows)) <= 55
    poses = [pose for window in windows for pose in window]
    xyz = np.array([p.T_world_from_subject[:3, 3] for p in poses])
    assert np.abs(xyz.mean(axis=0) - [-1.1, -2.0, 0.0]).max() < 1e-3
    assert 2e-5 < xyz.std() < 1.0
    board = poses_of(receiver, "board", 0.1)[0]
    np.testing.assert_allclose(board.T_world_from_subject, lab.config.lab.board.T_world_from_face, atol=2e-3)


def test_frames_come_at_their_rate_with_true_stamps(lab):
    with connected(lab.frames_path) as camera:
        frames = [camera.read(timeout_s=60.0) for _ in range(6)]
        arrived_ns = time.time_ns()
    stamps = np.array([f.stamp_realtime_ns for f in frames])
    # A machine that is held up leaves out whole periods; the grid of stamps stays.
    periods = np.diff(stamps) / 100e6
    assert periods == pytest.approx(np.round(periods), abs=0.02)
    assert (np.round(periods) >= 1).all()
    assert 0 < arrived_ns - stamps[-1] < 300e6
    assert frames[0].rgb.shape == (188, 336, 3)
    assert all(f.simulated for f in frames)  # a car that stands sees one image
    with Lab(lab.config.lab) as still:
        expected, _ = still.observe_at(-1.1, -2.0, 0.0, depth=False)
    assert cv2.PSNR(frames[-1].rgb, expected) > 40.0


def test_driving_moves_what_is_measured_and_seen(lab, receiver):
    lab.place(-1.1, -2.0, 0.0)
    with (
        Vesc(str(lab.vesc_port), VehicleGains(), DriveLimits()) as vesc,
        connected(lab.frames_path) as camera,
    ):
        assert vesc.identify().hardware_name == "TWIN"
        before = camera.read(timeout_s=60.0)
        for _ in range(20):
            vesc.drive(0.8, 0.15)
            time.sleep(0.05)
        pose = poses_of(receiver, "car", 0.05)[-1].T_world_from_subject
        with pytest.raises(HardwareError, match="disarm first"):
            lab.place(0.0, 0.0, 0.0)
        vesc.brake(20.0)
        after = camera.read(timeout_s=60.0)
        wait_for(lambda: lab.state.speed_mps == 0.0, "standstill")
    lab.check()
    assert pose[0, 3] > -0.8
    assert yaw_of(pose) > 0.05
    assert (
        after.stamp_mono_ns - before.stamp_mono_ns > 0.9e9
    )  # a reader away for a second gets what is seen now
    assert cv2.PSNR(before.rgb, after.rgb) < 30.0

    def names():
        return [event.name for event in lab.vesc.events() if event.name != "GET_VALUES"]

    wait_for(lambda: names()[-1] == "SET_CURRENT", "the last bytes")
    assert "SET_CURRENT_BRAKE" in names()
    assert "TIMEOUT" not in names()
    lab.place(-1.1, -2.0, 0.0)
    assert poses_of(receiver, "car", 0.1)[-1].T_world_from_subject[0, 3] == pytest.approx(-1.1, abs=2e-3)


def test_an_impossible_start_pose_leaves_nothing_behind(tmp_path):
    with pytest.raises(ValueError, match="free place"):
        LiveLab(LiveLabConfig(start_pose=(3.9, 0.0, 0.0)), tmp_path)
    assert not (tmp_path / "frames").exists()
    assert not (tmp_path / "vesc").is_symlink()


@pytest.mark.parametrize("fault", ["silent", "repeated"])
def test_a_frozen_camera_gives_no_new_stamp(lab, fault):
    def newest_stamps(camera, duration_s, count=0):
        stamps, deadline = [], time.monotonic() + duration_s
        while time.monotonic() < deadline or len(set(stamps)) < count:
            if (frame := camera.read(0.05)) is not None:
                stamps.append(frame.stamp_realtime_ns)
        return stamps

    with connected(lab.frames_path) as camera:
        before = newest_stamps(camera, 0.4, 2)
        lab.freeze_camera(fault)
        newest_stamps(camera, 0.2)  # what was on its way
        frozen = newest_stamps(camera, 0.4)
        lab.freeze_camera(None)
        after = newest_stamps(camera, 0.4, 2)
    assert len(before) >= 2
    assert len(set(frozen)) == (1 if fault == "repeated" else 0)
    assert len(set(after)) >= 2
    with pytest.raises(ValueError, match=r"expected a fault of silent, repeated, got 'dusty'"):
        lab.freeze_camera("dusty")


def test_a_latency_is_shorter_than_the_cameras_period():
    with pytest.raises(ValueError, match=r"expected camera_latency_s below 0.1 s, .* got 0.1 s"):
        LiveLabConfig(camera_latency_s=0.1)


def test_its_camera_may_have_the_flaws_of_a_real_one(tmp_path):
    config = LiveLabConfig(camera_effects={"read_noise": 0.02, "lost": 0.3}, camera_latency_s=0.09)
    frames, ages_s = [], []
    with LiveLab(config, tmp_path) as lab, connected(lab.frames_path) as camera:
        for _ in range(12):
            frames.append(camera.read(60.0))
            ages_s.append(time.time() - frames[-1].stamp_realtime_ns / 1e9)
    assert min(ages_s) >= 0.089  # the clock of day may be slewed a little
    # The car stands: one frame differs from the next by noise alone.
    light = np.stack([frame.rgb for frame in frames]).astype(np.float64)
    assert 1.0 < (light[1:] - light[:-1]).std() / np.sqrt(2.0) < 12.0
    assert max(np.diff([frame.sequence for frame in frames])) > 1  # numbers of lost frames are missing
