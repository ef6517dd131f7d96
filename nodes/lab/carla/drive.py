"""The lane-following expert on ground-truth state, driving a reference path of a deployment scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Path
from advnerf_core.geometry import Array
from hardware.worlds.world import DeploymentScene

# How firmly the expert returns to the lane, a little more than the teacher of the experiment, and how far it looks ahead.
_STIFFNESS_1PM, _DELAY_S = 0.25, 0.1


@dataclass(frozen=True, eq=False)
class ExpertDrive:
    """One drive.

    Attributes:
        states: x [m], y [m], yaw [rad] at the ticks ``[T + 1, 3]``.
        controls: Turn rates [rad/s] ``[T]``.
        cte_m: Signed cross-track error at the ticks ``[T + 1]``, left positive.
        blocked_tick: When the car ran into something; None if it did not.
    """

    states: Array
    controls: Array
    cte_m: Array
    blocked_tick: int | None


def turn_rate_expert(path: Path, speed_mps: float, dt_s: float, max_turn_rate_radps: float) -> Expert:
    """The project's expert with a Dubins car's command, the turn rate."""
    config = ExpertConfig(
        speed_mps=speed_mps, delay_s=_DELAY_S, stiffness_1pm=_STIFFNESS_1PM, smoothing_m=speed_mps * dt_s,
        steering_limits_rad=(-max_turn_rate_radps, max_turn_rate_radps), output="turn_rate",
    )  # fmt: skip
    return Expert(path, config)


def drive_expert(
    scene: DeploymentScene, expert: Expert, start: tuple[float, float, float], ticks: int, dt_s: float
) -> ExpertDrive:
    """Drive from a start pose; the expert knows the true state, no picture is taken.

    Args:
        scene: Where.
        expert: Who, and on which path.
        start: x [m], y [m], yaw [rad].
        ticks: How many commands.
        dt_s: How long each [s].
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


def _now(scene: DeploymentScene) -> tuple[float, float, float]:
    return scene.state.x_m, scene.state.y_m, scene.state.yaw_rad
