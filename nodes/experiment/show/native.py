"""Objects in a world's own scene: its renderer lights, shades and occludes them, and no picture is composed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.attack.artifact import TEXTURE_PX, face_texture
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.skin import skin_of
from advnerf_core.objects.mesh.surface import TexturedMesh, corner_normals
from advnerf_core.objects.voxel.mesh import SurfaceMesh
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import split_theta
from hardware.worlds.world import Mesh, NativeMeshes, NativePanels, Panel, Rgb, World
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed, DressedScene
from nodes.experiment.show.objects import surface_of
from nodes.experiment.show.standing import Standing, make_stand, standing_in
from nodes.runtime.errors import ConfigError


def stand_in(
    experiment: Experiment, scene: World, objects: Sequence[ColouredObject], native: bool
) -> Dressed:
    """An open deployment scene with all objects of the experiment, or none: composed by depth, or, if ``native``, in the world's own scene.

    Raises:
        ConfigError: The world does not take them.
    """
    if not native:
        return DressedScene(scene, experiment.view, objects)
    things = experiment.objects if objects else ()
    surfaces = [
        surface_of(thing.kind) if _is_solid(field) else None
        for thing, field in zip(things, objects, strict=True)
    ]
    return NativeScene(scene, experiment.view, objects, surfaces)


class NativeScene(Dressed):
    """A deployment scene whose own renderer shows the attacked objects.

    Args:
        objects: The objects, at their places; none removes all.
        surfaces: The mesh that each object of voxels was made of, None for panels and meshes; empty if there are only these.

    Raises:
        ConfigError: The world takes no such objects, or the mesh of one of voxels is not given.
    """

    def __init__(
        self,
        scene: World,
        view: PolicyView,
        objects: Sequence[ColouredObject],
        surfaces: Sequence[SurfaceMesh | None] = (),
    ) -> None:
        self.scene, self.view = scene, view
        self._fields = tuple(objects)
        self._things = [
            _thing(scene, field, surface)
            for field, surface in zip(objects, surfaces or [None] * len(objects), strict=True)
        ]
        self._plain = DressedScene(scene, view, objects).plain_theta()
        self._shown: tuple[Tensor, tuple[Standing, ...]] | None = None

    def plain_theta(self) -> Tensor:
        """The objects' own colours."""
        return self._plain

    def seen_now(self, theta: Tensor | None) -> Rgb:
        """See `Dressed.seen_now`."""
        self._show(theta)
        return self.view.image(self.scene.observe(depth=False)[0])

    def camera_image(self, state: Array, theta: Tensor | None) -> Rgb:
        """See `Dressed.camera_image`."""
        self._show(theta)
        x_m, y_m, yaw_rad = map(float, state[:3])
        return self.scene.observe_at(x_m, y_m, yaw_rad, depth=False)[0]

    def _show(self, theta: Tensor | None) -> None:
        """Make the world show the objects in these colours, in plain ones for None, unless it does already."""
        colours = self._plain if theta is None else theta.detach()
        # Every tick of a drive asks for the same colours; their textures are painted once.
        if (
            self._shown is not None
            and self._shown[1] is standing_in(self.scene)
            and torch.equal(self._shown[0], colours)
        ):
            return
        parts = split_theta(self._fields, colours)
        textures = [thing.texture(part) for thing, part in zip(self._things, parts, strict=True)]
        wanted = [
            Standing(f"object{number}", thing.is_mesh, thing.shape, texture.tobytes())
            for number, (thing, texture) in enumerate(zip(self._things, textures, strict=True))
        ]
        stands = make_stand(
            self.scene,
            wanted,
            lambda number: self._things[number].put(wanted[number].name, textures[number]),
        )
        self._shown = colours.clone(), stands


@dataclass(frozen=True, eq=False)
class _Board:
    """A panel."""

    scene: NativePanels
    panel: Panel
    is_mesh: ClassVar[bool] = False

    @property
    def shape(self) -> bytes:
        """All that it depends on except its colours."""
        size = (self.panel.width_m, self.panel.height_m)
        return np.asarray(self.panel.T_world_from_face).tobytes() + np.array(size).tobytes()

    def texture(self, colours: Tensor) -> Rgb:
        """Its texture ``[h, w, 3]`` in these colours."""
        return face_texture(colours.numpy(), TEXTURE_PX)

    def put(self, name: str, texture: Rgb) -> None:
        """Put it into the scene."""
        self.scene.add_panel(name, self.panel, texture)


@dataclass(frozen=True, eq=False)
class _Solid:
    """A mesh."""

    scene: NativeMeshes
    field: ColouredObject
    mesh: TexturedMesh
    colours: Callable[[Tensor], NDArray[np.float32]]
    is_mesh: ClassVar[bool] = True

    @property
    def shape(self) -> bytes:
        """All that it depends on except its colours."""
        return self._corners.tobytes()

    def texture(self, colours: Tensor) -> Rgb:
        """Its texture ``[h, w, 3]`` in these colours."""
        return np.rint(255.0 * np.clip(self.colours(colours), 0.0, 1.0)).astype(np.uint8)

    def put(self, name: str, texture: Rgb) -> None:
        """Put it into the scene. Both sides of each triangle are shown: not all meshes are wound outwards."""
        self.scene.add_mesh(name, Mesh(*self._both_sides, texture))

    @cached_property
    def _both_sides(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Corners, normals and places in the texture, of fronts and backs."""
        height, width = self.mesh.texture.shape[:2]
        normals = (corner_normals(self.mesh) @ self.field.T_world_from_object[:3, :3].T).astype(np.float32)
        uv = (self.mesh.texels / [width, height]).astype(np.float32)
        return (
            np.concatenate([self._corners, self._corners[:, ::-1]]),
            np.concatenate([normals, -normals[:, ::-1]]),
            np.concatenate([uv, uv[:, ::-1]]),
        )

    @cached_property
    def _corners(self) -> NDArray[np.float32]:
        """Corners of the triangles in the world ``[F, 3, 3]`` [m]."""
        T = self.field.T_world_from_object
        return (self.field.scale * self.mesh.corners @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def _refused(what: str, scene: World) -> str:
    return f"expected a world that takes {what} with carrier.kind native, got {type(scene).__name__}; set carrier.kind=composed"


def _is_solid(field: ColouredObject) -> bool:
    """Whether an object is made of voxels and is no panel."""
    return isinstance(field, VoxelGridObject) and field.face_size_m is None


def _thing(scene: World, field: ColouredObject, surface: SurfaceMesh | None) -> _Board | _Solid:
    if isinstance(field, VoxelGridObject) and field.face_size_m is not None:
        if not isinstance(scene, NativePanels):
            raise ConfigError(_refused("panels (add_panel)", scene))
        return _Board(scene, Panel(np.array(field.T_world_from_object), *field.face_size_m))
    if not isinstance(scene, NativeMeshes):
        raise ConfigError(_refused("meshes (add_mesh)", scene))
    if isinstance(field, MeshField):
        return _Solid(scene, field, field.mesh, field.texture)
    if surface is None or not isinstance(field, VoxelGridObject):
        raise ConfigError(
            "expected panels, or objects whose meshes are known, with carrier.kind native, got a solid object without one; "
            "set carrier.kind=composed"
        )
    skin = skin_of(field, surface)
    return _Solid(scene, field, skin.mesh, partial(skin.texture, field))
