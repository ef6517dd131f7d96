"""How near to the truth do the calibrations come on the simulated lab? ``python -m benchmarks.calibrations`` (a few minutes, no real time).

Noise is that of the real things: motion capture 0.5 mm and 1 mrad (standard deviation per axis), camera 1.5 of 255 per pixel. What is
rendered and what is computed: camera-to-car and the display model use frames that MuJoCo draws (a ChArUco board on the lab's board
panel, before which the car is held tilted; plain colours on the lab's monitor with `MonitorOpticsConfig.office`); the time offset uses rendered
frames of a car that is turned to and fro by hand; the vehicle uses the twin's car without pictures. ``--trial`` takes one repetition and records nothing.
"""

from __future__ import annotations

import argparse
import math
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import Array, make_transform
from benchmarks.results import record_row
from calibration.by_construction import twin_calibrations
from calibration.camera_to_car import MountFit, MountView, calibrate_mount
from calibration.charuco import Board, BoardDetector
from calibration.measured import LensCalibration
from calibration.schema import (
    CameraCalibration,
    TargetCalibration,
    VehicleCalibration,
    save_calibration,
)
from calibration.time_offset import fit_offset, image_turns
from calibration.vehicle import RecordedDrive, fit_gains
from calibration.vehicle_response import fit_response
from hardware.worlds.lab.config import CarConfig, LabConfig, MonitorOpticsConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.experiment.show import screen

COMMAND = "python -m benchmarks.calibrations"
MOCAP_M, MOCAP_RAD, PIXEL_STDDEV, TAPE_M = 0.0005, 0.001, 1.5, 0.001
# On the 1 m board panel: eight squares of an eighth of it, a one-square margin, so that the print ends inside the panel.
BOARD = Board(columns=6, rows=6, square_m=0.125, marker_m=0.094)
VIEWS, REPETITIONS = 80, 5
OFFSET_S, COMMAND_DELAY_S = 0.067, 0.03
_FITTED_GAINS = ("servo_per_rad", "servo_offset", "erpm_per_mps")
_MEASURED = {"method": "measured on the simulated lab", "notes": f"by {COMMAND} --write"}


def noisy_image(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Camera noise, then 8 bits again."""
    return np.clip(np.rint(image + rng.normal(0.0, PIXEL_STDDEV, image.shape)), 0, 255).astype(np.uint8)


def noisy_pose(T: Array, rng: np.random.Generator) -> Array:
    """Motion-capture noise on all six axes."""
    turn = Rotation.from_rotvec(rng.normal(0.0, MOCAP_RAD, 3)).as_matrix()
    moved = T @ make_transform(turn, np.zeros(3))
    moved[:3, 3] += rng.normal(0.0, MOCAP_M, 3)
    return moved


def board_texture() -> np.ndarray:
    """The panel's picture: the board with a margin of one square."""
    pixels = 64
    grey = np.pad(BOARD.picture(pixels), pixels, constant_values=255)
    # Darker white than the brightest: a lit print is no lamp.
    return np.repeat((grey * 0.9).astype(np.uint8)[..., None], 3, axis=-1)


def held_before_board(lab: Lab, rng: np.random.Generator) -> Array:
    """A pose of the car, held by hand before the board's face so that the camera sees it."""
    away, aside, up = rng.uniform(0.8, 1.4), rng.uniform(-0.8, 0.8), rng.uniform(-0.3, 0.8)
    roll, pitch, yaw = rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35), rng.uniform(-0.3, 0.3)
    face = lab.config.board.T_world_from_face
    eye = face @ np.array([away, aside, up, 1.0])
    # Toward the face's middle, then turned a little: the camera looks along the car's x, 10 degrees down.
    towards = face[:3, 3] - eye[:3]
    heading = math.atan2(towards[1], towards[0]) + yaw
    climb = math.atan2(towards[2], math.hypot(towards[0], towards[1])) + lab.config.camera.pitch_down_rad
    R = Rotation.from_euler("ZYX", [heading, -climb + 0.5 * pitch, roll]).as_matrix()
    camera = lab.config.camera.T_car_from_camera
    return make_transform(R, eye[:3] - R @ camera[:3, 3])


def fitted_mount(lab: Lab, seed: int) -> MountFit:
    """The mounting pose as measured on noisy views of the board."""
    rng, detector = np.random.default_rng(seed), BoardDetector(BOARD)
    pinhole = lab.camera_pinhole
    lens = LensCalibration(
        date=date(2026, 11, 21),
        method="twin",
        width=pinhole.width,
        height=pinhole.height,
        fx=pinhole.fx,
        fy=pinhole.fy,
        cx=pinhole.cx,
        cy=pinhole.cy,
    )
    board = lab.config.board.T_world_from_face
    views: list[MountView] = []
    for _ in range(4 * VIEWS):
        car = held_before_board(lab, rng)
        found = detector.find(noisy_image(lab.observe_held(car), rng))
        if found is not None and len(found.pixels) >= 12:
            views.append(MountView(noisy_pose(car, rng), noisy_pose(board, rng), found))
        if len(views) == VIEWS:
            break
    return calibrate_mount(views, lens)


def measure_camera_to_car(lab: Lab, seed: int) -> tuple[float, float]:
    """Error of the mounting pose: angle [degrees], distance [m]."""
    fit, truth = fitted_mount(lab, seed), lab.config.camera.T_car_from_camera
    turn = float(rotation_angles(fit.T_car_from_camera[:3, :3].T @ truth[:3, :3]))
    distance = float(np.linalg.norm(fit.T_car_from_camera[:3, 3] - truth[:3, 3]))
    print(
        f"camera-to-car: {math.degrees(turn):.3f} degrees, {1000 * distance:.2f} mm (stated {math.degrees(fit.rotation_stddev_rad):.3f}, "
        f"{1000 * fit.translation_stddev_m:.2f}), {int(fit.used.sum())} of {len(fit.used)} views, rms {fit.rms_px:.2f} px",
        flush=True,
    )
    return math.degrees(turn), distance


def recorded_drive(seed: int) -> RecordedDrive:
    """Circles, straight runs and steps of the twin's car; commands at 20 Hz, poses at 100 Hz with noise."""
    rng, car = np.random.default_rng(seed), CarConfig()
    rows = [(2.5, angle, speed) for speed in (0.6, 1.0) for angle in (0.0, 0.25, -0.22, 0.12, -0.12)]
    rows += [
        (rng.uniform(0.35, 0.7), (0.26 if k % 2 else -0.24) * rng.uniform(0.4, 1.0), (0.6, 1.0)[k // 2 % 2])
        for k in range(12)
    ]
    ends = np.cumsum([row[0] for row in rows])
    command_s, pose_s = np.arange(0.0, ends[-1], 0.05), np.arange(0.0, ends[-1], 0.01)
    chosen = [rows[k] for k in np.searchsorted(ends, command_s, side="right")]
    servo = np.array([car.servo_from_steering(row[1]) for row in chosen])
    erpm = np.array([car.erpm_from_speed(row[2]) for row in chosen])
    vehicle, now, poses = TwinVehicle(car), 0.0, []
    events = [(t + COMMAND_DELAY_S, 0, k) for k, t in enumerate(command_s)] + [
        (t, 1, k) for k, t in enumerate(pose_s)
    ]
    for when, kind, k in sorted(events):
        vehicle.advance(max(when - now, 0.0))
        now = when
        if kind == 0:
            vehicle.command(servo=float(servo[k]), erpm=float(erpm[k]))
        else:
            state = vehicle.state
            poses.append((state.x_m, state.y_m, state.yaw_rad))
    seen = np.array(poses)
    seen[:, 2] = np.unwrap(seen[:, 2])
    seen += rng.normal(0.0, [MOCAP_M, MOCAP_M, MOCAP_RAD], seen.shape)
    return RecordedDrive(pose_s, seen, command_s, servo, erpm, np.full(len(servo), np.nan))


def measure_vehicle(seed: int) -> tuple[float, float, float, float, float]:
    """Relative errors of servo gain, offset and speed gain; errors of delay and lag of the steering [s]."""
    car, drive = CarConfig(), recorded_drive(seed)
    gains = fit_gains(drive, car.wheelbase_m)
    response = fit_response(drive, gains).steering
    errors = (
        abs(gains.servo_per_rad / car.true_servo_gain - 1.0),
        abs(gains.servo_offset / car.true_servo_offset - 1.0),
        abs(gains.erpm_per_mps / car.true_erpm_gain - 1.0),
        abs(response.delay_s - COMMAND_DELAY_S),
        abs(response.lag_s - car.steering_lag_s),
    )
    print(
        f"vehicle: gain {100 * errors[0]:.2f} %, offset {100 * errors[1]:.2f} %, speed {100 * errors[2]:.2f} %, "
        f"delay {1000 * errors[3]:.1f} ms, lag {1000 * errors[4]:.1f} ms",
        flush=True,
    )
    return errors


def measure_time_offset(lab: Lab, seed: int) -> float:
    """Error of the offset between camera and motion capture [s]."""
    rng = np.random.default_rng(seed)
    amplitude, rate, phase = (
        rng.uniform(0.15, 0.3, 3),
        np.array([1.1, 2.63, 4.7]) * rng.uniform(0.9, 1.1, 3),
        rng.uniform(0.0, 6.0, 3),
    )
    slip = rng.uniform(0.02, 0.05)

    def car_at(t: float) -> tuple[float, float, float]:
        """Turned about somewhere near its rear axle, as by hand."""
        yaw = float(np.sum(amplitude * np.sin(rate * t + phase)))
        return -1.1 + slip * math.sin(0.7 * t), -2.0 + slip * math.sin(1.3 * t), yaw

    frame_s, pose_s = np.arange(1.0, 21.0, 0.1), np.arange(0.0, 22.0, 0.01, np.float64)
    camera = twin_calibrations(lab.config)["camera"]
    assert isinstance(camera, CameraCalibration)
    frames = (
        (t + OFFSET_S, noisy_image(lab.observe_at(*car_at(t), depth=False)[0], rng)) for t in frame_s.tolist()
    )
    yaw = np.array([car_at(t)[2] for t in pose_s.tolist()]) + rng.normal(0.0, MOCAP_RAD, len(pose_s))
    fit = fit_offset(image_turns(frames, camera), pose_s, yaw)
    error = abs(fit.camera_minus_mocap_s - OFFSET_S)
    print(
        f"time offset: {1000 * error:.2f} ms (stated {1000 * fit.stddev_s:.2f}), scale {fit.scale:.3f}",
        flush=True,
    )
    return error


def measure_display(world: Lab, seed: int) -> tuple[float, float]:
    """RMSE on held-out colours, of the model and of a monitor taken for ideal, over three places of the car."""
    rng = np.random.default_rng(seed)
    panel = world.describe().panels["monitor"]
    fit = screen.measure_display(
        world, "monitor", panel, seed, lambda clean: [noisy_image(clean, rng) for _ in range(8)]
    )
    ideal = float(np.sqrt(np.mean((fit.shown[fit.held_out] - fit.seen[fit.held_out]) ** 2)))
    print(
        f"display: held out {100 * fit.rmse(True):.2f} %, taken for ideal {100 * ideal:.1f} %; falloff {fit.model.falloff:.2f} "
        f"(true {world.config.monitor_optics.falloff}), {len(fit.shown)} colours",
        flush=True,
    )
    return fit.rmse(True), ideal


def write(folder: Path) -> None:
    """Write calibration files of the default lab as somebody measured them: mount and gains by the fits above, sizes with a tape measure."""
    exact, rng = twin_calibrations(LabConfig()), np.random.default_rng(0)
    with Lab() as lab:
        lab.set_board_image(board_texture())
        mount = fitted_mount(lab, 0).T_car_from_camera
    vehicle = exact["vehicle"]
    assert isinstance(vehicle, VehicleCalibration)
    fit = fit_gains(recorded_drive(0), CarConfig().wheelbase_m)
    changed: dict[str, dict[str, Any]] = {"camera": {"T_car_from_camera": mount.tolist()}}
    changed["vehicle"] = {"gains": vars(vehicle.gains) | {name: getattr(fit, name) for name in _FITTED_GAINS}}
    for name in ("board", "monitor"):
        target = exact[name]
        assert isinstance(target, TargetCalibration)
        grown = 1.0 + rng.normal(0.0, TAPE_M, 3) / np.maximum(np.ptp(target.corners, axis=0), TAPE_M)
        changed[name] = {"corners_in_subject_m": np.round(target.corners * grown, 6).tolist()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, calibration in exact.items():
        values = changed[name] | _MEASURED if name in changed else {}
        found = type(calibration).model_validate({**calibration.model_dump(), **values})
        save_calibration(found, folder / f"{name}.yaml")


def record(name: str, value: float, unit: str, target: str, met: bool, note: str) -> None:
    record_row(f"calibration on the twin: {name}", round(value, 4), unit, target, met, COMMAND, note)


def main() -> None:
    """Measure, and record the worst repetition."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--trial", action="store_true", help="one repetition, nothing recorded")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write one repetition's files, instead")
    options = parser.parse_args()
    if options.write is not None:
        write(options.write)
        return
    trial = options.trial
    seeds = range(1 if trial else REPETITIONS)
    drives = np.array([measure_vehicle(seed) for seed in seeds])
    config = LabConfig(monitor_optics=MonitorOpticsConfig.office())
    with Lab(config) as lab:
        lab.set_board_image(board_texture())
        mounts = np.array([measure_camera_to_car(lab, seed) for seed in seeds])
        lab.set_board_image(None)
        offsets = [measure_time_offset(lab, seed) for seed in seeds]
        displays = np.array([measure_display(lab, seed) for seed in seeds])
    if trial:
        return
    noise = (
        f"worst of {len(seeds)}; motion capture 0.5 mm, 1 mrad per axis; image noise {PIXEL_STDDEV} of 255"
    )
    turn, distance = mounts.max(axis=0)
    rendered = (
        f"{noise}; board rendered, car held tilted before it, pattern pose solved jointly, {VIEWS} views"
    )
    record("camera-to-car rotation", float(turn), "degrees", "<= 0.1 degrees", bool(turn <= 0.1), rendered)
    record(
        "camera-to-car translation",
        1000 * float(distance),
        "mm",
        "<= 2 mm",
        bool(distance <= 0.002),
        rendered,
    )
    gain, offset, speed, delay, lag = drives.max(axis=0)
    worst = max(gain, offset, speed)
    parts = f"servo gain {100 * gain:.2f} %, offset {100 * offset:.2f} %, speed gain {100 * speed:.2f} %; steering delay {1000 * delay:.1f} ms, lag {1000 * lag:.1f} ms off"
    record(
        "vehicle gain and offset", 100 * float(worst), "%", "<= 1 %", bool(worst <= 0.01), f"{parts}; {noise}"
    )
    late = max(offsets)
    record(
        "camera to motion-capture time offset",
        1000 * late,
        "ms",
        "<= 3 ms",
        late <= 0.003,
        f"{noise}; rendered frames at 10 Hz, 20 s, true offset {1000 * OFFSET_S:.0f} ms",
    )
    rmse, ideal = displays.max(axis=0)
    record(
        "display model, held-out colours",
        100 * float(rmse),
        "% RMSE",
        "<= 2 % RMSE",
        bool(rmse <= 0.02),
        f"{noise}; rendered from three angles; {100 * ideal:.0f} % if the monitor is taken for ideal",
    )


if __name__ == "__main__":
    main()
