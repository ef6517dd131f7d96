"""Measures whether the adjoint is right, and useful, for this scene, this policy and these objects. It judges nothing.

The adjoint promises the derivative of the rollout with every camera pose frozen; finite differences confirm this here.
The true closed loop, in which images follow the states, is compared for information: it is chaotic, and the method
does not claim its derivative.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import (
    AdjointResult,
    RenderCache,
    adjoint_gradient,
    evaluate,
    gradient_pass,
    roll_out,
)
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.rollout import Remembering, Rollout
from advnerf_core.geometry import Array
from advnerf_core.scene.surrogate import Rendered, Surrogate

# Controls within this share of the steering range of its end count as saturated: they cannot increase further.
_SATURATED = 1e-3


def frozen_loss(problem: AttackProblem, theta: Tensor, rollout: Rollout) -> float:
    """Loss of the rollout for ``theta`` with all images taken at the poses of ``rollout``, under the same draws."""
    policy = Remembering.afresh(problem.policy, len(problem.start_states))
    with torch.no_grad():
        states = [problem.start_states]
        for tick, nominal in enumerate(rollout.states[:-1]):
            images = problem.sense((tick,), nominal, theta).images
            controls = policy(images, problem.goals)
            states.append(problem.dynamics.step(states[-1], controls.to(states[-1].dtype)))
        loss = float(problem.losses(torch.stack(states)).mean())
    return loss + (0.0 if problem.regulariser is None else problem.regulariser(theta)[0])


def closed_loss(problem: AttackProblem, theta: Tensor) -> float:
    """Loss of the true closed loop for ``theta``, under the same draws."""
    _, totals = evaluate(problem, theta)
    loss = float(totals.losses.mean())
    return loss + (0.0 if problem.regulariser is None else problem.regulariser(theta)[0])


def random_directions(theta: Tensor, count: int, seed: int = 0) -> Tensor:
    """Directions ``[count, *theta.shape]`` of unit length."""
    generator = torch.Generator().manual_seed(seed)
    raw = torch.randn((count, *theta.shape), generator=generator, dtype=torch.float64)
    return (raw / raw.flatten(1).norm(dim=1).reshape(-1, *[1] * theta.ndim)).to(theta.dtype)


def central_slopes(loss: Callable[[Tensor], float], theta: Tensor, directions: Tensor, step: float) -> Array:
    """Derivatives of a loss along directions by central differences, ``[count]``."""
    slopes = [(loss(theta + step * d) - loss(theta - step * d)) / (2.0 * step) for d in directions]
    return np.array(slopes)


def slopes_of(gradient: Tensor, directions: Tensor) -> Array:
    """The same derivatives by a gradient."""
    slopes: Array = (directions * gradient).flatten(1).sum(1).double().numpy()
    return slopes


def relative_error(got: Array, expected: Array) -> float:
    """Norm of the difference over the norm of the expected values; infinite if only the expected values are zero."""
    difference, size = float(np.linalg.norm(got - expected)), float(np.linalg.norm(expected))
    return difference / size if size > 0.0 else (0.0 if difference == 0.0 else float("inf"))


def cosine(a: Array, b: Array) -> float:
    """Cosine between two vectors; 0 if one vanishes."""
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0


@dataclass(frozen=True)
class TickHealth:
    """Diagnostics of a nominal rollout at each tick, means over the starts.

    Attributes:
        lambda_position: Norm of the adjoint's position part at ticks 0..T [unit of the objective per m].
        lambda_yaw: Magnitude of its yaw part at ticks 0..T [unit of the objective per rad].
        saturated: Share of the starts whose steering is at or beyond its limits, at ticks 0..T-1.
        visible: Share of the starts that see an object, at ticks 0..T-1; empty if the sensor cannot say.
    """

    lambda_position: tuple[float, ...]
    lambda_yaw: tuple[float, ...]
    saturated: tuple[float, ...]
    visible: tuple[float, ...]


def tick_health(problem: AttackProblem, result: AdjointResult) -> TickHealth:
    """Norms of lambda, saturation and visibility over time."""
    # The loss is a mean over the starts, and so are its adjoints: multiply by their number, so that it does not matter.
    lambdas = result.lambdas.double() * len(problem.start_states)
    visible: tuple[float, ...] = ()
    if isinstance(problem.sensor, Surrogate):
        probe = torch.zeros(problem.sensor.theta_shape, dtype=problem.start_states.dtype)
        visible = tuple(_share_that_sees(problem, states, probe) for states in result.rollout.states[:-1])
    return TickHealth(
        tuple(lambdas[:, :, :2].norm(dim=2).mean(1).tolist()),
        tuple(lambdas[:, :, 2].abs().mean(1).tolist()),
        saturated_shares(problem, result.rollout.controls),
        visible,
    )


def _share_that_sees(problem: AttackProblem, states: Tensor, probe: Tensor) -> float:
    """A start sees an object where its image changes with theta."""
    first, second = (problem.sensor.sense(states, probe + shift).images for shift in (0.0, 1.0))
    return float((first != second).flatten(1).any(1).double().mean())


def saturated_shares(problem: AttackProblem, controls: Tensor) -> tuple[float, ...]:
    """Share of starts at each tick whose control is at a limit of the dynamics or of the policy's own range."""
    limits: Any = getattr(problem.dynamics, "steering_limits_rad", None)
    reach: Any = getattr(problem.policy, "max_steering_rad", None)
    beyond = torch.zeros_like(controls, dtype=torch.bool)
    if limits is not None:
        beyond |= (controls <= limits[0]) | (controls >= limits[1])
    if reach is not None:
        beyond |= controls.abs() >= (1.0 - _SATURATED) * reach
    return tuple(beyond.double().mean(1).tolist())


@dataclass(frozen=True)
class TimeSplit:
    """Time of one loss with its gradient, by part [s].

    Attributes:
        render_s: Rendering, including frames that were not kept.
        drive_s: The rest of the rollout: the policy one tick at a time, and the dynamics.
        backward_s: The policy forward and backward in time batches, and the lambdas.
        vjp_s: From gradients of images to the gradient of theta.
        frames: Frames of the rollout.
    """

    render_s: float
    drive_s: float
    backward_s: float
    vjp_s: float
    frames: int

    @property
    def gradient_pass_s(self) -> float:
        """Extra time of the gradient beyond the rollout if all frames are kept."""
        return self.backward_s + self.vjp_s


class _TimedSensor:
    """A sensor that adds up the time of its renders and of their vjp."""

    def __init__(self, inner: Any) -> None:
        self._inner, self.theta_shape = inner, inner.theta_shape
        self.render_s = self.vjp_s = 0.0

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        theta: Tensor = self._inner.initial_theta(generator)
        return theta

    def camera_poses(self, states: Tensor) -> Array:
        poses: Array = self._inner.camera_poses(states)
        return poses

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        return self._timed(lambda: self._inner.sense(states, theta))

    def render(self, T_world_from_camera: Array, theta: Tensor) -> Rendered:
        return self._timed(lambda: self._inner.render(T_world_from_camera, theta))

    def _timed(self, render: Callable[[], Rendered]) -> Rendered:
        began = time.perf_counter()
        rendered = render()
        self.render_s += time.perf_counter() - began

        def vjp(grad: Tensor) -> Tensor:
            start = time.perf_counter()
            out = rendered.vjp(grad)
            self.vjp_s += time.perf_counter() - start
            return out

        return replace(rendered, vjp=vjp)


def time_split(problem: AttackProblem, theta: Tensor) -> tuple[TimeSplit, AdjointResult]:
    """Time one loss with its gradient by part; one tick runs first, so that kernels are compiled."""
    adjoint_gradient(replace(problem, steps=1), theta)
    sensor = _TimedSensor(problem.sensor)
    timed, cache = replace(problem, sensor=sensor), RenderCache(problem.cache_bytes)
    began = time.perf_counter()
    rollout, memories = roll_out(timed, theta, cache)
    rolled, rendered_s = time.perf_counter(), sensor.render_s
    result = gradient_pass(timed, theta, rollout, cache, memories)
    again_s, pass_s = sensor.render_s - rendered_s, time.perf_counter() - rolled
    split = TimeSplit(
        sensor.render_s,
        rolled - began - rendered_s,
        pass_s - again_s - sensor.vjp_s,
        sensor.vjp_s,
        problem.steps * len(problem.start_states),
    )
    return split, result
