"""The room commands on real bags and on a real bus, as a person types them."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.attack.artifact import face_texture, save_attack
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from calibration.placement import face_frame
from calibration.room import target_of_size
from calibration.schema import RoomCalibration, TargetCalibration, load_calibration, save_calibration
from nodes.bags.writer import BagWriter
from nodes.lab.room.placing import write_measured_request
from nodes.runtime.bus import Bus
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import encode, pose_message
from tests.support.commands import advnerf as command
from tests.support.faces import face_attack

ROOT = Path(__file__).parents[2]
START_NS = 1_700_000_000_000_000_000
SQUARE = DrivingPath.rounded_square(4.0, 1.1)


def advnerf(*arguments, timeout=600):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "nodes.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=ROOT, env=environment)


def write_trace(folder, topic, poses):
    writer = BagWriter(folder)
    for k, (x, y, yaw) in enumerate(poses):
        at_ns = START_NS + k * 10_000_000
        writer.write(topic, encode(pose_message(planar_pose(x, y, yaw), at_ns)), at_ns, at_ns, k + 1)
    writer.close()
    return folder


@pytest.mark.slow
def test_path_and_fence_make_a_room_file_that_the_stack_reads(tmp_path):
    rng = np.random.default_rng(0)
    poses = SQUARE.pose_at(np.arange(0.0, 1.05 * SQUARE.length_m, 0.02))
    poses[:, :2] += rng.normal(0.0, 0.002, (len(poses), 2))
    bag = write_trace(tmp_path / "lap", "/vicon/car", poses)
    done = advnerf(
        "scene", "room", "path", bag, "-o", tmp_path / "room.yaml", "--corner", "1", "--before", "1.5"
    )
    assert done.returncode == 0, done.stderr
    assert "closed" in done.stdout
    assert "mm rms" in done.stdout
    room = load_calibration(RoomCalibration, tmp_path / "room.yaml")
    grid = room.reference_path.pose_at(np.linspace(0.0, room.reference_path.length_m, 200))[:, :2]
    assert np.abs(SQUARE.project(grid).cte_m).max() < 0.01
    assert (tmp_path / "room.png").stat().st_size > 5000
    corners = np.array([[-3.8, -3.8], [3.8, -3.8], [3.8, 3.8], [-3.8, 3.8]])
    walk = np.concatenate(
        [np.linspace(a, b, 200) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    wand = write_trace(tmp_path / "walk", "/vicon/wand", np.column_stack([walk, np.zeros(len(walk))]))
    done = advnerf("scene", "room", "fence", wand, "-o", tmp_path / "room.yaml")
    assert done.returncode == 0, done.stderr
    fenced = load_calibration(RoomCalibration, tmp_path / "room.yaml")
    assert np.abs(np.array(fenced.fence_m)).max() == pytest.approx(3.5, abs=0.03)
    assert fenced.path == room.path
    small = write_trace(tmp_path / "small", "/vicon/wand", np.column_stack([0.4 * walk, np.zeros(len(walk))]))
    done = advnerf("scene", "room", "fence", small, "-o", tmp_path / "room.yaml")
    assert done.returncode == 2
    assert "outside. Walk around the whole path" in done.stderr
    assert load_calibration(RoomCalibration, tmp_path / "room.yaml") == fenced


def test_options_go_before_an_existing_room_file_and_what_is_not_given_is_kept(tmp_path, monkeypatch):
    poses = SQUARE.pose_at(np.arange(0.0, 1.05 * SQUARE.length_m, 0.02))
    bag, file = write_trace(tmp_path / "lap", "/vicon/car", poses), tmp_path / "room.yaml"

    def made(*options):
        assert (
            command(monkeypatch, "scene", "room", "path", bag, "-o", file, "--before", "1.5", *options) == 0
        )
        room = load_calibration(RoomCalibration, file)
        return room.off_track_m, float(np.abs(np.array(room.fence_m)).max())

    assert made() == (0.4, pytest.approx(2.8, abs=0.05))
    assert made("--off-track", "0.15") == (0.15, pytest.approx(2.8, abs=0.05))
    assert made("--fence-margin", "1.5") == (0.15, pytest.approx(3.5, abs=0.05))
    assert made() == (0.15, pytest.approx(3.5, abs=0.05))


FACE = target_of_size("board", (1.0, 1.0), (0.0, 0.0, 0.0), 0.0, "ruler")
T_FACE = make_transform(rotation_z(np.deg2rad(188.0)), [3.04, -1.80, 0.52])
REQUEST = {
    "name": "corner",
    "objects": [
        {
            "name": "board",
            "kind": "panel",
            "x_m": 3.04,
            "y_m": -1.8,
            "z_m": 0.02,
            "yaw_rad": 3.28,
            "face": {"size_m": 1.0, "target": "board.yaml"},
        }
    ],
}


def save_attack_at(folder, T):
    theta = np.zeros((4, 4, 3), np.float32)
    attack = face_attack(
        method="random",
        theta=theta,
        texture=face_texture(theta, 8),
        size_m=(1.0, 1.0),
        T_world_from_object=T,
        subject="board",
        corners_in_subject=FACE.corners,
    )
    save_attack(folder / "a.safetensors", attack)
    return folder / "a.safetensors"


class Board:
    """Publishes the pose of a board on the bus of a run, as the VICON node would."""

    def __init__(self, run_dir, T_world_from_face):
        run_dir.mkdir()
        self._T = T_world_from_face @ np.linalg.inv(face_frame(FACE.corners))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(run_dir,))

    def _run(self, run_dir):
        with Bus(run_dir) as bus:
            bus.publisher("/vicon/board")
            while not self._stop.wait(0.01):
                bus.publish("/vicon/board", pose_message(self._T, time.time_ns()))

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *exception):
        self._stop.set()
        self._thread.join()


def test_the_guide_accepts_the_right_place_and_refuses_a_wrong_one(tmp_path):
    save_calibration(FACE, tmp_path / "board.yaml")
    (tmp_path / "corner.experiment.yaml").write_text(yaml.safe_dump(REQUEST))
    file = save_attack_at(tmp_path, T_FACE)
    with Board(tmp_path / "right", T_FACE @ make_transform(np.eye(3), [0.0, 0.005, 0.0])):
        done = advnerf(
            "scene",
            "room",
            "place",
            file,
            "--target",
            tmp_path / "board.yaml",
            "--folder",
            tmp_path / "right",
        )
    assert done.returncode == 0, done.stderr
    assert "0.5 cm and 0.0 deg" in done.stdout
    with Board(tmp_path / "wrong", T_FACE @ make_transform(rotation_z(0.1), [0.0, 0.06, 0.0])):
        done = advnerf(
            "scene",
            "room",
            "place",
            file,
            "--target",
            tmp_path / "board.yaml",
            "--folder",
            tmp_path / "wrong",
            "--once",
            "--request",
            tmp_path / "corner.experiment.yaml",
        )
    assert done.returncode == 1
    assert "6.0 cm and 5.7 deg" in done.stderr
    measured = tmp_path / "corner.measured.experiment.yaml"
    assert f"advnerf attack run {measured}" in done.stdout
    face = yaml.safe_load(measured.read_text())["objects"][0]
    assert face["yaw_rad"] == pytest.approx(np.deg2rad(188.0) - 2.0 * np.pi + 0.1, abs=1e-3)
    assert face["z_m"] == pytest.approx(0.02, abs=1e-3), "its lower edge"
    assert face["face"] == {"size_m": 1.0, "target": "board.yaml"}


def test_a_request_without_one_face_is_refused(tmp_path):
    file = tmp_path / "a.experiment.yaml"
    file.write_text(yaml.safe_dump({"objects": [{"kind": "cube"}]}))
    with pytest.raises(ConfigError, match="one object with the section face, got 0"):
        write_measured_request(file, {"x_m": 0.0})


def test_targets_by_ruler_and_bad_options(tmp_path):
    done = advnerf(
        "scene",
        "room",
        "target",
        "-o",
        tmp_path / "m.yaml",
        "--subject",
        "monitor",
        "--face-size",
        "0.598x0.336",
    )
    assert done.returncode == 0, done.stderr
    assert "size_m: 0.3360" in done.stdout
    target = load_calibration(TargetCalibration, tmp_path / "m.yaml")
    np.testing.assert_allclose(target.corners[0], [0.0, -0.299, 0.168])
    done = advnerf(
        "scene", "room", "target", "-o", tmp_path / "n.yaml", "--subject", "monitor", "--face-size", "27"
    )
    assert (done.returncode, "expected 2 finite numbers in metres" in done.stderr) == (2, True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--face-size", "0.6x0.3", "--tip", "0,0,-0.3"), "got --tip with the other"),
        (("{folder}", "--centre", "0,0,0.1", "--yaw", "90"), "got --centre and --yaw with the other"),
    ],
)
def test_a_ruler_needs_no_wand_and_a_wand_no_ruler(tmp_path, monkeypatch, capsys, words, message):
    """What belongs to the other way of measuring was not used, and nothing said so."""
    output = tmp_path / "board.yaml"
    given = [word.format(folder=tmp_path) for word in words]
    assert (
        command(monkeypatch, "scene", "room", "target", *given, "--subject", "board", "-o", str(output)) == 2
    )
    assert message in capsys.readouterr().err
    assert not output.exists()
