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
from advnerf_core.plugins import FAILURES, PluginError, in_one_line, is_signal
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
        if inspect.isfunction(member) and isinstance(inspect.getattr_static(World, name, None), property):
            raise OwnWorldError(
                f"world {kind}: expected {name} to be a value or a property; got a method, which counts as true; write @property above it"
            )
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
        # A world that writes into a pose would move it for whoever asked.
        args = tuple(each.copy() if isinstance(each, np.ndarray) else each for each in args)
        try:
            given = member(world, *args, **named)
        except AdvnerfError:
            raise
        except FAILURES as error:
            if isinstance(error, SystemExit) and is_signal(error.code):
                raise
            raise OwnWorldError(f"world {kind}: {name} has failed: {in_one_line(error)}") from error
        if require is not None:
            try:
                require(world, given, name)
            except NotMet as wrong:
                raise OwnWorldError(f"world {kind}: {wrong}") from None
        # True would hide the errors of who uses the world.
        return None if name == "__exit__" else given

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
    if not np.isfinite([state.x_m, state.y_m, state.yaw_rad, state.speed_mps]).all():
        raise NotMet(f"expected a finite state of the car from {name}; got {state}")


def _require_opened(_world: World, opened: Any, name: str) -> None:
    if not callable(getattr(opened, "describe", None)):
        raise NotMet(f"expected {name} to return the world; got {form_of(opened)}; end it with return self")


def _require_yes_or_no(_world: World, answer: Any, name: str) -> None:
    if not isinstance(answer, bool | np.bool_):
        raise NotMet(f"expected True or False from {name}; got {form_of(answer)}")


_REQUIRED: dict[str, Callable[[World, Any, str], None]] = {
    "__enter__": _require_opened,
    "blocked": _require_yes_or_no,
    "observe": _require_view,
    "observe_at": _require_view,
    "photograph": _require_photograph,
    "photo_poses": _require_poses,
    "describe": _require_description,
    "reset": _require_state,
    "step": _require_state,
    "state": _require_state,
}
