"""The `World` contract on top of a simulator in another process, whose answers are all checked.

A wrong answer ends the process and raises a named error (`hardware.worlds.remote_errors`): the current drive has no
result. The next `reset`, or the next picture from another pose, restarts the process, so that other drives continue.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from advnerf_core.geometry import Array, Pinhole, VehicleState, planar_pose
from advnerf_core.strict import StrictModel
from hardware.worlds.remote import SERVERS, RemoteServer, ServerReply
from hardware.worlds.remote_answers import (
    depth_in,
    picture_in,
    require_driven,
    require_ground_ahead,
    require_put_down,
    state_in,
)
from hardware.worlds.remote_errors import RemoteWorldError, ServerLost, ServerProtocolError
from hardware.worlds.world import (
    Mesh,
    NotOpenError,
    Panel,
    Rgb,
    View,
    WorldDescription,
    WorldError,
    require_texture,
)

_World = TypeVar("_World", bound="RemoteWorld")
_Arrays = Mapping[str, NDArray[Any]]


class ServerDeadlines(StrictModel):
    """Time limits for the process of a world; results do not depend on them.

    Attributes:
        open_s: Opening the simulator: loading its models, compiling its shaders [s].
        call_s: Any other call [s].
    """

    open_s: float = Field(default=240.0, gt=0.0)
    call_s: float = Field(default=30.0, gt=0.0)


class RemoteWorld(ABC):
    """A world whose simulator runs in another process; a `hardware.worlds.world.World`.

    A subclass defines the interpreter (`python`), the map (`description_of`), and the poses of the photographs.

    Args:
        simulator: The simulator's file, for ``serve.py``.
        settings: Settings that the simulator is opened with, as JSON data.
        cameras: Intrinsics of the driving camera, and of the camera of `photograph`.
        T_car_from_camera: Pose ``[4, 4]`` of the driving camera on the car.
        range_m: Nearest and farthest depth that the cameras give [m]; anything farther is infinite.
        lowest_m: Height of the lowest ground [m].
        server: Server script; another file than ``serve.py`` only in tests.

    Attributes:
        camera_pinhole: Intrinsics of the driving camera.
        photo_pinhole: Intrinsics of the camera of `photograph`.
        server: The process while it runs.
    """

    def __init__(
        self,
        name: str,
        simulator: Path,
        settings: Mapping[str, Any],
        cameras: tuple[Pinhole, Pinhole],
        T_car_from_camera: Array,
        range_m: tuple[float, float],
        lowest_m: float = 0.0,
        deadlines: ServerDeadlines | None = None,
        server: Path = SERVERS / "serve.py",
    ) -> None:
        self.camera_pinhole, self.photo_pinhole = cameras
        self._name, self._simulator, self._server_file = name, simulator, server
        self._settings, self._range_m, self._lowest_m = dict(settings), range_m, lowest_m
        self._mount: Array = np.array(T_car_from_camera, dtype=np.float64)
        self._deadlines = ServerDeadlines() if deadlines is None else deadlines
        self.server: RemoteServer | None = None
        self._description: WorldDescription | None = None
        self._entered = False
        self._state: VehicleState | None = None
        self._blocked = False

    @abstractmethod
    def python(self) -> Path:
        """Interpreter of the simulator's environment.

        Raises:
            WorldNotInstalled: The environment is not installed.
        """

    @abstractmethod
    def description_of(self, facts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> WorldDescription:
        """The description from the facts that the simulator returned when it was opened."""

    def opened_with(self) -> _Arrays:
        """Arrays by name that the simulator is opened with beside its settings, such as files; empty by default."""
        return {}

    @abstractmethod
    def photo_poses(self, count: int, rng: np.random.Generator, /) -> list[Array]:
        """Poses of the photographs for learning; see `World.photo_poses`."""

    @property
    def T_car_from_camera(self) -> Array:
        """Pose ``[4, 4]`` of the driving camera on the car."""
        return self._mount.copy()

    @property
    def state(self) -> VehicleState:
        """True state of the car.

        Raises:
            ServerLost: The process was lost since the car was put down.
        """
        self._require_open()
        if self._state is None:
            raise ServerLost(
                f"world {self._name}: expected a car that was put down; its process was lost, or it was never reset: call reset first"
            )
        return self._state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against something."""
        _ = self.state  # raises for a car that was not put down
        return self._blocked

    def describe(self) -> WorldDescription:
        """The simulator's description of its map.

        Raises:
            NotOpenError: The world was never opened.
        """
        if self._description is None:
            self._require_open()
        assert self._description is not None, "it was asked for when the world was opened"
        return self._description

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest; a process that was lost is started again."""
        self._state = None
        answer = self._ask("reset", {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad})
        with self._or_lost():
            state, self._blocked = state_in(answer.result)
            require_put_down(state, x_m, y_m, yaw_rad)
        self._state = state
        return state

    def step(self, control: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command and let time pass; see `World.step`."""
        before = self.state
        answer = self._ask("step", {"control": control, "speed_mps": speed_mps, "duration_s": duration_s})
        with self._or_lost():
            state, self._blocked = state_in(answer.result)
            require_driven(before, state, speed_mps, duration_s)
        self._state = state
        return state

    def observe(self, depth: bool = True) -> View:
        """View of the driving camera; see `World.observe`."""
        T = self.state.T_world_from_car @ self._mount
        rgb, depth_m = self._render("driving", self.camera_pinhole, T, depth)
        if depth_m is not None and not self._blocked:
            with self._or_lost():
                require_ground_ahead(depth_m, self.camera_pinhole, T)
        return rgb, depth_m

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> View:
        """The driving camera's view from another pose of the car; see `World.observe_at`."""
        return self._render(
            "driving", self.camera_pinhole, planar_pose(x_m, y_m, yaw_rad) @ self._mount, depth
        )

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with ``photo_pinhole``."""
        T = np.asarray(T_world_from_camera, dtype=np.float64)
        return self._render("photo", self.photo_pinhole, T, False)[0]

    def __enter__(self: _World) -> _World:
        self._entered = True
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process; safe to call twice."""
        self._entered, self._state = False, None
        if self.server is not None:
            self.server.close()
            self.server = None

    def _require_open(self) -> None:
        if not self._entered:
            raise NotOpenError(
                f"expected the world {self._name} to be open, as its simulator is asked for everything; use it as a context manager"
            )

    def _open(self) -> None:
        """Start the process and open its simulator."""
        self.server = RemoteServer(self._name, self.python(), self._simulator, self._server_file)
        cameras = {"driving": asdict(self.camera_pinhole), "photo": asdict(self.photo_pinhole)}
        opened = {"config": self._settings, "cameras": cameras}
        answer = self._call("open", opened, self.opened_with(), self._deadlines.open_s)
        with self._or_lost():
            said = self._described(answer)
            if self._description is not None and said.to_dict() != self._description.to_dict():
                raise ServerProtocolError(
                    "expected the same map as when it was opened before; got another one"
                )
        self._description = said
        # The first picture of a camera may take as long as opening, because its shaders are compiled then.
        place = planar_pose(*next(iter(said.paths.values())).start_pose) @ self._mount
        for camera in cameras:
            asked = {"camera": camera, "depth": False}
            self._call("render", asked, {"T_world_from_camera": place}, self._deadlines.open_s)

    def _described(self, answer: ServerReply) -> WorldDescription:
        try:
            return self.description_of(answer.result, answer.arrays)
        except WorldError:
            raise  # the map does not fit this configuration
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ServerProtocolError(
                f"expected a map that can be driven; got {type(error).__name__}: {error}"
            ) from error

    def _ask(self, call: str, arguments: Mapping[str, Any], arrays: _Arrays | None = None) -> ServerReply:
        """Call the open simulator; it is reopened if it was lost."""
        self._require_open()
        if self.server is None:
            self._open()
        return self._call(call, arguments, arrays or {}, self._deadlines.call_s)

    def _call(self, call: str, arguments: Mapping[str, Any], arrays: _Arrays, limit_s: float) -> ServerReply:
        assert self.server is not None, "it was started before"
        try:
            return self.server.call(call, arguments, arrays, limit_s)
        except BaseException:
            self._lose()
            raise

    @contextmanager
    def _or_lost(self) -> Iterator[None]:
        """End the process on a wrong answer; the error names the world."""
        try:
            yield
        except WorldError as error:
            self._lose()
            if not isinstance(error, RemoteWorldError):
                raise
            raise type(error)(
                f"world {self._name}: {error}; its process was ended and the drive does not count; run `advnerf scene world check {self._name}`"
            ) from None

    def _lose(self) -> None:
        self._state = None
        if self.server is not None:
            self.server.kill()
            self.server = None

    def _render(self, camera: str, pinhole: Pinhole, T: Array, depth: bool) -> tuple[Rgb, Any]:
        answer = self._ask("render", {"camera": camera, "depth": depth}, {"T_world_from_camera": T})
        with self._or_lost():
            rgb = picture_in(answer.arrays, pinhole, T)
            return rgb, depth_in(answer.arrays, pinhole, T, self._range_m, self._lowest_m) if depth else None


class RemotePanelWorld(RemoteWorld):
    """A remote world whose simulator adds textured panels to its own scene; a `hardware.worlds.world.NativePanels`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Arguments and arrays of each thing in the scene, by the call that added it and its name.
        self._added: dict[tuple[str, str], tuple[dict[str, Any], _Arrays]] = {}

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        """Add a textured panel to the simulator's scene, or remove it; see `hardware.worlds.world.NativePanels`."""
        if rgb is None:
            self._take_out("add_panel", name, {"size_m": None})
            return
        texture = require_texture(rgb, f"the panel {name}")
        face = np.asarray(panel.T_world_from_face, dtype=np.float64)
        self._add(
            "add_panel",
            name,
            {"size_m": [panel.width_m, panel.height_m]},
            {"T_world_from_face": face, "rgb": texture.copy()},
        )

    def close(self) -> None:
        """End the process, and forget what was added; safe to call twice."""
        self._added.clear()
        super().close()

    def _open(self) -> None:
        super()._open()
        for (call, name), (arguments, arrays) in self._added.items():
            self._ask(call, {"name": name, **arguments}, arrays)

    def _add(self, call: str, name: str, arguments: dict[str, Any], arrays: _Arrays) -> None:
        self._ask(call, {"name": name, **arguments}, arrays)
        self._added[call, name] = arguments, arrays

    def _take_out(self, call: str, name: str, arguments: dict[str, Any]) -> None:
        self._added.pop((call, name), None)
        self._ask(call, {"name": name, **arguments})


class RemoteMeshWorld(RemotePanelWorld):
    """A remote world whose simulator adds textured meshes, too; a `hardware.worlds.world.NativeMeshes`."""

    def add_mesh(self, name: str, mesh: Mesh | None) -> None:
        """Add a textured mesh to the simulator's scene, or remove it; see `hardware.worlds.world.NativeMeshes`."""
        if mesh is None:
            self._take_out("add_mesh", name, {})
        else:
            self._add("add_mesh", name, {}, {key: np.array(array) for key, array in vars(mesh).items()})
