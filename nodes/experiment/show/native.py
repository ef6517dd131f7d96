"""Panels in a world's own scene: its renderer lights, shades and occludes them, and no picture is composed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.artifact import TEXTURE_PX, face_texture
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import split_theta
from hardware.worlds.world import NativePanels, Panel, Rgb, World
from nodes.experiment.show.deployed import Dressed, DressedScene
from nodes.runtime.errors import ConfigError

# Name, pose and texture of each panel.
_Shown = tuple[tuple[str, bytes, bytes], ...]
# Current panels of each open world, which several `NativeScene` may share.
_STANDING: WeakKeyDictionary[Any, _Shown] = WeakKeyDictionary()


def stand_in(view: PolicyView, scene: World, objects: Sequence[ColouredObject], native: bool) -> Dressed:
    """An open deployment scene with objects in it: composed by depth, or as panels of the world's own scene.

    Raises:
        ConfigError: The world takes no panels.
    """
    return (NativeScene if native else DressedScene)(scene, view, objects)


class NativeScene:
    """A deployment scene whose own renderer shows the attacked panels: `nodes.experiment.show.deployed.Dressed`.

    Args:
        scene: The open scene.
        view: The policy's view of its camera.
        panels: Faces from `cube_face_object`, at their places; none removes all.

    Raises:
        ConfigError: The world takes no panels, or an object is not a panel.
    """

    def __init__(self, scene: World, view: PolicyView, panels: Sequence[ColouredObject]) -> None:
        if not isinstance(scene, NativePanels):
            raise ConfigError(
                f"expected a world that takes panels (add_panel) with carrier.kind native, got {type(scene).__name__}; "
                "set carrier.kind=composed"
            )
        self.scene: World = scene
        self.view, self._native = view, scene
        self._fields = tuple(panels)
        self._panels = [_panel_of(field) for field in panels]
        self._plain = DressedScene(scene, view, panels).plain_theta()
        self._shown: tuple[Tensor, _Shown] | None = None

    def plain_theta(self) -> Tensor:
        """The panels' own colours."""
        return self._plain

    def prepare(self, states: Array) -> Array:
        """The states ``[B, 3]`` themselves: the world renders each picture on request."""
        return np.asarray(states, dtype=np.float64)

    def policy_images(self, frames: Any, theta: Tensor | None) -> Rgb:
        """Policy images ``[B, 66, 200, 3]`` from car states."""
        return np.stack([self.view.image(self.camera_image(state, theta)) for state in frames])

    def seen_now(self, theta: Tensor | None) -> Rgb:
        """Policy image ``[66, 200, 3]`` at the car's current pose."""
        self._show(theta)
        return self.view.image(self.scene.observe(depth=False)[0])

    def camera_image(self, state: Array, theta: Tensor | None) -> Rgb:
        """The whole camera image ``[H, W, 3]`` from a car state ``[3]``."""
        self._show(theta)
        x_m, y_m, yaw_rad = map(float, state[:3])
        return self.scene.observe_at(x_m, y_m, yaw_rad, depth=False)[0]

    def paint(self, rgb: Rgb, state: Array, theta: Tensor) -> Rgb:
        """The whole camera image with the panels in these colours; it is rendered again, as only the world models its light."""
        del rgb
        return self.camera_image(state, theta)

    def _show(self, theta: Tensor | None) -> None:
        """Make the world show the panels in these colours, in plain ones for None, unless it does already."""
        colours = self._plain if theta is None else theta.detach()
        standing = _STANDING.get(self.scene, ())
        # Every tick of a drive asks for the same colours; their textures are painted once.
        if self._shown is not None and self._shown[1] is standing and torch.equal(self._shown[0], colours):
            return
        textures = [face_texture(part.numpy(), TEXTURE_PX) for part in split_theta(self._fields, colours)]
        wanted: _Shown = tuple(
            (f"panel{number}", panel.T_world_from_face.tobytes(), texture.tobytes())
            for number, (panel, texture) in enumerate(zip(self._panels, textures, strict=True))
        )
        for name, *_ in standing[len(wanted) :]:
            self._native.add_panel(name, Panel(np.eye(4), 1.0, 1.0), None)
        for entry, panel, texture in zip(wanted, self._panels, textures, strict=True):
            if entry not in standing:
                self._native.add_panel(entry[0], panel, texture)
        _STANDING[self.scene] = wanted
        self._shown = colours.clone(), wanted


def _panel_of(field: ColouredObject) -> Panel:
    if not isinstance(field, VoxelGridObject) or field.face_size_m is None:
        raise ConfigError(
            "expected panels with carrier.kind native, got a solid object; set carrier.kind=composed"
        )
    return Panel(np.array(field.T_world_from_object), *field.face_size_m)
