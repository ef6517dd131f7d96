"""The checks of panels and meshes in a world's own scene: a world in another process passes, and each planted fault is found and named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from advnerf_core.geometry import make_transform, rotation_y, rotation_z
from hardware.worlds.world import Mesh, NativeMeshes, NativePanels, Panel, Rgb, WorldError
from nodes.lab.worlds.bench import Check, WorldBench
from nodes.lab.worlds.named import NamedWorld
from nodes.lab.worlds.panels import meshes_are_native, panels_are_native
from nodes.runtime.findings import NotMet
from tests.support.remote.flat_world import FlatConfig, FlatWorld
from tests.support.warehouse import Warehouse

pytestmark = pytest.mark.live


class Changed(FlatWorld):
    """Puts other panels into the scene than it was asked to."""

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        if rgb is not None:
            panel, rgb = self.changed(panel, rgb)
        super().add_panel(name, panel, rgb)

    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, rgb


def moved(panel: Panel, change: Any, width: float = 1.0, height: float = 1.0) -> Panel:
    return Panel(panel.T_world_from_face @ change, width * panel.width_m, height * panel.height_m)


class Mirrored(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, rgb[:, ::-1]


class UpsideDown(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, rgb[::-1]


class HalfATurn(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, rgb[::-1, ::-1]


class BlueFirst(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, rgb[..., ::-1]


class HalfSizes(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return moved(panel, np.eye(4), 2.0, 2.0), rgb


class WidthForHeight(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return Panel(panel.T_world_from_face, panel.height_m, panel.width_m), rgb


class OnItsLowerEdge(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return moved(panel, make_transform(np.eye(3), [0.0, 0.0, 0.5 * panel.height_m])), rgb


class FacesAway(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return moved(panel, make_transform(rotation_z(np.pi), [0.0, 0.0, 0.0])), rgb


class LiesDown(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return moved(panel, make_transform(rotation_y(-1.2), [0.0, 0.0, 0.0])), rgb


class OneColour(Changed):
    def changed(self, panel: Panel, rgb: Rgb) -> tuple[Panel, Rgb]:
        return panel, np.full_like(rgb, 200)


class Stays(Changed):
    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        if rgb is not None:
            super().add_panel(name, panel, rgb)


class KeepsTheColour(FlatWorld):
    """Draws all but the first in the colour of the first one's back."""

    def __init__(self, config: FlatConfig) -> None:
        super().__init__(config)
        self.names: list[str] = []

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        self.names = [each for each in self.names if each != name] + ([] if rgb is None else [name])
        super().add_panel(name, panel, rgb if rgb is None or self.names[0] == name else rgb // 5)


class OverThePicture(FlatWorld):
    """Draws the panel over what was rendered: depth does not know it, and nothing hides it."""

    knows_depth = False
    shown: tuple[Panel, Rgb] | None = None

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        self.shown = None if rgb is None else (panel, rgb)

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> Any:
        plain, depth_m = super().observe_at(x_m, y_m, yaw_rad, depth)
        if self.shown is None:
            return plain, depth_m
        super().add_panel("over", *self.shown)
        rgb, with_it = super().observe_at(x_m, y_m, yaw_rad, depth)
        super().add_panel("over", self.shown[0], None)
        return rgb, with_it if self.knows_depth else depth_m


class NothingHidesIt(OverThePicture):
    """Knows its depth, but lifts a panel that the ground would hide onto it."""

    knows_depth = True

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        low_m = panel.T_world_from_face[2, 3] - 0.5 * panel.height_m
        lifted = moved(panel, make_transform(np.eye(3), [0.0, 0.0, max(0.0, -low_m)]))
        super().add_panel(name, lifted, rgb)


def look(kind: type[FlatWorld], check: Check = panels_are_native) -> str:
    with kind(FlatConfig(width=224, height=126)) as world:
        named = NamedWorld("flat", kind, world.config, "")
        return check(WorldBench(named, world, world.describe(), None))


@pytest.mark.parametrize("check", [panels_are_native, meshes_are_native])
def test_a_world_that_takes_panels_and_meshes_says_how_well(check: Check) -> None:
    assert "the right way round" in look(FlatWorld, check)
    assert issubclass(FlatWorld, NativePanels)
    assert issubclass(FlatWorld, NativeMeshes)
    assert not issubclass(Warehouse, (NativePanels, NativeMeshes))


class OtherMeshes(FlatWorld):
    """Puts other meshes into the scene than it was asked to."""

    def add_mesh(self, name: str, mesh: Mesh | None) -> None:
        super().add_mesh(name, None if mesh is None else self.other(mesh))

    def other(self, mesh: Mesh) -> Mesh:
        return mesh


class TexturesFromBelow(OtherMeshes):
    def other(self, mesh: Mesh) -> Mesh:
        return replace(mesh, uv=mesh.uv * np.float32([1, -1]) + np.float32([0, 1]))


class MirroredTextures(OtherMeshes):
    def other(self, mesh: Mesh) -> Mesh:
        return replace(mesh, uv=mesh.uv * np.float32([-1, 1]) + np.float32([1, 0]))


class YUp(OtherMeshes):
    def other(self, mesh: Mesh) -> Mesh:
        return replace(mesh, corners_m=mesh.corners_m[..., [0, 2, 1]])


class InCentimetres(OtherMeshes):
    def other(self, mesh: Mesh) -> Mesh:
        return replace(mesh, corners_m=np.float32(100) * mesh.corners_m)


class InsideOut(OtherMeshes):
    def other(self, mesh: Mesh) -> Mesh:
        return replace(mesh, corners_m=mesh.corners_m[:, ::-1], uv=mesh.uv[:, ::-1])


def test_what_is_no_mesh_is_refused() -> None:
    corners = np.zeros((2, 3, 3), np.float32)
    texture = np.zeros((2, 2, 3), np.uint8)
    with pytest.raises(WorldError, match=r"expected uv \[2, 3, 2\] float32 of a mesh"):
        Mesh(corners, corners, corners, texture)
    with pytest.raises(WorldError, match="corners_m"):
        Mesh(corners * np.float32(np.nan), corners, corners[..., :2], texture)
    with pytest.raises(WorldError, match="expected a picture"):
        Mesh(corners, corners, corners[..., :2], texture.astype(np.float32))


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (Mirrored, "mirrored left to right"),
        (UpsideDown, "upside down"),
        (HalfATurn, "half a turn"),
        (BlueFirst, "red and blue exchanged"),
        (HalfSizes, "it is 1.9[0-9] times as large|it is 2.0[0-9] times as large"),
        (WidthForHeight, "width_m and height_m"),
        (OnItsLowerEdge, "too high"),
        (FacesAway, "nothing in the picture changed"),
        (LiesDown, "% of its outline is there"),
        (OneColour, "colours of the texture's quarters"),
        (Stays, "once a panel is taken out"),
        (KeepsTheColour, "whether or not another one was added before; got them [0-9]+ of 255 apart"),
        (OverThePicture, "the panel's depth"),
        (NothingHidesIt, "not over the picture"),
        (TexturesFromBelow, "upside down"),
        (MirroredTextures, "mirrored left to right"),
        (YUp, "its outline is there"),
        (InCentimetres, "its outline is there"),
        (InsideOut, "nothing in the picture changed"),
    ],
)
def test_a_planted_fault_is_found_and_named(fault: type[FlatWorld], told: str) -> None:
    with pytest.raises(NotMet, match=told):
        look(fault, meshes_are_native if issubclass(fault, OtherMeshes) else panels_are_native)
