"""Sources of training frames: a scene that steps itself (lab, simulator) or a batch renderer (surrogate).

Both offer the same two calls: stills at given states, and closed-loop drives for DAgger. Each state is seen with the object
plain and, if it is in view, with random textures too. No simulator and no renderer is imported here; they are passed as callables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.driving.dynamics import Motion
from advnerf_core.driving.path import Array
from advnerf_core.geometry import VehicleState
from advnerf_core.policies.network import images_to_tensor, tensor_to_images
from advnerf_core.policies.view import Image, PolicyView

Steer = Callable[[Image], Array]
"""Steering ``[B]`` [rad] for policy images ``[B, 66, 200, 3]`` uint8."""

KeepDriving = Callable[[Array], NDArray[np.bool_]]
"""Which of the states ``[B, 3]`` are still worth driving on from, ``[B]``."""

Overlay = Callable[[Image, Array, Any], Image]
"""``(rgb [H, W, 3], state [3], texture) -> rgb`` with the object showing a texture parameter; the same image if it is out of view."""


@dataclass(frozen=True)
class PolicyImages:
    """Policy images of some states.

    Attributes:
        images: ``[M, 66, 200, 3]`` uint8.
        states: ``[M, 3]`` state of each image.
        textured: ``[M]`` bool: the object showed a random texture.
    """

    images: Image
    states: Array
    textured: NDArray[np.bool_]

    @staticmethod
    def join(parts: list[PolicyImages]) -> PolicyImages:
        """Concatenate parts, in order."""
        return PolicyImages(
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.states for part in parts]),
            np.concatenate([part.textured for part in parts]),
        )


class FrameSource(Protocol):
    """A domain that frames can be taken from."""

    name: str
    batch_size: int  # preferred number of states, or drives, per call

    def look(self, states: Array, rng: np.random.Generator) -> PolicyImages:
        """Images from the states ``[B, 3]``."""

    def drive(
        self, steer: Steer, starts: Array, steps: int, keep_driving: KeepDriving, rng: np.random.Generator
    ) -> PolicyImages:
        """Closed-loop drives of up to ``steps`` ticks from ``starts [B, 3]``: all images on the way."""


class SteppedScene(Protocol):
    """A deployment scene that moves its own car, such as the synchronous lab."""

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> Any:
        """Put the car down."""

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Drive on and return the true state."""

    def observe(self, depth: bool) -> tuple[Image, Any]:
        """RGB ``[H, W, 3]`` uint8 of the driving camera, without depth."""

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool) -> tuple[Image, Any]:
        """The same, with the car at this pose."""


class SceneSource:
    """Frames of a scene that steps itself.

    Args:
        scene: The scene, for instance the synchronous lab.
        view: Conversion of camera images to policy images.
        speed_mps: Commanded speed [m/s].
        dt_s: Control tick [s].
        overlay: Shows the object with a texture parameter; None for scenes without a changing object.
        sample_texture: Draws a texture parameter for ``overlay``; needed with it.
    """

    batch_size = 1

    def __init__(
        self,
        name: str,
        scene: SteppedScene,
        view: PolicyView,
        speed_mps: float,
        dt_s: float,
        overlay: Overlay | None = None,
        sample_texture: Callable[[np.random.Generator], Any] | None = None,
    ) -> None:
        if (overlay is None) != (sample_texture is None):
            raise ValueError("expected overlay and sample_texture together, got one of them")
        self.name = name
        self._scene, self._view, self._overlay = scene, view, overlay
        self._speed_mps, self._dt_s = speed_mps, dt_s
        self._sample = sample_texture

    def look(self, states: Array, rng: np.random.Generator) -> PolicyImages:
        """Images from the states ``[B, 3]``."""
        parts = []
        for state in states:
            x, y, yaw = map(float, state)
            parts.append(self._seen(self._scene.observe_at(x, y, yaw, depth=False)[0], state, rng))
        return PolicyImages.join(parts)

    def drive(
        self, steer: Steer, starts: Array, steps: int, keep_driving: KeepDriving, rng: np.random.Generator
    ) -> PolicyImages:
        """Drives, one after another; in every second one the policy sees one random texture throughout."""
        parts = []
        for number, start in enumerate(starts):
            held = self._sample(rng) if self._sample is not None and number % 2 else None
            self._scene.reset(*map(float, start))
            state = np.asarray(start, dtype=np.float64)
            for _ in range(steps):
                parts.append(self._seen(self._scene.observe(depth=False)[0], state, rng, held))
                steering = float(
                    steer(parts[-1].images[-1:] if held is not None else parts[-1].images[:1])[0]
                )
                moved = self._scene.step(steering, self._speed_mps, self._dt_s)
                state = np.array([moved.x_m, moved.y_m, moved.yaw_rad])
                if not keep_driving(state[None])[0]:
                    break
        return PolicyImages.join(parts)

    def _seen(self, rgb: Image, state: Array, rng: np.random.Generator, held: Any = None) -> PolicyImages:
        """The plain view, and after it the one with the held texture, or with a drawn one; none where the object is out of view."""
        images = [self._view.image(rgb)]
        if self._overlay is not None and self._sample is not None:
            drawn = self._sample(rng)  # also beside a held one: later draws do not depend on it
            painted = self._overlay(rgb, state, drawn if held is None else held)
            if not np.array_equal(painted, rgb):
                images.append(self._view.image(painted))
        return PolicyImages(
            np.stack(images), np.tile(state[:3], (len(images), 1)), np.arange(len(images)) > 0
        )


Show = Callable[[Any], Tensor]
"""Images ``[B, 3, 66, 200]`` RGB 0..1 of prepared states with a texture parameter, or with None for the plain object."""


class RenderedSource:
    """Frames of a batch renderer, such as the surrogate.

    Args:
        prepare: Takes states ``[B, 3]``, renders everything that does not depend on the texture (the background), returns ``Show``.
        sample_texture: Draws a texture parameter for ``Show``; None for scenes without a changing object.
        batch_size: States per call of ``prepare``, and drives side by side.
    """

    def __init__(
        self,
        name: str,
        prepare: Callable[[Array], Show],
        dynamics: Motion,
        sample_texture: Callable[[np.random.Generator], Any] | None = None,
        batch_size: int = 8,
    ) -> None:
        self.name, self.batch_size = name, batch_size
        self._prepare, self._dynamics, self._sample = prepare, dynamics, sample_texture

    def look(self, states: Array, rng: np.random.Generator) -> PolicyImages:
        """Images from the states ``[B, 3]``."""
        return self._seen(states, rng, None)[0]

    def drive(
        self, steer: Steer, starts: Array, steps: int, keep_driving: KeepDriving, rng: np.random.Generator
    ) -> PolicyImages:
        """Drives side by side; the odd ones see one random texture throughout."""
        held = None if self._sample is None else self._sample(rng)
        states = torch.zeros(len(starts), self._dynamics.state_size, dtype=torch.float64)
        states[:, :3] = torch.from_numpy(np.asarray(starts, dtype=np.float64))
        odd = np.arange(len(starts)) % 2 == 1
        parts = []
        for _ in range(steps):
            seen, plain, painted = self._seen(states[:, :3].numpy(), rng, held)
            parts.append(seen)
            steering = steer(np.where(odd[:, None, None, None], painted, plain))
            states = self._dynamics.step(states, torch.from_numpy(np.asarray(steering, dtype=np.float64)))
            keep = keep_driving(states[:, :3].numpy())
            states, odd = states[torch.from_numpy(keep)], odd[keep]
            if not len(states):
                break
        return PolicyImages.join(parts)

    def _seen(self, states: Array, rng: np.random.Generator, held: Any) -> tuple[PolicyImages, Image, Image]:
        """Plain and (where they differ) textured views; and per state the plain view and the view with the held texture."""
        show = self._prepare(states)
        plain = tensor_to_images(show(None))
        painted = plain if held is None else tensor_to_images(show(held))
        drawn = plain if self._sample is None else tensor_to_images(show(self._sample(rng)))
        images, rows, textured = [], [], []
        for row in range(len(states)):
            in_view = not np.array_equal(drawn[row], plain[row])
            images += [plain[row], drawn[row]] if in_view else [plain[row]]
            rows += [row] * (1 + in_view)
            textured += [False, True] if in_view else [False]
        return PolicyImages(np.stack(images), states[rows].copy(), np.array(textured)), plain, painted


def steer_with(policy: Any, goals: Tensor | None = None) -> Steer:
    """A policy as a function of uint8 images, for drives; ``goals [1, G]`` holds for all."""

    def steer(images: Image) -> Array:
        with torch.no_grad():
            repeated = None if goals is None else goals.expand(len(images), -1)
            steering: Tensor = policy(images_to_tensor(images), repeated)
        return steering.double().numpy()

    return steer
