"""Frames at given states, rendered again with other textures.

Geometry and background of a frame cost most of its render and do not depend on theta; a search that queries a policy about many textures
from the same places keeps them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import RenderCache
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.rollout import Rollout, drive
from advnerf_core.scene.device_surrogate import DeviceFrames, DeviceSurrogate
from advnerf_core.scene.surrogate import PoseBatch, Rendered, Surrogate


class Visited:
    """The frames of some ticks, rendered for any number of thetas.

    A disturbed problem, or a sensor that cannot keep frames, renders each time again: the same images, more slowly.

    Args:
        states: ``[ticks * B, n]``, ordered by tick.
    """

    def __init__(self, problem: AttackProblem, ticks: Sequence[int], states: Tensor) -> None:
        self._problem, self._ticks, self._states = problem, tuple(ticks), states.clone()
        self._frames: PoseBatch | DeviceFrames | None = None
        if problem.disturbances is None and isinstance(problem.sensor, Surrogate | DeviceSurrogate):
            self._frames = problem.sensor.prepare(problem.sensor.camera_poses(states))

    @property
    def nbytes(self) -> int:
        """Memory that the kept part holds [bytes]."""
        if self._frames is None:
            return 0
        return self._frames.background.nbytes + self._frames.weights_nbytes

    def render(self, theta: Tensor) -> Rendered:
        """Images with this theta."""
        if self._frames is None:
            return self._problem.sense(self._ticks, self._states, theta)
        return self._frames.render(theta)

    def forget(self) -> None:
        """Free the memory; later renders start from the beginning."""
        self._frames = None


class VisitedDrive:
    """A closed loop that was driven with ``theta``, and its frames by tick.

    Half of the problem's cache budget is for frames without colours, half for the first gradient's renders.

    Attributes:
        cache: Renders with ``theta``, for ``gradient_pass``.
    """

    def __init__(self, problem: AttackProblem, theta: Tensor) -> None:
        self._frames: list[Visited] = []
        self.cache = RenderCache(problem.cache_bytes // 2)
        self._problem = problem
        kept_bytes = 0

        def observe(states: Tensor) -> Tensor:
            nonlocal kept_bytes
            tick = len(self._frames)
            frames = Visited(problem, (tick,), states)
            rendered = frames.render(theta)
            kept_bytes += frames.nbytes
            if kept_bytes > problem.cache_bytes // 2:
                frames.forget()
            self._frames.append(frames)
            self.cache.offer(tick, rendered)
            return rendered.images

        self.rollout: Rollout = drive(
            problem.policy, observe, problem.dynamics, problem.start_states, problem.steps, problem.goals
        )

    def images(self, theta: Tensor) -> Tensor:
        """Images ``[T, B, 3, H, W]`` at the visited states with another theta."""
        return torch.stack([frames.render(theta).images for frames in self._frames])
