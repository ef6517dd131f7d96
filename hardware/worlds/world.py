"""The contract of a place that can be driven: a world has a car, a camera with depth, photographs, and a description for an experiment.

The simulated junction (`hardware.worlds.junction.scene.Intersection`) and a junction of a CARLA map (`hardware.worlds.carla.scene.CarlaScene`)
are worlds; your own world is one class in one file (docs/worlds.md), and ``advnerf scene world check`` checks it against this contract.

Axes are right-handed, the world's z points up; metres, radians, seconds. Cameras have OpenCV axes: x right, y down, z forward. The car's frame lies on
the ground under the point whose x, y and heading are its state, x forward, y left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, Pinhole, VehicleState
from advnerf_core.plain import Numbers, PlainData
from advnerf_core.unit_bounds import MOST_LENGTH_M, MOST_SPEED_MPS
from hardware.worlds.footprints import Footprint
from hardware.worlds.paths import ReferencePath

Rgb = NDArray[np.uint8]
Depth = NDArray[np.float32]
Vector3 = tuple[float, float, float]
_MOST_TURN_RADPS = 20.0
_WIDEST_M = 20.0
View = tuple[Rgb, Depth | None]
"""Colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None where depth was not wanted."""


class WorldError(AdvnerfError, ValueError):
    """A world's description, or a stored one, is not usable."""


class NotOpenError(AdvnerfError, RuntimeError):
    """The world must be open for this call, that is between ``__enter__`` and ``__exit__``."""


@dataclass(frozen=True)
class CarDescription(PlainData):
    """The car as an attack models it: without the lag and errors that the world's own car may have.

    Attributes:
        kind: ``dubins``: a control is a turn rate [rad/s]; ``ackermann``: it is a wheel angle [rad]. Left is positive in both.
        speed_mps: Speed of all drives [m/s].
        control_limits: Rightmost and leftmost control.
        wheelbase_m: Distance between the axles of an ``ackermann`` car [m]; the state's point is its rear axle.
    """

    kind: Literal["dubins", "ackermann"]
    speed_mps: float
    control_limits: tuple[float, float]
    wheelbase_m: float | None = None

    def __post_init__(self) -> None:
        """Raise for a car that cannot drive."""
        right, left = self.control_limits
        if self.kind not in ("dubins", "ackermann") or not (
            0.0 < self.speed_mps < np.inf and -np.inf < right < left < np.inf
        ):
            raise WorldError(
                f"expected a dubins or ackermann car, a speed above 0 m/s, and limits right < left; got {self}"
            )
        if (self.kind == "ackermann") != (self.wheelbase_m is not None and self.wheelbase_m > 0.0):
            raise WorldError(
                f"expected wheelbase_m > 0 for an ackermann car, and none for a dubins car; got {self}"
            )
        self._require_units()

    def _require_units(self) -> None:
        """Raise for numbers that no car has, and that a car has in other units."""
        most_control = 0.5 * np.pi if self.kind == "ackermann" else _MOST_TURN_RADPS
        for name, value, most, unit, mistaken in (
            ("speed_mps", self.speed_mps, MOST_SPEED_MPS, "m/s", "km/h or mm/s"),
            ("wheelbase_m", self.wheelbase_m or 0.0, MOST_LENGTH_M, "m", "cm or mm"),
            ("control_limits", self.largest_control, most_control, self.control_unit, "degrees"),
        ):
            if value > most:
                raise WorldError(f"{name}: expected at most {most:.5g} {unit}, not {mistaken}; got {value:g}")

    @property
    def largest_control(self) -> float:
        """Largest control to either side: turn rate [rad/s] or wheel angle [rad]."""
        return max(map(abs, self.control_limits))

    @property
    def control_unit(self) -> str:
        """Unit of a control."""
        return "rad/s" if self.kind == "dubins" else "rad"


@dataclass(frozen=True)
class Box(PlainData):
    """The learned part of the world.

    Attributes:
        min_m: Low corner [m].
        max_m: High corner [m].
        contraction: Whether there is more to see outside the box, such as a town and its sky, which is then learned with less detail. Otherwise
            the box holds everything that any camera sees.
    """

    min_m: Vector3
    max_m: Vector3
    contraction: bool = False

    def __post_init__(self) -> None:
        """Refuse an empty box."""
        if not (np.isfinite([self.min_m, self.max_m]).all() and np.all(np.less(self.min_m, self.max_m))):
            raise WorldError(
                f"expected a box with finite corners, min_m below max_m; got {self.min_m} and {self.max_m}"
            )


@dataclass(frozen=True, eq=False)
class Panel(PlainData):
    """A flat rectangle in the world that can carry a texture: a board, or a screen.

    Attributes:
        T_world_from_face: Frame ``[4, 4]`` at its centre: x out of it towards a viewer, z up.
        width_m: Width of the panel [m].
        height_m: Height of the panel [m].
        screen_px: Width and height [px] of a screen, which shows pictures by itself (`Screens.show`); None for a board.
    """

    T_world_from_face: Numbers
    width_m: float
    height_m: float
    screen_px: tuple[int, int] | None = None

    @property
    def square_m(self) -> float:
        """Side of the largest square in the panel's middle [m]."""
        return min(self.width_m, self.height_m)


@dataclass(frozen=True, eq=False)
class WorldDescription(PlainData):
    """A world's description for an experiment, as plain data: stored beside the photographs, and read where the world is not open.

    Attributes:
        paths: Paths to drive, by name; all goals have the same length.
        off_track_m: Cross-track error beyond which the car has left its lane [m]: half a lane's width.
        car: The car.
        camera: Intrinsics of the driving camera.
        T_car_from_camera: Pose ``[4, 4]`` of the driving camera on the car.
        box: The learned part of the world.
        lanes: Middles of the lanes that objects must keep clear of: at least the paths, which are the default.
        road_edge: Lines ``[N, 2]`` [m] where the road ends, for drawings.
        panels: Boards and screens that can carry a texture, by name.
        fence_m: The car is stopped where abs(x) or abs(y) exceeds this [m]; None without a fence.
        facts: JSON data that the results depend on and that neither the configuration nor the rest of the description has, such as which
            junction a server found.
    """

    _refusal = WorldError
    paths: Mapping[str, ReferencePath]
    off_track_m: float
    car: CarDescription
    camera: Pinhole
    T_car_from_camera: Numbers
    box: Box
    lanes: tuple[ReferencePath, ...] = ()
    road_edge: tuple[Numbers, ...] = ()
    panels: Mapping[str, Panel] = field(default_factory=dict)
    fence_m: float | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        if not self.paths:
            raise WorldError("expected at least one path; got none")
        if len({len(path.goal) for path in self.paths.values()}) != 1:
            goals = ", ".join(f"{name} {list(path.goal)}" for name, path in self.paths.items())
            raise WorldError(f"expected goals of one length; got {goals}")
        if not 0.0 < self.off_track_m <= _WIDEST_M:
            raise WorldError(
                f"expected off_track_m, half a lane, of more than 0 and at most {_WIDEST_M:g} m; got {self.off_track_m}; it is in metres"
            )
        T = np.asarray(self.T_car_from_camera, dtype=np.float64)
        if (
            T.shape != (4, 4)
            or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
            or np.linalg.det(T) < 0.0
        ):
            raise WorldError(f"expected T_car_from_camera to be a rigid transform [4, 4]; got {T.tolist()}")
        if not self.lanes:
            object.__setattr__(self, "lanes", tuple(self.paths.values()))


@runtime_checkable
class World(Protocol):
    """A place with one car in it that is observed and driven step by step; time passes only in ``step``.

    Use it as a context manager: ``__enter__`` opens renderers and servers, so that construction is cheap. The same configuration and the same
    calls give the same results.

    Its class has an attribute ``Config``, a pydantic model or a dataclass, and is called with one: ``Intersection(Intersection.Config())``. All of the
    configuration counts as something that results depend on, except fields with ``exclude=True``, such as a server's address or time limits.
    """

    @property
    def camera_pinhole(self) -> Pinhole:
        """Intrinsics of the driving camera."""
        ...

    @property
    def photo_pinhole(self) -> Pinhole:
        """Intrinsics of the camera of ``photograph``."""
        ...

    @property
    def T_car_from_camera(self) -> Array:
        """Pose ``[4, 4]`` of the driving camera on the car."""
        ...

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        ...

    @property
    def blocked(self) -> bool:
        """Whether the car stands against something or at the end of the world."""
        ...

    def describe(self) -> WorldDescription:
        """The world's description; the same every time.

        Raises:
            NotOpenError: The world must be opened first, such as one that asks a server for its map. Others may be described without being opened.
        """
        ...

    def photo_poses(self, count: int, rng: np.random.Generator, /) -> list[Array]:
        """Poses of the photographs for learning: ``count`` transforms ``T_world_from_camera`` ``[4, 4]``, mixed so that any prefix covers the paths."""
        ...

    def reset(self, x_m: float, y_m: float, yaw_rad: float, /) -> VehicleState:
        """Put the car down at rest; commands under way are forgotten."""
        ...

    def step(self, control: float, speed_mps: float, duration_s: float, /) -> VehicleState:
        """Send one command and let time pass.

        Args:
            control: Wheel angle of an ``ackermann`` car [rad], or turn rate of a ``dubins`` car [rad/s]; left positive.
            speed_mps: Commanded speed [m/s].
            duration_s: Time to the next observation [s].
        """
        ...

    def observe(self, depth: bool = True) -> View:
        """View of the driving camera: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None if not wanted."""
        ...

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> View:
        """The driving camera's view from another pose of the car (see :meth:`observe`); the car does not move."""
        ...

    def photograph(self, T_world_from_camera: Array, /) -> Rgb:
        """A photograph ``[H, W, 3]`` with ``photo_pinhole``, for learning the scene; in the driving camera's colours, unless its traits say otherwise."""
        ...

    def __enter__(self) -> World: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...


class WorldClass(Protocol):
    """The class behind a world's name, which is called with its configuration.

    Attributes:
        Config: A pydantic model or a dataclass; all of its fields have defaults.
    """

    Config: Any

    def __call__(self, config: Any, /) -> World:
        """The world, not open yet."""
        ...


@dataclass(frozen=True)
class Traits:
    """Properties of a world that are known before it is opened. A world without the attribute ``traits`` has these defaults.

    Attributes:
        unseen: Keys of the configuration (``car.turn_rate_lag_s``) that change how the world's own car moves, and neither a picture nor the
            description: what was captured and learned stays valid when they change.
        exclusive: Whether only one may be open at a time, such as a server that steps one world.
        step_s: Every step is a whole multiple of this [s]; None for any duration.
        own_photo_colours: Whether ``photograph`` has other colours than the driving camera, as a phone has: an experiment then fits a colour map between them.
    """

    unseen: tuple[str, ...] = ()
    exclusive: bool = False
    step_s: float | None = None
    own_photo_colours: bool = False


@runtime_checkable
class Overview(Protocol):
    """A world with a view from above, for reports."""

    def overview(self) -> tuple[Rgb, Pinhole, Array]:
        """A picture ``[H, W, 3]``, and the camera that took it: its intrinsics and ``T_world_from_camera`` ``[4, 4]``."""
        ...


@runtime_checkable
class NamesObstacles(Protocol):
    """A world that names what its car ran into."""

    def touches(self, x_m: float, y_m: float, yaw_rad: float, /) -> str:
        """Name of what the car stands against at a pose, such as ``wall``; empty if nothing is near."""
        ...


@runtime_checkable
class HasSolids(Protocol):
    """A world that lists what its car can run into, open or not: the objective ``collision`` needs it."""

    @property
    def car_body(self) -> Footprint:
        """The car's body where its state is x = y = yaw = 0."""
        ...

    @property
    def solids(self) -> Sequence[Footprint]:
        """Obstacles of the car, walls included."""
        ...


def require_depth(view: View) -> tuple[Rgb, Depth]:
    """A view that must have depth.

    Raises:
        WorldError: The view has no depth.
    """
    rgb, depth_m = view
    if depth_m is None:
        raise WorldError(
            "expected colours and depth; got no depth. Make the world's observe and observe_at return both"
        )
    return rgb, depth_m


@dataclass(frozen=True, eq=False)
class Photograph:
    """A stored photograph.

    Attributes:
        T_world_from_camera: Pose ``[4, 4]`` of the camera.
        look: Reads the photograph: colours ``[h, w, 3]``, undistorted, and their intrinsics.
        valid: Reads which of its pixels ``[h, w]`` are learned from; None if all are.
    """

    T_world_from_camera: Array
    look: Callable[[], tuple[Rgb, Pinhole]]
    valid: Callable[[], NDArray[np.bool_]] | None = None


@runtime_checkable
class Photographed(Protocol):
    """A place that is known by photographs alone: no new ones can be taken, and nothing drives there."""

    def photographs(self, held_out: int, /) -> tuple[Sequence[Photograph], Sequence[Photograph]]:
        """Photographs to learn from, and ``held_out`` views of the driving camera that are not learned from."""
        ...


def collided_with(world: World, pose: ArrayLike) -> str:
    """Name of the obstacle that stopped the car at a pose (x [m], y [m], yaw [rad]); ``obstacle`` if the world names none there."""
    x_m, y_m, yaw_rad = map(float, np.asarray(pose)[:3])
    return (world.touches(x_m, y_m, yaw_rad) if isinstance(world, NamesObstacles) else "") or "obstacle"


def traits_of(world: World) -> Traits:
    """Properties of a world that are known before it is opened."""
    return getattr(world, "traits", Traits())


def members_of_a_world() -> tuple[str, ...]:
    """Names of the members that every world must have."""
    named = [name for name in vars(World) if not name.startswith("_") or name in ("__enter__", "__exit__")]
    return tuple(sorted(named))


@runtime_checkable
class Screens(Protocol):
    """A world with screens among its panels."""

    def show(self, panel: str, rgb: Rgb | None, /) -> None:
        """Show a picture ``[h, w, 3]`` (row 0 on top) on a whole screen; None shows the screen's idle picture."""


@runtime_checkable
class NativePanels(Protocol):
    """A world that adds textured panels to its own scene: its own renderer lights, shades and occludes them."""

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None, /) -> None:
        """Add a panel to the scene, replacing one of the same name; it stays until it is removed, or the world is closed.

        Args:
            name: Name of the panel.
            panel: Pose and true size; its ``screen_px`` is ignored here.
            rgb: Texture ``[h, w, 3]``, row 0 on top for a viewer; None removes the panel.
        """


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world with one texture.

    Attributes:
        corners_m: Corners ``[F, 3, 3]`` [m], counter-clockwise for who sees the front; the back is not drawn.
        normals: Unit normals at the corners ``[F, 3, 3]``, out of the front.
        uv: Places of the corners in the texture ``[F, 3, 2]``: shares of its width from the left, and of its height from the top.
        rgb: Texture ``[h, w, 3]``, row 0 on top, in the camera's display values.
    """

    corners_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    rgb: Rgb

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        count = len(self.corners_m)
        shapes = {"corners_m": (count, 3, 3), "normals": (count, 3, 3), "uv": (count, 3, 2)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if not count or array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                raise WorldError(
                    f"expected {name} {list(shape)} float32 of a mesh, finite, of one triangle at least; got {array.dtype} {list(array.shape)}"
                )
        require_texture(self.rgb, "a mesh")


def require_texture(rgb: Rgb, what: str) -> Rgb:
    """A texture ``[h, w, 3]`` uint8 of ``what``, whole in memory.

    Raises:
        WorldError: It is none.
    """
    texture = np.ascontiguousarray(rgb)
    if texture.ndim != 3 or texture.shape[2] != 3 or texture.dtype != np.uint8 or not texture.size:
        raise WorldError(
            f"expected a picture [h, w, 3] uint8 for {what}; got {texture.dtype} {list(texture.shape)}"
        )
    return texture


@runtime_checkable
class NativeMeshes(Protocol):
    """A world that adds textured meshes to its own scene: its own renderer lights, shades and occludes them."""

    def add_mesh(self, name: str, mesh: Mesh | None, /) -> None:
        """Add a mesh to the scene, replacing one of the same name; it stays until it is removed, or the world is closed.

        Nothing collides with it.

        Args:
            name: Name of the mesh.
            mesh: The mesh; None removes it.
        """
