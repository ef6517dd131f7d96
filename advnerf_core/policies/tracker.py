"""Trajectories as steering: a pure pursuit tracker (Coulter 1992), differentiable in the waypoints.

A waypoint is a point in metres in the car's frame: origin at the rear axle, x forward, y to the left. The front wheels are turned to the arc
through the point at the lookahead distance. It lies where the polygon of the waypoints leaves the circle of that radius.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from advnerf_core.policies.arrays import array_module, like
from advnerf_core.strict import StrictModel

_Positive = Annotated[float, Field(gt=0.0)]


class TrackedTrajectory(StrictModel):
    """An output of waypoints, and the tracker that follows them.

    Attributes:
        times_s: Time of each waypoint after the image [s], increasing.
        lookahead_m: Distance from the car at which the tracker meets the waypoints [m]; the last waypoint if they are nearer.
        wheelbase_m: Distance between the axles, for a car whose control is a wheel angle [m].
        car_speed_mps: Speed, for a car whose control is a turn rate [m/s].
    """

    times_s: tuple[_Positive, ...] = Field(min_length=1)
    lookahead_m: _Positive
    wheelbase_m: _Positive | None = None
    car_speed_mps: _Positive | None = None

    @model_validator(mode="after")
    def _times_increase(self) -> TrackedTrajectory:
        if any(second <= first for first, second in zip(self.times_s, self.times_s[1:], strict=False)):
            raise ValueError(f"times_s must increase; got {list(self.times_s)}")
        return self

    @model_validator(mode="after")
    def _one_kind_of_car(self) -> TrackedTrajectory:
        if (self.wheelbase_m is None) == (self.car_speed_mps is None):
            raise ValueError(
                "expected wheelbase_m of a car that is told a wheel angle, or car_speed_mps of one that is told a turn rate; give one of them"
            )
        return self

    def control(self, waypoints: Any) -> Any:
        """Wheel angle ``[B]`` [rad], or turn rate [rad/s], that leads to the waypoints ``[B, N, 2]`` (numpy or torch; differentiable)."""
        curvature_1pm = pursued_curvature_1pm(waypoints, self.lookahead_m)
        if self.wheelbase_m is None:
            return self.car_speed_mps * curvature_1pm
        return array_module(curvature_1pm).arctan(self.wheelbase_m * curvature_1pm)

    def speed_mps(self, waypoints: Any) -> Any:
        """Mean speed ``[B]`` [m/s] from the car to the last of the waypoints ``[B, N, 2]`` (numpy or torch)."""
        points = _from_the_car(waypoints)
        steps = points[:, 1:] - points[:, :-1]
        return ((steps * steps).sum(-1) ** 0.5).sum(-1) / self.times_s[-1]


def pursued_curvature_1pm(waypoints: Any, lookahead_m: float) -> Any:
    """Curvature ``[B]`` [1/m], left positive, of the arcs from the car to the `pursued_points`."""
    target = pursued_points(waypoints, lookahead_m)
    distance_m2 = (target * target).sum(-1)
    return 2.0 * target[:, 1] / (distance_m2 + (distance_m2 == 0.0))


def pursued_points(waypoints: Any, lookahead_m: float) -> Any:
    """Points ``[B, 2]`` [m] of the car's frame that the car is steered to.

    Args:
        waypoints: ``[B, N, 2]`` in metres in the car's frame (numpy or torch; differentiable).
        lookahead_m: Distance from the car at which the waypoints are met [m]; the last waypoint if they are nearer.
    """
    points = _from_the_car(waypoints)
    beyond = np.asarray(((points.detach() if hasattr(points, "detach") else points) ** 2).sum(-1).tolist())
    beyond = beyond >= lookahead_m**2
    found = beyond.any(axis=1)
    index = np.where(found, beyond.argmax(axis=1), points.shape[1] - 1).tolist()
    rows = list(range(len(points)))
    start, end = points[rows, [each - 1 for each in index]], points[rows, index]
    step = end - start
    # Where the piece leaves the circle: |start + share step| = lookahead. A short trajectory never does: its end is used, and the added
    # ones keep the derivative finite.
    short = like(points, 1.0 - found)
    a = (step * step).sum(-1) + short
    b, c = (start * step).sum(-1), (start * start).sum(-1) - lookahead_m**2
    share = (1.0 - short) * ((b * b - a * c + short) ** 0.5 - b) / a + short
    return start + share[:, None] * step


def _from_the_car(waypoints: Any) -> Any:
    """The waypoints with the car's position before them ``[B, N + 1, 2]``."""
    return array_module(waypoints).concatenate([0.0 * waypoints[:, :1], waypoints], 1)
