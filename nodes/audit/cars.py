"""Cars that an audit knows by name, with the usual place of their driving camera; a user's own car is a file."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from advnerf_core.plugins import unknown
from advnerf_core.strict import LengthM, StrictModel
from nodes.lab.worlds.photographs.config import DrivenCarConfig
from nodes.runtime.config import load_config
from nodes.runtime.errors import ConfigError


class AuditedCar(StrictModel):
    """A car and its camera.

    Attributes:
        car: Kinematics of the car.
        camera_ahead_m: Position of the camera ahead of the rear axle [m].
        camera_left_m: Position of the camera left of the car's middle [m].
        camera_height_m: Height of the camera above the ground [m]; None asks the user.
    """

    car: DrivenCarConfig
    camera_ahead_m: LengthM = 0.0
    camera_left_m: LengthM = 0.0
    camera_height_m: LengthM | None = Field(default=None, gt=0.0)


def _car(speed_mps: float, wheelbase_m: float | None, largest_rad: float, ahead_m: float) -> AuditedCar:
    car = DrivenCarConfig(speed_mps=speed_mps, wheelbase_m=wheelbase_m, max_steering_rad=largest_rad)
    return AuditedCar(car=car, camera_ahead_m=ahead_m)


# Nominal values, not measured ones.
CARS: dict[str, AuditedCar] = {
    "racecarj": _car(0.8, 0.25, 0.26, 0.3),  # RacecarJ/racecar, branch VESC6: racecar-v2/vesc.yaml
    "roboracer": _car(1.5, 0.33, 0.42, 0.27),  # f1tenth_gym's default vehicle: lf + lr, s_max
    "donkey": _car(0.8, 0.175, 0.35, 0.15),  # a 1:16 chassis of donkeycar's list of parts
    "duckiebot": _car(0.3, None, 3.6, 0.06),  # gym-duckietown's robot turns by its wheels' difference
    "car": _car(6.0, 2.7, 0.6, 1.6),
}


def car_of(text: str) -> AuditedCar:
    """A car by its name, or from a YAML file with the keys of `AuditedCar`.

    Raises:
        ConfigError: The car is unknown, or its file is invalid.
    """
    if text in CARS:
        return CARS[text]
    if Path(text).suffix in (".yaml", ".yml"):
        return load_config(AuditedCar, Path(text))
    raise ConfigError(
        f"--car: {unknown(text, 'car', CARS)}; one of your own is a YAML file with the key car (speed_mps, wheelbase_m, max_steering_rad), "
        "camera_ahead_m and camera_height_m"
    )
