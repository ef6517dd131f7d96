"""Forms of what a world gives back, and a world of a user's own that is held to them at each call."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, cast

import numpy as np

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole, VehicleState
from advnerf_core.plugins import PluginError, in_one_line
from hardware.worlds.world import World, WorldClass, WorldDescription, members_of_a_world
from nodes.runtime.findings import NotMet, form_of


class OwnWorldError(NotMet, PluginError):
    """A world of a user's own has failed, or has given back something that no world may."""


def require_picture(rgb: Any, camera: Pinhole, name: str) -> None:
    """Raise `NotMet` unless an array is a picture of this camera."""
    expected = (camera.height, camera.width, 3)
    if not isinstance(rgb, np.ndarray) or rgb.shape != expected or rgb.dtype != np.uint8:
        raise NotMet(f"expected a picture {list(expected)} uint8 from {name}; got {form_of(rgb)}")
    if not rgb.flags.c_contiguous:
        raise NotMet(
            f"expected a contiguous picture from {name}; got a view with other strides; use numpy.ascontiguousarray"
        )


def require_depth_of(depth_m: Any, camera: Pinhole, name: str) -> None:
    """Raise `NotMet` unless an array is the planar depth of this camera's picture."""
    expected = (camera.height, camera.width)
    if not isinstance(depth_m, np.ndarray) or depth_m.shape != expected or depth_m.dtype != np.float32:
        raise NotMet(
            f"expected depth {list(expected)} float32 in metres; got {form_of(depth_m)} from {name}; convert it"
        )
    if not (depth_m > 0.0).all():
        least_m = np.nanmin(depth_m) if np.isfinite(depth_m).any() else np.nan
        raise NotMet(
            f"expected depth above 0, infinite where nothing is hit, from {name}; got values from {least_m:.3g} and {int(np.isnan(depth_m).sum())} NaN"
        )


def held_to_its_word(world_class: WorldClass, kind: str) -> WorldClass:
    """A world's class with the same behaviour, of which each member's error names the world, file and line, and each result is checked.

    Args:
        kind: The world's name, for messages.
    """
    return cast("WorldClass", _made(cast("Any", world_class), kind))


@lru_cache(maxsize=64)  # a world is made for each question about it
def _made(base: type[Any], kind: str) -> type[Any]:
    members: dict[str, Any] = {}
    for name in ("__init__", *members_of_a_world()):
        member = inspect.getattr_static(base, name, None)
        if isinstance(member, property):
            members[name] = property(_held(member.fget, kind, name))
        elif inspect.isfunction(member):
            members[name] = _held(member, kind, name)
    made = types.new_class(base.__name__, (base,), exec_body=lambda body: body.update(members))
    made.__module__ = base.__module__
    return made


def _held(member: Any, kind: str, name: str) -> Callable[..., Any]:
    require = _REQUIRED.get(name)

    @wraps(member)
    def call(world: Any, *args: Any, **named: Any) -> Any:
        try:
            given = member(world, *args, **named)
        except AdvnerfError:
            raise
        except Exception as error:
            raise OwnWorldError(f"world {kind}: {name} has failed: {in_one_line(error)}") from error
        if require is not None:
            try:
                require(world, given, name)
            except NotMet as wrong:
                raise OwnWorldError(f"world {kind}: {wrong}") from None
        return given

    return call


def _require_view(world: World, view: Any, name: str) -> None:
    if not isinstance(view, tuple) or len(view) != 2:
        raise NotMet(f"expected a pair of colours and depth from {name}; got {form_of(view)}")
    rgb, depth_m = view
    require_picture(rgb, world.camera_pinhole, name)
    if depth_m is not None:
        require_depth_of(depth_m, world.camera_pinhole, name)


def _require_photograph(world: World, rgb: Any, name: str) -> None:
    require_picture(rgb, world.photo_pinhole, name)


def _require_poses(_world: World, poses: Any, name: str) -> None:
    wanted = f"expected a list of poses [4, 4] with finite numbers from {name}, one for each photograph"
    count = len(poses) if isinstance(poses, list | tuple | np.ndarray) else 0
    if not count:
        raise NotMet(f"{wanted}; got {form_of(poses)} with {count} poses")
    for index, pose in enumerate(poses):
        if np.shape(pose) != (4, 4) or not np.isfinite(np.asarray(pose, dtype=float)).all():
            raise NotMet(f"{wanted}; got {np.asarray(pose).tolist()!s:.120} at {index}")


def _require_description(_world: World, described: Any, name: str) -> None:
    if not isinstance(described, WorldDescription):
        raise NotMet(f"expected a WorldDescription from {name}; got {form_of(described)}")


def _require_state(_world: World, state: Any, name: str) -> None:
    if not isinstance(state, VehicleState):
        raise NotMet(f"expected a VehicleState from {name}; got {form_of(state)}")
    if not np.isfinite([state.x_m, state.y_m, state.yaw_rad]).all():
        raise NotMet(f"expected a finite state of the car from {name}; got {state}")


_REQUIRED: dict[str, Callable[[World, Any, str], None]] = {
    "observe": _require_view,
    "observe_at": _require_view,
    "photograph": _require_photograph,
    "photo_poses": _require_poses,
    "describe": _require_description,
    "reset": _require_state,
    "step": _require_state,
    "state": _require_state,
}
