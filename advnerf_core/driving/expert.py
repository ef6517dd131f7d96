"""The teacher: follows the reference path with ground-truth state. It uses no images and needs no torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.driving.path import Array, Path
from advnerf_core.geometry import wrap_angle


@dataclass(frozen=True)
class ExpertConfig:
    """Gains and limits of the expert.

    Attributes:
        wheelbase_m: Distance between the axles [m].
        speed_mps: Speed at which it drives [m/s].
        delay_s: Delay from image to turned wheels: half a control tick, computing, command delay and servo lag [s].
        stiffness_1pm: Natural frequency of the return to the path, per metre driven [1/m]. A steering error that is worth a
            curvature ``k`` costs ``k / stiffness^2`` of offset, so this decides how far a fooled policy can be diverted.
        damping: Damping ratio of that return.
        max_approach_rad: Largest angle of approach to the path [rad].
        feed_forward: Share of the path's curvature that is steered ahead, 0..1. At 0 it is the plain PD law on the tracked pose,
            which runs wide in corners by ``curvature / stiffness^2``; at 1 it holds them.
        smoothing_m: Path curvature is averaged over this length, so that the steering is continuous in the state [m].
        steering_limits_rad: Rightmost and leftmost output, inside what the policy can express: wheel angle [rad], or turn
            rate [rad/s].
        output: Command of the expert: the wheel angle of a car with a wheelbase, or the turn rate of a Dubins car.
    """

    wheelbase_m: float = 0.25
    speed_mps: float = 0.8
    delay_s: float = 0.16
    stiffness_1pm: float = 1.0
    damping: float = 1.0
    max_approach_rad: float = 0.6
    feed_forward: float = 1.0
    smoothing_m: float = 0.24
    steering_limits_rad: tuple[float, float] = (-0.26, 0.29)
    output: Literal["wheel_angle", "turn_rate"] = "wheel_angle"

    def __post_init__(self) -> None:
        positive = (
            self.wheelbase_m,
            self.speed_mps,
            self.stiffness_1pm,
            self.damping,
            self.max_approach_rad,
            self.smoothing_m,
        )
        if not (min(positive) > 0.0 and self.delay_s >= 0.0 and 0.0 <= self.feed_forward <= 1.0):
            raise ValueError(
                f"expected positive expert settings, a delay >= 0 and a feed-forward of 0..1, got {self}"
            )
        if self.output not in ("wheel_angle", "turn_rate"):
            raise ValueError(f"expected an output of wheel_angle or turn_rate, got {self.output!r}")


class Expert:
    """Proportional-derivative path following with curvature feed-forward and delay preview.

    With lateral error ``e`` and heading error ``p``, per metre driven ``e' = sin p`` and ``p' = k - k_path``. The law
    ``k = k_path - 2 z w p - w^2 e`` gives a return of natural frequency ``w`` and damping ``z``; for large ``e`` the wanted
    heading saturates at ``max_approach_rad``. Errors and path curvature are taken at the car's predicted position after the delay.

    The steering is a continuous function of the pose alone, so that a policy can infer it from an image.

    Args:
        path: Reference path.
        config: Gains and limits.
    """

    def __init__(self, path: Path, config: ExpertConfig | None = None) -> None:
        self.path = path
        self.config = config or ExpertConfig()

    def steer(self, x_m: ArrayLike, y_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
        """Control ``[...]``, left positive, for rear-axle poses given as arrays ``[...]``: wheel angle [rad] or turn rate [rad/s]."""
        c = self.config
        x, y, yaw = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (x_m, y_m, yaw_rad)))
        at = self.path.project(np.stack([x, y], axis=-1))
        ahead = c.speed_mps * c.delay_s
        heading_error = wrap_angle(yaw - at.heading_rad)
        error = at.cte_m + ahead * np.sin(heading_error)
        wanted = -c.max_approach_rad * np.tanh(
            c.stiffness_1pm / (2.0 * c.damping) * error / c.max_approach_rad
        )
        feed_forward = c.feed_forward * self._parallel_curvature(
            at.s_m + ahead * np.cos(heading_error), at.cte_m
        )
        curvature = feed_forward - 2.0 * c.damping * c.stiffness_1pm * (heading_error - wanted)
        control = (
            np.arctan(c.wheelbase_m * curvature) if c.output == "wheel_angle" else c.speed_mps * curvature
        )
        return np.clip(control, *c.steering_limits_rad)

    def steer_states(self, states: ArrayLike) -> Array:
        """Control ``[...]`` for states ``[..., >= 3]``; see :meth:`steer`."""
        s = np.asarray(states, dtype=np.float64)
        return self.steer(s[..., 0], s[..., 1], s[..., 2])

    def to_dict(self) -> dict[str, Any]:
        """Settings and path as plain data, for manifests."""
        settings = asdict(self.config)
        # Left out if it is the default, so that older policies and training folders keep their hashes.
        if settings["output"] == "wheel_angle":
            del settings["output"]
        return {**settings, "path": self.path.to_dict()}

    def _parallel_curvature(self, s_m: Array, offset_m: Array) -> Array:
        """Path curvature, averaged over the smoothing length about ``s_m``, of the parallel curve at ``offset_m``."""
        half = 0.5 * self.config.smoothing_m
        turned = self.path.pose_at(s_m + half)[..., 2] - self.path.pose_at(s_m - half)[..., 2]
        mean = turned / (2.0 * half)
        # Inside a corner the parallel curve is tighter; near the corner's centre that would diverge.
        return np.asarray(mean / np.maximum(1.0 - offset_m * mean, 0.5), dtype=np.float64)
