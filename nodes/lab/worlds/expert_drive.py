"""The lane-following expert on ground-truth state, driving a reference path of a world."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.geometry import Array
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import CarDescription, World

# Stiffness of the expert's return to the lane, a little above the experiment's teacher, and its look-ahead.
_STIFFNESS_1PM, _DELAY_S = 0.25, 0.1


@dataclass(frozen=True, eq=False)
class ExpertDrive:
    """One drive.

    Attributes:
        states: x [m], y [m], yaw [rad] at the ticks ``[T + 1, 3]``.
        controls: Turn rates [rad/s], or wheel angles [rad] ``[T]``.
        cte_m: Signed cross-track error at the ticks ``[T + 1]``, left positive.
        blocked_tick: Tick of a collision; None without one.
    """

    states: Array
    controls: Array
    cte_m: Array
    blocked_tick: int | None


def as_path(reference: ReferencePath) -> Path:
    """The path of given lines and arcs.

    Raises:
        ValueError: They are invalid, such as a closed path that does not close.
    """
    pieces = [
        Line(piece[1]) if piece[0] == "line" else Arc(piece[1], piece[2]) for piece in reference.segments
    ]
    return Path.from_segments(reference.start_pose, pieces, closed=reference.closed)


def lane_expert(
    path: Path, car: CarDescription, dt_s: float, stiffness_1pm: float = _STIFFNESS_1PM
) -> Expert:
    """The project's expert with a car's control: the turn rate of a Dubins car, the wheel angle of one with a wheelbase."""
    gains = ExpertConfig(delay_s=_DELAY_S, stiffness_1pm=stiffness_1pm, smoothing_m=car.speed_mps * dt_s)
    return expert_of(path, car, gains)


def expert_of(path: Path, car: CarDescription, gains: ExpertConfig) -> Expert:
    """The expert with these gains, with a car's speed, limits and control; see `lane_expert`."""
    config = replace(gains, speed_mps=car.speed_mps, steering_limits_rad=car.control_limits)
    if car.wheelbase_m is None:
        return Expert(path, replace(config, output="turn_rate"))
    return Expert(path, replace(config, wheelbase_m=car.wheelbase_m, output="wheel_angle"))


def drive_expert(
    scene: World, expert: Expert, start: tuple[float, float, float], ticks: int, dt_s: float
) -> ExpertDrive:
    """Drive from a start pose; the expert knows the true state, no picture is taken.

    Args:
        start: x [m], y [m], yaw [rad].
    """
    scene.reset(*start)
    states, controls, blocked = [_now(scene)], [], None
    for tick in range(ticks):
        controls.append(float(expert.steer(*states[-1])))
        scene.step(controls[-1], expert.config.speed_mps, dt_s)
        states.append(_now(scene))
        if scene.blocked and blocked is None:
            blocked = tick + 1
    listed = np.array(states)
    return ExpertDrive(listed, np.array(controls), expert.path.project(listed[:, :2]).cte_m, blocked)


def _now(scene: World) -> tuple[float, float, float]:
    return scene.state.x_m, scene.state.y_m, scene.state.yaw_rad
