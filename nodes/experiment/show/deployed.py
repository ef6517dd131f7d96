"""The deployment: the car's camera images when opaque objects stand in a scene that gives colours and depth.

Works with any `World`: per pixel the nearer of scene and object wins (the paper, section 4), in the camera's own pixels, and
only then is the image cropped and resized for the policy.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.driving.dynamics import Motion
from advnerf_core.driving.metrics import DriveMetrics, Horizon, drive_metrics
from advnerf_core.driving.path import Path
from advnerf_core.driving.rollout import Remembering, drive
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array, Pinhole, planar_poses
from advnerf_core.learning.sources import Show
from advnerf_core.policies.network import Policy, images_to_tensor, tensor_to_images
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import PoseBatch, Surrogate
from hardware.cameras.effects import ImperfectCamera
from hardware.worlds.world import Rgb, World, collided_with, require_depth
from nodes.experiment.show.standing import bare_views, clear

# At a camera's own resolution a rasteriser takes one ray per pixel; the policy's resize averages three of them.
_SUPERSAMPLE = 1


class Dressed(ABC):
    """An attacked deployment scene, as the policy sees it; here the scene renders every picture on request."""

    scene: World
    view: PolicyView

    @abstractmethod
    def plain_theta(self) -> Tensor | None:
        """Parameters of the objects without an attack."""

    def prepare(self, states: Array) -> Any:
        """Prepare everything of the policy's view from car states ``[B, 3]`` that does not depend on the attack; time does not pass."""
        return np.asarray(states, dtype=np.float64)

    def policy_images(self, frames: Any, theta: Tensor | None) -> NDArray[np.uint8]:
        """Policy images ``[B, 66, 200, 3]`` of prepared views."""
        return np.stack([self.view.image(self.camera_image(state, theta)) for state in frames])

    def seen_now(self, theta: Tensor | None) -> NDArray[np.uint8]:
        """Policy image ``[66, 200, 3]`` at the car's current pose."""
        state = self.scene.state
        return self.view.image(self.camera_image(np.array([state.x_m, state.y_m, state.yaw_rad]), theta))

    @abstractmethod
    def camera_image(self, state: Array, theta: Tensor | None) -> NDArray[np.uint8]:
        """The whole camera image ``[H, W, 3]`` from a car state ``[3]``."""

    def paint(self, rgb: Rgb, state: Array, theta: Tensor) -> NDArray[np.uint8]:
        """A camera image ``[H, W, 3]`` with the attack, from one without it from the same state ``[3]``; rendered again, as that image has no depth."""
        del rgb
        return self.camera_image(state, theta)


def seen_in(scene: Dressed) -> Callable[[Array], Show]:
    """A function that prepares the views from car states ``[B, 3]``, and returns a function from an attack to policy images."""

    def seen(states: Array) -> Show:
        frames = scene.prepare(states)
        return lambda theta: images_to_tensor(scene.policy_images(frames, theta))

    return seen


class DressedScene(Dressed):
    """A deployment scene with the attack's objects in it, as the policy sees it.

    Args:
        scene: The scene without objects.
        objects: The objects, opaque; none for the empty scene. As in the learned scene, only surfaces nearer than they are by
            `Surrogate.depth_tolerance_m` hide them: 0.15 m, so that they do not flicker where they touch the ground.
    """

    def __init__(self, scene: World, view: PolicyView, objects: Sequence[ColouredObject]) -> None:
        self.scene, self.view = scene, view
        self._window, self._whole = (
            Surrogate(
                self._observed,
                pinhole,
                scene.T_car_from_camera,
                objects,
                supersample=_SUPERSAMPLE,
                opaque=True,
            )
            for pinhole in (view.window_pinhole, view.camera)
        )

    def plain_theta(self) -> Tensor:
        """The objects' own colours."""
        return self._window.plain_theta()

    def prepare(self, states: Array) -> PoseBatch:
        """See `Dressed.prepare`."""
        return self._window.prepare(
            self._window.camera_poses(torch.from_numpy(np.asarray(states, dtype=np.float64)))
        )

    def policy_images(self, frames: PoseBatch, theta: Tensor | None) -> NDArray[np.uint8]:
        """See `Dressed.policy_images`."""
        shown = self._window.plain_theta() if theta is None and self._window.objects else theta
        return np.stack([self._resized(image) for image in tensor_to_images(frames.render(shown).images)])

    def seen_now(self, theta: Tensor | None) -> NDArray[np.uint8]:
        """See `Dressed.seen_now`."""
        clear(self.scene)
        rgb, depth_m = require_depth(self.scene.observe())
        window = self.view.window
        state = self.scene.state
        pose = planar_poses(np.array([[state.x_m, state.y_m, state.yaw_rad]])) @ self.scene.T_car_from_camera
        image = self._window.overlay(
            rgb[window][None] / np.float32(255.0), depth_m[window][None], pose, theta
        )
        return self._resized(tensor_to_images(image)[0])

    def camera_image(self, state: Array, theta: Tensor | None) -> NDArray[np.uint8]:
        """See `Dressed.camera_image`."""
        poses = self._whole.camera_poses(torch.from_numpy(np.asarray(state, dtype=np.float64))[None])
        return tensor_to_images(self._whole.render(poses, theta).images)[0]

    def _resized(self, window: NDArray[np.uint8]) -> NDArray[np.uint8]:
        resized = cv2.resize(window, (self.view.width, self.view.height), interpolation=cv2.INTER_AREA)
        return np.asarray(resized, dtype=np.uint8)

    def _observed(self, poses: Array, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
        """The scene as a background renderer: the part of the camera image within the pinhole."""
        top, left = round(self.view.camera.cy - pinhole.cy), round(self.view.camera.cx - pinhole.cx)
        kept = slice(top, top + pinhole.height), slice(left, left + pinhole.width)
        seen = [(rgb[kept], depth_m[kept]) for rgb, depth_m in bare_views(self.scene, poses)]
        rgb, depth_m = (torch.from_numpy(np.stack(each)) for each in zip(*seen, strict=True))
        return rgb / 255.0, depth_m


class SelfDriving:
    """A scene's own car as the dynamics of a rollout: one car, whose true state is read back."""

    state_size = 3

    def __init__(self, scene: World, speed_mps: float, dt_s: float) -> None:
        self.scene, self.speed_mps, self.dt_s = scene, speed_mps, dt_s
        self.blocked_tick: int | None = None
        self._tick = 0

    def start(self, pose: Array) -> None:
        """Put the car down."""
        self.scene.reset(*map(float, pose[:3]))
        self.blocked_tick, self._tick = None, 0

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """Drive for one tick; the given state ``[1, 3]`` must be the last returned one."""
        moved = self.scene.step(float(controls[0]), self.speed_mps, self.dt_s)
        self._tick += 1
        if self.scene.blocked and self.blocked_tick is None:
            self.blocked_tick = self._tick
        return states.new_tensor([[moved.x_m, moved.y_m, moved.yaw_rad]])


class IdealDriving:
    """The surrogate's car in a scene that is only rendered: it follows its commands exactly, and only the fence stops it.

    Args:
        fence_m: Beyond this abs(x) or abs(y) the car counts as blocked [m]; None without a fence.
    """

    def __init__(self, dynamics: Motion, fence_m: float | None) -> None:
        self.state_size = dynamics.state_size
        self.blocked_tick: int | None = None
        self._dynamics, self._fence_m, self._tick = dynamics, fence_m, 0

    def start(self, pose: Array) -> None:
        """Begin a drive."""
        self.blocked_tick, self._tick = None, 0

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """Drive for one tick from states ``[1, n]``."""
        moved = self._dynamics.step(states, controls)
        self._tick += 1
        outside = self._fence_m is not None and bool((moved[0, :2].abs() > self._fence_m).any())
        if outside and self.blocked_tick is None:
            self.blocked_tick = self._tick
        return moved


@dataclass(frozen=True, eq=False)
class DeployedDrive:
    """One drive in the deployment scene.

    Attributes:
        states: True states ``[T + 1, 3]``.
        controls: Commands of the policy ``[T]``.
        blocked_tick: Tick of a collision; None without one.
        collided_with: Name of the obstacle; None without a collision.
    """

    states: Array
    controls: Array
    metrics: DriveMetrics
    blocked_tick: int | None
    collided_with: str | None = None


Seen = Callable[[Array], NDArray[np.uint8]]
"""Policy image ``[66, 200, 3]`` from the state ``[3]`` of the car that drives."""


def _ideally(dressed: Dressed, theta: Tensor | None, car: SelfDriving | IdealDriving) -> Seen:
    """Policy images of an ideal camera; the world renders from its own car's pose, not from where that should be."""
    if isinstance(car, SelfDriving):
        return lambda state: dressed.seen_now(theta)
    return lambda state: dressed.policy_images(dressed.prepare(state[None]), theta)[0]


def _through(camera: ImperfectCamera, dressed: Dressed, theta: Tensor | None, dt_s: float) -> Seen:
    """Policy images through a camera, tick by tick; a lost frame repeats the one before."""
    last: list[NDArray[np.uint8]] = []

    def seen(state: Array) -> NDArray[np.uint8]:
        picture = camera.see(lambda pose: dressed.camera_image(pose, theta), state, dt_s)
        if picture is not None:
            last[:] = [dressed.view.image(picture)]
        return last[0]

    return seen


def drive_deployed(
    dressed: Dressed,
    policy: Policy,
    goal: Sequence[float],
    start: Array,
    path: Path,
    limits: Horizon,
    car: SelfDriving | IdealDriving,
    theta: Tensor | None,
    camera: ImperfectCamera | None = None,
) -> DeployedDrive:
    """Drive once through the attacked scene, tick by tick.

    Args:
        goal: Goal vector; empty without a goal.
        start: Pose ``[3]``.
        theta: The objects' colours; None for no objects.
        camera: Imperfect camera; None for an ideal one.
    """
    car.start(np.asarray(start))
    goals = torch.tensor([tuple(goal)], dtype=torch.float32) if goal else None
    first = torch.from_numpy(np.array(start, dtype=np.float64))[None]
    seen = _ideally(dressed, theta, car) if camera is None else _through(camera, dressed, theta, limits.dt_s)
    driver = Remembering.afresh(policy, 1)
    rollout = drive(
        driver, lambda states: images_to_tensor(seen(states[0].numpy())), car, first, limits.ticks, goals
    )
    states = rollout.states[:, 0].numpy().copy()
    states[:, 2] = np.unwrap(states[:, 2])
    metrics = drive_metrics(path, states, limits, car.blocked_tick)
    hit = None if car.blocked_tick is None else collided_with(dressed.scene, states[car.blocked_tick])
    return DeployedDrive(
        states, rollout.controls[:, 0].double().numpy(), metrics, car.blocked_tick, collided_with=hit
    )
