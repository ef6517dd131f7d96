"""Calibration files of the simulated lab, made from its configuration instead of measurements.

``python -m calibration.by_construction calibration/twin`` writes the files of the default lab; an experiment with another
`LabConfig` writes its own.
"""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

from advnerf_core.driving.path import Path as DrivingPath
from calibration.schema import (
    BY_CONSTRUCTION,
    Calibration,
    CameraCalibration,
    GainsSection,
    LimitsSection,
    RoomCalibration,
    TargetCalibration,
    VehicleCalibration,
    save_calibration,
)
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.worlds.lab.config import CarConfig, LabConfig, PanelConfig
from hardware.worlds.lab.lab import FENCE_MARGIN_M, HALF_LANE_M

# The day the default lab got its numbers; the files do not change when they are written again.
LAB_DATE = datetime.date(2026, 11, 21)


def twin_calibrations(lab: LabConfig) -> dict[str, Calibration]:
    """Make the calibrations of a simulated lab by file name without suffix: camera, vehicle, board, monitor, room."""
    return {
        "camera": _camera(lab),
        "vehicle": _vehicle(lab.car),
        "board": _target("board", lab.board),
        "monitor": _target("monitor", lab.monitor),
        "room": _room(lab),
    }


def write_twin_calibrations(lab: LabConfig, folder: Path) -> dict[str, Path]:
    """Write the calibration files of a simulated lab to a folder. Returns their paths by name."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {}
    for name, calibration in twin_calibrations(lab).items():
        paths[name] = folder / f"{name}.yaml"
        save_calibration(calibration, paths[name])
    return paths


def _camera(lab: LabConfig) -> CameraCalibration:
    pinhole = lab.camera.pinhole
    return CameraCalibration(
        date=LAB_DATE,
        method=BY_CONSTRUCTION,
        width=pinhole.width,
        height=pinhole.height,
        fx=pinhole.fx,
        fy=pinhole.fy,
        cx=pinhole.cx,
        cy=pinhole.cy,
        T_car_from_camera=lab.camera.T_car_from_camera.tolist(),
    )


def _vehicle(car: CarConfig) -> VehicleCalibration:
    gains = VehicleGains(
        erpm_per_mps=car.nominal_erpm_gain,
        servo_per_rad=car.nominal_servo_gain,
        servo_offset=car.nominal_servo_offset,
        servo_min=car.servo_min,
        servo_max=car.servo_max,
    )
    # The servo's range is what limits the wheels.
    right, left = sorted(gains.steering_rad(servo) for servo in (car.servo_min, car.servo_max))
    limits = DriveLimits(steering_min_rad=right, steering_max_rad=left)
    return VehicleCalibration(
        date=LAB_DATE,
        method=BY_CONSTRUCTION,
        wheelbase_m=car.wheelbase_m,
        notes="nominal gains, as a careful person would measure them; the simulated car deviates by 2 to 3 %",
        gains=GainsSection(**vars(gains)),
        limits=LimitsSection(**vars(limits)),
    )


def _target(subject: str, panel: PanelConfig) -> TargetCalibration:
    y, z = 0.5 * panel.width_m, 0.5 * panel.height_m
    # Facing the panel one looks along its -x with z up, so left is its -y.
    corners = ((0.0, -y, z), (0.0, y, z), (0.0, y, -z), (0.0, -y, -z))
    return TargetCalibration(
        date=LAB_DATE, method=BY_CONSTRUCTION, subject=subject, corners_in_subject_m=corners
    )


def _room(lab: LabConfig) -> RoomCalibration:
    track = lab.track
    path = DrivingPath.rounded_square(track.side_m, track.corner_radius_m)
    reach = 0.5 * lab.room.side_m - FENCE_MARGIN_M
    return RoomCalibration(
        date=LAB_DATE,
        method=BY_CONSTRUCTION,
        path=path.to_dict(),
        off_track_m=HALF_LANE_M,
        start_pose=lab.start_pose,
        fence_m=((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)),
    )


if __name__ == "__main__":
    for written in write_twin_calibrations(LabConfig(), Path(sys.argv[1])).values():
        print(written)
