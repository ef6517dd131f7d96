"""What worlds show in their own scenes now. Several presentations of one experiment may share an open world, and each asks for its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, yaw_of
from advnerf_core.policies.view import PolicyView
from hardware.worlds.world import Depth, NativeMeshes, NativePanels, Panel, Rgb, World, require_depth


class Standing(NamedTuple):
    """An object in a world's own scene.

    Attributes:
        is_mesh: Whether it is a mesh; else it is a panel.
        shape: Everything that it depends on except its colours.
    """

    name: str
    is_mesh: bool
    shape: bytes
    texture: bytes


# By open world. What is written here stands there, also after a change that failed half-way.
_STANDING: WeakKeyDictionary[Any, tuple[Standing, ...]] = WeakKeyDictionary()


def standing_in(world: World) -> tuple[Standing, ...]:
    """The objects in a world's own scene; the same tuple as long as nothing changes."""
    takes = isinstance(world, (NativePanels, NativeMeshes))
    return _STANDING.get(world, ()) if takes else ()


def make_stand(world: World, wanted: Sequence[Standing], put: Callable[[int], None]) -> tuple[Standing, ...]:
    """Have these objects in a world's own scene, and no others; returns what `standing_in` says from now on.

    ``put`` puts one of them there, by its number, in place of the one of its name.
    """
    standing = list(standing_in(world))
    names = {each[:2] for each in wanted}
    for each in [one for one in standing if one[:2] not in names]:
        _take_out(world, each)
        standing.remove(each)
        _STANDING[world] = tuple(standing)
    for number, each in enumerate(wanted):
        if each not in standing:
            put(number)
            standing = [one for one in standing if one[:2] != each[:2]] + [each]
            _STANDING[world] = tuple(standing)
    _STANDING[world] = tuple(wanted)
    return _STANDING[world]


def clear(world: World) -> None:
    """Take out all that was put into a world's own scene."""
    if standing_in(world):
        make_stand(world, (), lambda number: None)


def bare_views(world: World, poses: Array) -> Iterator[tuple[Rgb, Depth]]:
    """Pictures and depth [m] of a world without anything put into it, at camera poses ``[B, 4, 4]`` of a car on the ground; time does not pass."""
    clear(world)
    for pose in poses @ np.linalg.inv(world.T_car_from_camera):
        yield require_depth(world.observe_at(float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose)))


class DeployedFrames:
    """A background renderer (`advnerf_core.scene.surrogate.BackgroundRenderer`): the policy's view of a scene without objects.

    Attacks are rendered over its pictures without a learned scene, and time does not pass. Colours are resized as in the policy's
    view; of the depths under a pixel the middle one is taken, as a mean of near and far belongs to no surface.
    """

    def __init__(self, scene: World, view: PolicyView) -> None:
        self.scene, self.view = scene, view

    def __call__(self, poses: Array, pinhole: Pinhole) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours ``[B, H, W, 3]`` in 0..1 and planar depth ``[B, H, W]`` [m] at camera poses ``[B, 4, 4]`` of a car on the ground."""
        if pinhole != self.view.pinhole:
            raise ValueError(f"expected the camera of the policy's view, {self.view.pinhole}, got {pinhole}")
        size = (self.view.width, self.view.height)
        rgb, depth_m = [], []
        for image, depth in bare_views(self.scene, poses):
            rgb.append(self.view.image(image))
            depth_m.append(cv2.resize(depth[self.view.window], size, interpolation=cv2.INTER_NEAREST_EXACT))
        return np.stack(rgb).astype(np.float32) / np.float32(255.0), np.stack(depth_m).astype(np.float32)


def _take_out(world: World, thing: Standing) -> None:
    if thing.is_mesh:
        assert isinstance(world, NativeMeshes), "it took the mesh"
        world.add_mesh(thing.name, None)
    else:
        assert isinstance(world, NativePanels), "it took the panel"
        world.add_panel(thing.name, Panel(np.eye(4), 1.0, 1.0), None)
