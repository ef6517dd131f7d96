"""The contract of a search space, and the spaces of colours and of meshes.

A space turns objects in a scene into a `Sensor` for the search, and turns the result into objects that can be written into an attack
file, put into a deployment, or driven past in the learned scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.artifact import (
    COLOURS,
    MESH_SHAPE,
    MESH_TEXTURE,
    AttackedObject,
    AttackFace,
    AttackFile,
    AttackFileError,
    face_texture,
)
from advnerf_core.attack.methods import METHODS, Method, MethodError, SearchRun, SearchSettings, load_method
from advnerf_core.attack.problem import AttackProblem, Sensor
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.display import DisplayModel
from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.glb import glb_bytes
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.plugins import PluginError, torch_left_as_it_is
from advnerf_core.scene.surrogate import Surrogate, split_theta


class SpaceError(AdvnerfError, ValueError):
    """The method does not search this space."""


@dataclass(frozen=True, eq=False)
class Shown:
    """Objects in a scene with their colours.

    Attributes:
        objects: Geometry and pose of each.
        colours: Their colours before squashing, of the ``theta_shape`` of a `Surrogate` with these objects.
        painted: Painted colours, if they differ from the seen ones in the place's light; None if they are equal.
    """

    objects: Sequence[ColouredObject]
    colours: Tensor
    painted: Tensor | None = None

    def seen_by(self, surrogate: Surrogate) -> Surrogate:
        """The surrogate with these objects instead of its own."""
        return surrogate.with_objects(self.objects)


@dataclass(frozen=True)
class NamedObject:
    """Entry of an object in attack files, besides its attacked parameters.

    Attributes:
        sha256: Hash of its geometry and fixed colours.
        marker_m: Side of the markers in its border [m]; None without one.
    """

    name: str
    sha256: str
    marker_m: float | None = None


@dataclass(frozen=True, eq=False)
class FaceMount:
    """What shows the texture of an object in the room.

    Attributes:
        subject: What carries it: the panel's name, which is also that of the motion-capture subject.
        size_m: Width and height [m].
        corners_in_subject: As of `advnerf_core.attack.artifact.AttackFace`, ``[4, 3]`` [m].
        number: Of the object.
    """

    subject: str
    size_m: tuple[float, float]
    corners_in_subject: Array
    number: int = 0

    def face(self, objects: Sequence[AttackedObject]) -> AttackFace:
        """The face that shows what was found."""
        texture = face_texture(objects[self.number].theta)
        return AttackFace(texture, self.size_m, self.subject, self.corners_in_subject, self.number)


def half_precision(theta: Tensor) -> Tensor:
    """Theta rounded to half precision, in its own type: drives use the theta that is stored."""
    largest = torch.finfo(torch.float16).max
    return theta.detach().clamp(-largest, largest).half().to(theta.dtype)


class Space(Protocol):
    """A search space."""

    @property
    def name(self) -> str:
        """Name in attack files: ``colours``, ``places``, ``mesh_texture``, ``mesh_shape``, or a user's own."""

    @property
    def surrogate(self) -> Surrogate:
        """The scene with the objects without an attack."""

    @property
    def sensor(self) -> Sensor:
        """The sensor of a search; its theta is the searched parameters."""

    @property
    def plain(self) -> Shown:
        """The objects without an attack."""

    def search(
        self, method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
    ) -> SearchResult:
        """Search the theta of the problem's sensor, which is this space's, with a method.

        Raises:
            SpaceError: The method does not search this space.
        """

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """The attacked objects of ``theta`` for an attack file."""

    @property
    def mount(self) -> FaceMount | None:
        """What shows the texture of an object in the room; None where nothing does."""

    def restored(self, attack: AttackFile) -> Shown:
        """The objects of an attack file, in their deployed form.

        Raises:
            AttackFileError: The attack belongs to other objects.
        """


def searched(
    method: Method, name: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
) -> SearchResult:
    """The result of a method's search, which spent no more than the budget: methods are compared by what they find with the same one.

    What a user's method returns is driven once more, on a problem that the method could not change.

    Raises:
        MethodError: It spent more, or returns something else, or its theta does not give its best evaluation.
    """
    if name in METHODS:
        return _in_form(method.search(problem, settings, run), problem, settings)
    own = replace(problem, start_states=problem.start_states.clone())
    try:
        with torch_left_as_it_is():
            returned = method.search(own, settings, run)
        found = _in_form(returned, problem, settings)
        require_driven(problem, found)
    except (MethodError, PluginError) as error:
        raise MethodError(f"attack method {name}: {error}") from None
    return found


def require_driven(problem: AttackProblem, found: SearchResult, within: float = 0.02) -> None:
    """Raise unless a drive past the theta of a result is its best evaluation. Disturbances are drawn for each drive: then nothing is compared.

    Args:
        within: Share by which the values may differ: a method may round its theta, and drives amplify that.

    Raises:
        MethodError: The drive gives another value.
    """
    if problem.disturbances is not None:
        return
    value = float(evaluate(problem, found.theta)[1].values.mean())
    if not math.isclose(value, found.best.value, rel_tol=within, abs_tol=1e-6):
        raise MethodError(
            f"expected theta to be that of the best evaluation, {found.best.value:.6g}, got one whose drive gives {value:.6g}; return the state's result(), "
            "evaluate by evaluate_theta, and leave the problem as it is"
        )


def _in_form(found: object, problem: AttackProblem, settings: SearchSettings) -> SearchResult:
    wanted, got = "a SearchResult with a tensor theta", type(found).__name__
    if isinstance(found, SearchResult) and isinstance(found.theta, Tensor):
        shape, count = tuple(problem.sensor.theta_shape), len(found.history)
        if tuple(found.theta.shape) == shape and 1 <= count <= settings.evaluations:
            return found
        wanted = f"theta {list(shape)} after 1 to {settings.evaluations} evaluations, which are the budget of every method"
        got = f"{list(found.theta.shape)} after {count}"
    raise MethodError(
        f"expected {wanted}, got {got}; correct it: 'advnerf attack method check' looks at all that a method must keep"
    )


def require_same(attack: AttackFile, named: Sequence[NamedObject]) -> None:
    """Raise for an attack file of other objects.

    Raises:
        AttackFileError: Another number of objects, or other geometry.
    """
    found, expected = [each.sha256 for each in attack.objects], [each.sha256 for each in named]
    if found != expected:
        raise AttackFileError(
            f"expected an attack on {', '.join(each.name for each in named)}, got attack {attack.attack_id} on "
            f"{', '.join(each.name for each in attack.objects)}, or on others of these names; search again"
        )


def colours_of(attack: AttackFile, dtype: torch.dtype) -> Tensor:
    """Colours of all objects of an attack file as one tensor ``[K, 3]``; of a single object in its own shape."""
    parts = [torch.from_numpy(np.array(each.theta)).to(dtype) for each in attack.objects]
    return parts[0] if len(parts) == 1 else torch.cat([part.reshape(-1, 3) for part in parts])


class ColourSpace:
    """Colours of objects with fixed places: voxels, faces, or textures of meshes.

    Args:
        named: What attack files say of them, in their order.
        light: What the camera sees of a painted colour, as measured, or of one that a monitor shows; None where it is seen as it is painted.
        cos_angle: Cosine of the angle at which the camera looks at a monitor; see `DisplayedSensor`.
        mount: What shows the texture of one of them.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        named: Sequence[NamedObject],
        light: DisplayModel | None = None,
        cos_angle: float = 1.0,
        mount: FaceMount | None = None,
    ) -> None:
        self.surrogate, self._named, self.mount = surrogate, tuple(named), mount
        self._lit = None if light is None else DisplayedSensor(surrogate, light, cos_angle)
        self.name = (
            MESH_TEXTURE if all(isinstance(each, MeshField) for each in surrogate.objects) else COLOURS
        )

    @property
    def sensor(self) -> Surrogate | DisplayedSensor:
        """The surrogate, behind the measured light if there is one: its theta is the painted colours."""
        return self._lit or self.surrogate

    @property
    def plain(self) -> Shown:
        """The objects in their own colours."""
        return self._in_light(self.surrogate.plain_theta())

    def search(
        self, method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
    ) -> SearchResult:
        """Search with any method; see `Space.search`."""
        return searched(load_method(method), method, problem, settings, run)

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """Colours of each object; for a mesh also the mesh with its attacked texture."""
        rows = zip(
            self._named, self.surrogate.objects, split_theta(self.surrogate.objects, theta), strict=True
        )
        return tuple(
            attacked_object(named, field, part, _textured_glb(field, part)) for named, field, part in rows
        )

    def restored(self, attack: AttackFile) -> Shown:
        """The objects at their places, in the colours of the file; see `Space.restored`."""
        require_same(attack, self._named)
        return self._in_light(colours_of(attack, self.surrogate.dtype))

    def _in_light(self, painted: Tensor) -> Shown:
        if self._lit is None:
            return Shown(self.surrogate.objects, painted)
        return Shown(self.surrogate.objects, self._lit.seen_theta(painted).detach(), painted)


class FaceSpace(ColourSpace):
    """Colours of a face, the only object, that hides its panel; without an attack the learned panel is seen."""

    @property
    def plain(self) -> Shown:
        """The learned scene without the face."""
        return Shown((), torch.zeros(0, 3, dtype=self.surrogate.dtype))

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """The shown colours; the size is that of the `AttackFace`."""
        return tuple(replace(each, size_m=None) for each in super().attacked(theta))

    def restored(self, attack: AttackFile) -> Shown:
        """The face in the seen colours, behind the display if there is one; see `Space.restored`."""
        found = super().restored(attack)
        attack.required_face()
        return replace(found, painted=None)


class ShapeSpace:
    """Shapes of meshes in their own colours.

    Args:
        named: Entries of the objects in attack files, in their order.
        limits: Largest displacement of vertices.
    """

    name, mount = MESH_SHAPE, None

    def __init__(self, surrogate: Surrogate, named: Sequence[NamedObject], limits: ShapeLimits) -> None:
        self.surrogate, self._named = surrogate, tuple(named)
        self.sensor = ShapeSensor(surrogate, limits)

    @property
    def plain(self) -> Shown:
        """The meshes in their own shape."""
        return Shown(self.surrogate.objects, self.sensor.colours)

    def search(
        self, method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
    ) -> SearchResult:
        """Search with a method that asks for the scale of theta; see `Space.search`."""
        found = load_method(method)
        if not found.reads_scale:
            raise SpaceError(
                f"expected a method that searches shapes, such as gradient or random, got {method}: its steps are those of colours"
            )
        return searched(found, method, problem, settings, run)

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """The search's parameters of each vertex, and the meshes in the attacked shape."""
        parts = theta.detach().split([len(each.mesh.vertices) for each in self.sensor.meshes])
        colours = split_theta(self.surrogate.objects, self.sensor.colours)
        rows = zip(self._named, self.sensor.shaped(theta), parts, colours, strict=True)
        return tuple(
            attacked_object(named, field, part, _textured_glb(field, colour))
            for named, field, part, colour in rows
        )

    def restored(self, attack: AttackFile) -> Shown:
        """The meshes in the shapes of the file; see `Space.restored`."""
        require_same(attack, self._named)
        theta = torch.cat([torch.from_numpy(np.array(each.theta)) for each in attack.objects])
        return Shown(self.sensor.shaped(theta), self.sensor.colours)


def attacked_object(
    named: NamedObject, field: ColouredObject, part: Tensor, glb: bytes = b""
) -> AttackedObject:
    """An object of an attack file with its attacked parameters."""
    theta = part.detach().numpy().astype(np.float32)
    size_m = field.face_size_m if isinstance(field, VoxelGridObject) else None
    return AttackedObject(
        named.name,
        theta,
        field.T_world_from_object,
        field.scale,
        named.sha256,
        glb,
        size_m,
        named.marker_m,
    )


def _textured_glb(field: ColouredObject, colours: Tensor) -> bytes:
    """A mesh in its colours as a GLB file; empty for other objects."""
    return glb_bytes(field.mesh.with_texture(field.texture(colours))) if isinstance(field, MeshField) else b""
