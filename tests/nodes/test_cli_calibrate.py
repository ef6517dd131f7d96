"""The commands on real bags and folders: a file with its picture, or one line that says what is wrong with the recording."""

import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import typer
import yaml
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import camera_mount, make_transform, planar_pose
from calibration.by_construction import twin_calibrations
from calibration.charuco import Board, BoardDetector
from calibration.degeneracy import DegenerateDataError
from calibration.display_colour import DisplayCalibration, colours_to_show
from calibration.measured import LensCalibration
from calibration.schema import (
    CalibrationError,
    CameraCalibration,
    VehicleCalibration,
    load_calibration,
    save_calibration,
)
from hardware.screen.display import PygameDisplay
from hardware.worlds.lab.config import LabConfig
from nodes.bags.reader import read_info
from nodes.bags.writer import BagWriter
from nodes.cli import main as cli
from nodes.cli.calibrate import app
from nodes.lab.wizards.bags import read_poses, read_shown, still_views
from nodes.lab.wizards.live import record_live
from nodes.lab.wizards.screen import show_and_watch
from nodes.runtime.bus import Bus
from nodes.runtime.errors import BagError
from nodes.runtime.messages import encode, header, image_message, pose_message, types
from tests.support.boards import BOARD
from tests.support.drives import CAR, drive, program
from tests.support.messages import filled
from tests.support.turning import far_wall, yaw_at

START_NS = 1_800_000_000_000_000_000
PINHOLE = LabConfig().camera.pinhole


def run(*arguments):
    """The command in this process, as `main` runs it; exit code."""
    before = sys.argv
    sys.argv = ["advnerf", *map(str, arguments)]
    try:
        cli.main()
    except SystemExit as end:
        return end.code or 0
    finally:
        sys.argv = before
    return 0


def ns(seconds):
    return START_NS + round(1e9 * seconds)


def write_poses(writer, topic, when, poses):
    for k, (t, T) in enumerate(zip(when, poses, strict=True)):
        writer.write(topic, encode(pose_message(T, ns(t))), ns(t), ns(t), k)


def drive_bag(folder, recorded, pose_of=lambda row: planar_pose(*row)):
    with BagWriter(folder) as writer:
        write_poses(writer, "/vicon/car", recorded.pose_s, [pose_of(row) for row in recorded.poses])
        write_sent(writer, recorded)
    return folder


def write_sent(writer, recorded):
    for k, t in enumerate(recorded.command_s):
        sent = filled(
            types.MotorSent,
            header=header(ns(t - recorded.pipeline_s[k]), "car"),
            serial_write_mono_ns=1,
            serial_write_real_ns=ns(t),
            erpm=float(recorded.erpm[k]),
            servo=float(recorded.servo[k]),
            peer="twin",
        )
        writer.write("/motor/sent", encode(sent), ns(t), ns(t), k)


def test_vehicle_from_a_bag(tmp_path, capsys):
    save_calibration(twin_calibrations(LabConfig())["vehicle"], tmp_path / "before.yaml")
    bag = drive_bag(tmp_path / "bag", drive(np.random.default_rng(0), program(hold_s=1.6, steps=8)))
    assert (
        run(
            "car",
            "calibrate",
            "vehicle",
            bag,
            "--before",
            tmp_path / "before.yaml",
            "-o",
            tmp_path / "new" / "vehicle.yaml",
        )
        == 0
    )
    found = load_calibration(VehicleCalibration, tmp_path / "new" / "vehicle.yaml")
    assert found.gains.servo_per_rad == pytest.approx(CAR.true_servo_gain, rel=0.01)
    assert found.response.pipeline_delay_s == pytest.approx(0.04, abs=1e-3)
    assert found.limits == load_calibration(VehicleCalibration, tmp_path / "before.yaml").limits
    assert cv2.imread(str(tmp_path / "new" / "vehicle.png")).shape[1] > 500
    said = capsys.readouterr().out
    assert "attack: {response: {delay_s:" in said
    assert "warning" not in said
    # The drive holds no camera: said in one line, and nothing is written.
    camera = tmp_path / "camera.yaml"
    save_calibration(twin_calibrations(LabConfig())["camera"], camera)
    assert run("car", "calibrate", "time-offset", bag, "--camera", camera, "-o", tmp_path / "no.yaml") == 2
    assert "expected images on /camera/image_raw or " in capsys.readouterr().err
    assert not (tmp_path / "no.yaml").exists()


def test_what_of_a_vehicle_is_far_from_the_file_of_the_drive_is_remarked(tmp_path, capsys):
    """Poses of half the size, limits beyond the servo, and a subject whose origin is 150 mm up were written without a word."""
    before = twin_calibrations(LabConfig())["vehicle"]
    wide = {"steering_min_rad": -0.6, "steering_max_rad": 0.6}
    save_calibration(
        before.model_copy(update={"limits": before.limits.model_copy(update=wide)}), tmp_path / "before.yaml"
    )
    recorded = drive(np.random.default_rng(0), program(hold_s=1.6, steps=8))
    tilted = make_transform(Rotation.from_euler("y", 6.0, degrees=True).as_matrix(), [0.0, 0.0, 0.15])

    def in_double_metres(row):
        return planar_pose(*(row / [2.0, 2.0, 1.0])) @ tilted

    bag = drive_bag(tmp_path / "bag", recorded, in_double_metres)
    assert (
        run(
            "car",
            "calibrate",
            "vehicle",
            bag,
            "--before",
            tmp_path / "before.yaml",
            "-o",
            tmp_path / "v.yaml",
        )
        == 0
    )
    said = " ".join(capsys.readouterr().out.split())
    assert "warning: erpm_per_mps is" in said
    assert "2 times that of --before" in said
    assert "the limits that are kept are -0.600 to +0.600 rad" in said
    assert "got the origin +150 mm from the floor and the axis 6.0 degrees off" in said


def test_clocks_that_differ_are_named_and_not_the_drive(tmp_path, capsys):
    """Poses an hour off left no stretch with commands: 'hold each command for 1.3 s or more'."""
    before = tmp_path / "before.yaml"
    save_calibration(twin_calibrations(LabConfig())["vehicle"], before)
    recorded = drive(np.random.default_rng(0), program(hold_s=1.6, steps=8))
    with BagWriter(tmp_path / "bag") as writer:
        for k, (at_s, row) in enumerate(zip(recorded.pose_s, recorded.poses, strict=True)):
            message = encode(pose_message(planar_pose(*row), ns(at_s - 3600.0)))
            writer.write("/vicon/car", message, ns(at_s), ns(at_s), k)
        write_sent(writer, recorded)
    assert (
        run("car", "calibrate", "vehicle", tmp_path / "bag", "--before", before, "-o", tmp_path / "v.yaml")
        == 2
    )
    said = capsys.readouterr().err
    assert "expected stamps of one clock" in said
    assert "/vicon/car 3.6e+03 s before" in said


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda T: make_transform(T[:3, :3], 1000.0 * T[:3, 3]), "are they in mm"),
        (lambda T: make_transform(Y_UP @ T[:3, :3] @ Y_UP.T, Y_UP @ T[:3, 3]), "is y up in motion capture"),
    ],
)
def test_poses_in_mm_or_with_y_up_are_named(tmp_path, change, says):
    recorded = drive(np.random.default_rng(0), program(hold_s=1.6, steps=8))
    with BagWriter(tmp_path / "bag") as writer:
        write_poses(
            writer, "/vicon/car", recorded.pose_s, [change(planar_pose(*row)) for row in recorded.poses]
        )
    with pytest.raises(DegenerateDataError, match=says):
        read_poses(tmp_path / "bag", "/vicon/car")


@pytest.mark.parametrize("attached", [True, False])
def test_a_time_offset_is_added_to_the_latency_that_the_bag_was_recorded_with(tmp_path, capsys, attached):
    """The camera is 60 ms late, and 20 ms of it were known already; a second run on the same bag changes nothing."""
    file, times = tmp_path / "camera.yaml", np.arange(0.0, 8.0, 0.01)
    recorded = twin_calibrations(LabConfig())["camera"].model_copy(
        update={"latency_s": 0.02, "distortion": (0.0,) * 5}
    )
    save_calibration(recorded, file)
    seen = np.arange(0.5, 7.5, 0.1)
    with BagWriter(tmp_path / "bag", {"camera.yaml": file.read_bytes()} if attached else {}) as writer:
        write_poses(writer, "/vicon/car", times, [planar_pose(0.0, 0.0, yaw_at(t)) for t in times])
        for k, (t, grey) in enumerate(zip(seen, far_wall(recorded, yaw_at(seen)), strict=True)):
            stamp = ns(t + 0.06 - 0.02)
            image = image_message(np.repeat(grey[..., None], 3, -1), stamp, "camera")
            writer.write("/camera/image_raw", encode(image), stamp, stamp, k)
    command = (
        "car",
        "calibrate",
        "time-offset",
        tmp_path / "bag",
        "--camera",
        file,
        "--update",
        "-o",
        tmp_path / "off.yaml",
    )
    assert run(*command) == 0
    assert load_calibration(CameraCalibration, file).latency_s == pytest.approx(0.06, abs=0.003)
    said = capsys.readouterr().out
    assert "as recorded with latency_s 0.02" in said
    assert ("Do not update from it twice" in said) == (not attached)
    assert run(*command) == 0
    assert load_calibration(CameraCalibration, file).latency_s == pytest.approx(
        0.06 if attached else 0.10, abs=0.005
    )


def test_a_source_is_needed_and_only_one(tmp_path, capsys):
    save_calibration(twin_calibrations(LabConfig())["vehicle"], tmp_path / "before.yaml")
    assert (
        run("car", "calibrate", "vehicle", "--before", tmp_path / "before.yaml", "-o", tmp_path / "v.yaml")
        == 2
    )
    assert "either a bag or --live SECONDS" in capsys.readouterr().err


def view_of(board_picture, T_camera_from_board, board):
    """A picture of a flat board, warped by the pinhole's homography."""
    per_square = board_picture.shape[1] / board.columns
    scale = np.diag([board.square_m / per_square, board.square_m / per_square, 1.0])
    H = PINHOLE.matrix @ T_camera_from_board[:3, [0, 1, 3]] @ scale
    # warpPerspective counts from pixel centres, we from corners.
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    big = 4
    up = np.diag([big, big, 1.0])
    M = np.linalg.inv(shift) @ up @ H @ shift
    size = (PINHOLE.width * big, PINHOLE.height * big)
    grey = cv2.warpPerspective(board_picture, M, size, flags=cv2.INTER_LINEAR, borderValue=110)
    grey = cv2.resize(grey, (PINHOLE.width, PINHOLE.height), interpolation=cv2.INTER_AREA)
    return np.repeat(grey[..., None], 3, axis=-1)


def tilt(rng, most=0.4):
    a, b, c = rng.uniform(-most, most, 3)
    return (
        cv2.Rodrigues(np.array([a, 0.0, 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, b, 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, 0.0, c]))[0]
    )


def test_intrinsics_from_a_folder_then_refused_with_half_of_it(tmp_path, capsys):
    rng, folder = np.random.default_rng(1), tmp_path / "pictures"
    folder.mkdir()
    picture = np.pad(BOARD.picture(60), 60, constant_values=255)
    edge = np.array([-1.0, -1.0, 0.0]) * BOARD.square_m
    for k in range(36):
        R = tilt(rng, 0.5)
        depth = rng.uniform(0.45, 0.8)
        pixel = rng.uniform([0.15, 0.2], [0.85, 0.8]) * [336, 188]
        ray = np.array([(pixel[0] - 168.0) / PINHOLE.fx, (pixel[1] - 94.0) / PINHOLE.fy, 1.0])
        T = make_transform(R, ray * depth - R @ (np.array([0.4, 0.3, 0.0])) + R @ edge)
        wide = Board(10, 8, BOARD.square_m, BOARD.marker_m, "DICT_4X4_100")
        cv2.imwrite(str(folder / f"{k:02d}.png"), view_of(picture, T, wide))
    board = ("--columns", 8, "--rows", 6, "--square", 0.1, "--marker", 0.075)
    assert (
        run("car", "calibrate", "intrinsics", folder, *board, "--model", "none", "-o", tmp_path / "lens.yaml")
        == 0
    )
    found = load_calibration(LensCalibration, tmp_path / "lens.yaml")
    assert found.fx == pytest.approx(PINHOLE.fx, rel=0.01)
    assert found.cx == pytest.approx(168.0, abs=1.5)
    assert found.rms_px < 0.3
    assert "warning" not in capsys.readouterr().out
    for file in sorted(folder.glob("*.png"))[15:]:
        file.unlink()
    capsys.readouterr()
    assert run("car", "calibrate", "intrinsics", folder, *board, "-o", tmp_path / "no.yaml") == 2
    error = capsys.readouterr().err
    assert "expected at least 20 pictures with the board" in error
    assert error.count("\n") == 1
    other = ("--columns", 6, "--rows", 8, *board[4:])
    for file in sorted(folder.glob("*.png")):
        for copy in range(2):  # enough pictures, but they show nothing new, and another board
            shutil.copy(file, folder / f"{file.stem}_{copy}.png")
    assert run("car", "calibrate", "intrinsics", folder, *board, "-o", tmp_path / "no.yaml") == 2
    told = capsys.readouterr()
    assert "board found in 45 of 45 images, in 15 of them at another place" in told.out
    assert "expected at least 20 pictures with the board" in told.err
    assert run("car", "calibrate", "intrinsics", folder, *other, "-o", tmp_path / "no.yaml") == 2
    assert (
        "is it one of 6 x 8 squares with markers of DICT_4X4_50? Give --columns, --rows"
        in capsys.readouterr().err
    )
    assert (
        run(
            "car",
            "calibrate",
            "intrinsics",
            tmp_path / "pictures",
            "--model",
            "seven",
            "-o",
            tmp_path / "no.yaml",
        )
        == 2
    )


@pytest.mark.parametrize("on_the_way", [True, False])
def test_camera_to_car_from_a_bag_of_stops(tmp_path, capsys, on_the_way):
    """Stops with a tilted, tracked board; frames that are taken between them must not count, and there may be none."""
    rng = np.random.default_rng(2)
    board = Board(6, 5, 0.12, 0.09)
    picture = np.pad(board.picture(60), 60, constant_values=255)
    wide = Board(8, 7, 0.12, 0.09)
    edge = make_transform(np.eye(3), np.array([-0.12, -0.12, 0.0]))
    mount = camera_mount(0.3, 0.0, 0.2, np.radians(10.0))
    pattern = make_transform(
        np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), [0.0, -0.36, 0.3]
    )
    save_calibration(
        LensCalibration(
            date="2026-11-21",
            method="test",
            width=336,
            height=188,
            fx=PINHOLE.fx,
            fy=PINHOLE.fy,
            cx=168.0,
            cy=94.0,
            rms_px=0.1,
        ),
        tmp_path / "lens.yaml",
    )
    stops, move_s, stop_s = 16, 0.3, 0.5
    places = [(1.0 + 0.5 * rng.random(), rng.uniform(-0.35, 0.35), tilt(rng, 0.3)) for _ in range(stops + 1)]

    def poses(t):
        k, inside = divmod(t, move_s + stop_s)
        share = min(inside / move_s, 1.0)
        a, b = places[int(k)], places[min(int(k) + 1, stops)]
        away, angle = (a[i] + share * (b[i] - a[i]) for i in (0, 1))
        car = planar_pose(away * np.cos(angle), away * np.sin(angle), angle + np.pi)
        return car, make_transform(b[2], [0.0, 0.0, 0.25])

    with BagWriter(tmp_path / "bag") as writer:
        times = np.arange(0.0, stops * (move_s + stop_s), 0.02)
        for topic, which in (("/vicon/car", 0), ("/vicon/board", 1)):
            moved = [poses(t)[which] @ make_transform(np.eye(3), rng.normal(0.0, 0.0003, 3)) for t in times]
            write_poses(writer, topic, times, moved)
        at_stops = (move_s + stop_s) * np.arange(stops) + move_s + 0.5 * stop_s
        for k, t in enumerate(np.arange(0.2, times[-1], 0.2) if on_the_way else at_stops):
            car, held = poses(t)
            T = np.linalg.inv(car @ mount) @ held @ pattern @ edge
            stamp = ns(t)
            writer.write(
                "/camera/image_raw",
                encode(image_message(view_of(picture, T, wide), stamp, "camera")),
                stamp,
                stamp,
                k,
            )
    with pytest.raises(
        DegenerateDataError, match="frames of 480 x 360, as the lens was calibrated for, got 336 x 188"
    ):
        still_views(tmp_path / "bag", BoardDetector(board), "/vicon/board", (480, 360))
    views, frames = still_views(tmp_path / "bag", BoardDetector(board), "/vicon/board", (336, 188))
    assert frames > 50 if on_the_way else frames == stops
    assert 12 <= len(views) <= stops
    options = (
        "--columns",
        6,
        "--rows",
        5,
        "--square",
        0.12,
        "--marker",
        0.09,
        "--lens",
        tmp_path / "lens.yaml",
    )
    assert (
        run("car", "calibrate", "camera-to-car", tmp_path / "bag", *options, "-o", tmp_path / "camera.yaml")
        == 0
    )
    found = load_calibration(CameraCalibration, tmp_path / "camera.yaml")
    np.testing.assert_allclose(found.mount[:3, 3], mount[:3, 3], atol=0.004)
    assert (tmp_path / "camera.png").exists()
    capsys.readouterr()
    # A camera that is mounted anew keeps the delay of its stamps, and what was noted.
    save_calibration(
        found.model_copy(update={"latency_s": 0.06, "notes": "left socket"}), tmp_path / "camera.yaml"
    )
    bag = tmp_path / "bag"
    assert run("car", "calibrate", "camera-to-car", bag, *options, "-o", tmp_path / "camera.yaml") == 0
    assert "latency_s 0.06 is kept" in capsys.readouterr().out
    again = load_calibration(CameraCalibration, tmp_path / "camera.yaml")
    assert (again.latency_s, again.notes, again.mount.tolist()) == (0.06, "left socket", found.mount.tolist())
    # The car itself only drove on the floor: without the board's poses the same bag fixes nothing.
    assert (
        run(
            "car",
            "calibrate",
            "camera-to-car",
            tmp_path / "bag",
            *options,
            "--untracked",
            "-o",
            tmp_path / "no.yaml",
        )
        == 2
    )
    assert "planar" in capsys.readouterr().err
    assert not (tmp_path / "no.yaml").exists()


def test_display_from_a_folder(tmp_path, capsys):
    assert run("car", "calibrate", "display-colours", "-o", tmp_path, "--width", 32, "--height", 18) == 0
    colours = colours_to_show()
    (tmp_path / "seen").mkdir()
    rng = np.random.default_rng(4)
    for k, colour in enumerate(colours):
        shown = cv2.imread(str(tmp_path / "show" / f"{k:03d}.png"))[0, 0, ::-1]
        np.testing.assert_array_equal(shown, colour)
        light = np.array([[0.6, 0.1, 0.0], [0.05, 0.7, 0.05], [0.0, 0.1, 0.6]]) @ (colour / 255.0) ** 2.2
        image = np.full((60, 90, 3), 40.0)
        image[10:50, 20:80] = 255.0 * (0.02 + light) ** (1.0 / 2.2)
        noisy = np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).round().astype(np.uint8)
        cv2.imwrite(str(tmp_path / "seen" / f"{k:03d}.png"), noisy[..., ::-1])
    assert (
        run(
            "car",
            "calibrate",
            "display",
            tmp_path,
            "--conditions",
            "lamps on",
            "-o",
            tmp_path / "display.yaml",
        )
        == 0
    )
    found = load_calibration(DisplayCalibration, tmp_path / "display.yaml")
    assert found.residuals["held_out_rmse"] < 0.01
    assert yaml.safe_load((tmp_path / "display.yaml").read_text())["conditions"] == "lamps on"
    capsys.readouterr()
    cv2.imwrite(str(tmp_path / "seen" / "005.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "seen" / "006.png").write_bytes(b"no picture")
    for name, words in (
        ("005", "pictures of 90 x 60"),
        ("006", "006.png (10 bytes): it is damaged"),
        ("666", "No such file"),
    ):
        rows = [
            "file,red,green,blue",
            "seen/000.png,0,0,0",
            "seen/001.png,255,255,255",
            f"seen/{name}.png,9,9,9",
        ]
        (tmp_path / "shown.csv").write_text("\n".join(rows))
        assert run("car", "calibrate", "display", tmp_path, "-o", tmp_path / "no.yaml") == 2
        assert words in capsys.readouterr().err
    (tmp_path / "shown.csv").write_text("file,red\nseen/000.png,0\n")
    capsys.readouterr()
    assert run("car", "calibrate", "display", tmp_path, "-o", tmp_path / "no.yaml") == 2
    assert "columns file, red, green, blue" in capsys.readouterr().err


@pytest.mark.own_process
@pytest.mark.filterwarnings("default::DeprecationWarning")
def test_a_session_on_a_real_sdl_screen_keeps_only_frames_of_the_colour_that_is_shown(tmp_path, monkeypatch):
    """The camera here photographs what SDL holds, one frame late: as a real one whose exposure began before the flip."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    display = PygameDisplay(0, (64, 36))
    clock = iter(range(1, 1_000_000))

    def camera():
        before = np.zeros((60, 80, 3), np.uint8)
        while True:
            now = np.full((60, 80, 3), 30, np.uint8)
            now[10:46, 8:72] = np.maximum(display.read_back(), 35)
            yield next(clock), before
            before = now

    colours = [(0, 0, 0), (255, 255, 255), (200, 100, 50), (20, 240, 90)]
    try:
        folder = show_and_watch(display, camera(), colours, tmp_path / "session", now_ns=lambda: next(clock))
        shown, seen, angles = read_shown(folder)
        with pytest.raises(CalibrationError, match="already has a session"):
            show_and_watch(display, camera(), colours, folder)
        with pytest.raises(CalibrationError, match="the camera stopped"):
            show_and_watch(
                display, iter([(2**62, np.zeros((60, 80, 3), np.uint8))]), colours, tmp_path / "short"
            )
    finally:
        display.close()
    np.testing.assert_allclose(shown, np.array(colours) / 255.0)
    np.testing.assert_allclose(seen, np.maximum(np.array(colours), 35) / 255.0)
    assert (angles == 1.0).all()
    assert len(list((folder / "seen").iterdir())) == 8 * len(colours)
    assert not (tmp_path / "short" / "shown.csv").exists()


def test_live_topics_become_a_bag_and_silence_is_told(tmp_path):
    """A publisher in another process, as a node would be."""
    code = (
        "import sys, time; from pathlib import Path\n"
        "import numpy as np\n"
        "from nodes.runtime.bus import Bus\n"
        "from nodes.runtime.messages import pose_message\n"
        "with Bus(Path(sys.argv[1])) as bus:\n"
        "    bus.publisher('/vicon/car')\n"
        "    print('up', flush=True)\n"
        "    end = time.monotonic() + 20\n"
        "    while time.monotonic() < end:\n"
        "        bus.publish('/vicon/car', pose_message(np.eye(4), time.time_ns()))\n"
        "        time.sleep(0.005)\n"
    )
    run_dir = tmp_path / "r"
    run_dir.mkdir()
    process = subprocess.Popen([sys.executable, "-c", code, str(run_dir)], stdout=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"up\n"
        bag = record_live(run_dir, ("/vicon/car",), 0.8, tmp_path / "bag")
        assert next(t.count for t in read_info(bag).topics if t.name == "/vicon/car") > 20
        with pytest.raises(BagError, match="expected messages of /vicon/board within"):
            record_live(run_dir, ("/vicon/car", "/vicon/board"), 0.3, tmp_path / "silent")
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with Bus(run_dir):
        pass


def test_a_board_to_print(tmp_path, capsys):
    assert (
        run(
            "car",
            "calibrate",
            "board",
            "-o",
            tmp_path / "board.png",
            "--columns",
            7,
            "--rows",
            5,
            "--square",
            0.04,
        )
        == 0
    )
    printed = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert printed.shape == (1000, 1400)
    found = BoardDetector(Board(7, 5, 0.04, 0.03)).find(np.pad(printed, 100, constant_values=255))
    assert len(found.pixels) == 24
    assert "280 x 200 mm" in capsys.readouterr().out


# What each command reads: arguments have no name, and are in their order.
GIVEN = {
    "intrinsics": [""],
    "camera-to-car": ["", "--lens", "--pattern"],
    "vehicle": ["", "--before"],
    "time-offset": ["", "--camera"],
    "display": [""],
    "printer": ["", "--chart", "--lens"],
}


@pytest.mark.parametrize("name", GIVEN)
def test_neither_the_file_nor_its_plot_replaces_an_input(tmp_path, capsys, name):
    words, files = [], [tmp_path / f"folder{k}" / "given.png" for k in range(len(GIVEN[name]))]
    for option, file in zip(GIVEN[name], files, strict=True):
        file.parent.mkdir()
        file.write_text(option)
        words += [*option.split(), file.parent if name == "display" else file]
    for file in files:
        for output in (file, file.with_suffix(".yaml")):
            assert run("car", "calibrate", name, *words, "-o", output) == 2
            assert "would be overwritten" in capsys.readouterr().err
    assert {file: file.read_text() for file in tmp_path.rglob("given.*")} == dict(
        zip(files, GIVEN[name], strict=True)
    )


def test_all_commands_that_write_a_calibration_are_among_these():
    commands = typer.main.get_command(app).commands
    helps = {
        name: next(each.help for each in found.params if each.name == "output")
        for name, found in commands.items()
    }
    assert {name for name, text in helps.items() if "YAML" in text} == set(GIVEN)
