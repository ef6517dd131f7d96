"""What an experiment needs of the place where a found attack is tried: a car, a camera with depth, and photographs.

The simulated room (`hardware.worlds.lab.lab.Lab`), the simulated intersection (`hardware.worlds.junction.scene.Intersection`)
and any other simulator fit it, so that one loop drives in all of them. Right-handed axes, world z up, metres, radians,
seconds.
"""

from __future__ import annotations

from types import TracebackType
from typing import Literal, Protocol, overload, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, VehicleState

Rgb = NDArray[np.uint8]
Depth = NDArray[np.float32]


@runtime_checkable
class DeploymentScene(Protocol):
    """A scene with one car in it that is observed and driven step by step; time passes only in ``step``.

    The same configuration and the same calls give the same results.

    Attributes:
        camera_pinhole: Intrinsics of the driving camera.
        photo_pinhole: Intrinsics of the camera of ``photograph``.
    """

    camera_pinhole: Pinhole
    photo_pinhole: Pinhole

    @property
    def T_car_from_camera(self) -> Array:
        """Where the driving camera sits on the car ``[4, 4]``."""
        ...

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        ...

    @property
    def blocked(self) -> bool:
        """Whether the car stands against something or at the end of the world."""
        ...

    def reset(self, x_m: float, y_m: float, yaw_rad: float, /) -> VehicleState:
        """Put the car down at rest; commands under way are forgotten."""
        ...

    def step(self, control: float, speed_mps: float, duration_s: float, /) -> VehicleState:
        """Send one command and let time pass.

        Args:
            control: Wheel angle of a steered car [rad], or turn rate of a Dubins car [rad/s]; left positive.
            speed_mps: Commanded speed [m/s].
            duration_s: Time to the next observation [s].
        """
        ...

    @overload
    def observe(self, depth: Literal[True] = True) -> tuple[Rgb, Depth]: ...
    @overload
    def observe(self, depth: Literal[False]) -> tuple[Rgb, None]: ...
    def observe(self, depth: bool = True) -> tuple[Rgb, Depth | None]:
        """What the driving camera sees: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None if not wanted."""
        ...

    @overload
    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: Literal[True] = True) -> tuple[Rgb, Depth]: ...
    @overload
    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: Literal[False]) -> tuple[Rgb, None]: ...
    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> tuple[Rgb, Depth | None]:
        """What the driving camera would see from another pose of the car (see :meth:`observe`); the car stays where it is."""
        ...

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with ``photo_pinhole``, for learning the scene."""
        ...

    def close(self) -> None:
        """Free what the scene holds; safe to call twice."""
        ...

    def __enter__(self) -> DeploymentScene: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
