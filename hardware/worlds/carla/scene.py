"""CARLA, synchronous: observe, decide, step. The car's time passes only in ``step``."""

from __future__ import annotations

import contextlib
import logging
import weakref
from collections.abc import Iterator
from types import TracebackType
from typing import Any, ClassVar

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState, look_at, planar_pose
from hardware.worlds.carla.body import CarlaCar
from hardware.worlds.carla.camera import DEPTH, RGB, CarlaCamera
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.connection import check_nobody_else, connect, open_world
from hardware.worlds.carla.drives import JunctionDrives
from hardware.worlds.carla.errors import CarlaError, CarlaFrameError
from hardware.worlds.carla.frames import CarlaPose
from hardware.worlds.carla.junction import find_drives
from hardware.worlds.carla.library import load_carla, server_answers
from hardware.worlds.carla.pixels import depth_of, rgb_of
from hardware.worlds.carla.synchronous import TickedWorld, set_scenery
from hardware.worlds.carla.undo import Undo
from hardware.worlds.junction.config import UNSEEN_OF_A_CAR
from hardware.worlds.junction.paths import PathName
from hardware.worlds.paths import ReferencePath
from hardware.worlds.road_photos import road_photo_poses
from hardware.worlds.world import Box, NotOpenError, Rgb, Traits, View, WorldDescription

_log = logging.getLogger(__name__)
_CLOSING_TIMEOUT_S = 5.0
_ATTEMPTS = 3  # ticks until a picture of the wanted pose must have come
_LOW_M, _HIGH_M = -0.5, 20.0  # lower and upper end of the learned box
_PHOTOGRAPHED_M = 44.0  # of each drive: what is driven, and what a car sees that overshoots
_FROM_ABOVE_M = (-18.0, 0.0, 22.0)  # camera position of the reports' overview


class CarlaScene:
    """A junction of a CARLA map with a Dubins car in it; a `hardware.worlds.world.World`.

    CARLA's world belongs to the scene while it is open: synchronous, weather and traffic lights fixed, the server draws only when asked.
    Closing puts all of it back, also after an error, or when the program ends without closing.

    ``step`` moves the car and ticks; pictures belong to the last tick. A picture from another pose (``observe`` after ``reset``,
    ``observe_at``, ``photograph``) takes extra ticks during which the car stands still. A picture counts only if its frame number is the
    tick's and its pose is the requested one; if the server skips a frame, or moves the camera a tick late, another tick
    follows, up to three.

    Args:
        config: All numbers of the scene.
        library: The ``carla`` module; None imports it when the scene is opened.

    Raises:
        CarlaError: Opening failed; one of `hardware.worlds.carla.errors`.

    Attributes:
        camera_pinhole: Intrinsics of the driving camera.
        photo_pinhole: Intrinsics of the camera of ``photograph``.
        T_car_from_camera: Pose ``[4, 4]`` of the driving camera on the car.
        drives: Junction, frame and lanes read from the map; available once the scene was opened.
        repeated_frames: Number of extra ticks because a picture did not come or came from another pose.
    """

    Config: ClassVar[type[CarlaConfig]] = CarlaConfig

    def __init__(self, config: CarlaConfig | None = None, library: Any = None) -> None:
        self.config = CarlaConfig() if config is None else config
        self.camera_pinhole: Pinhole = self.config.camera.pinhole
        self.photo_pinhole: Pinhole = self.config.photo.pinhole
        self.T_car_from_camera: Array = self.config.camera.T_car_from_camera
        self.repeated_frames = 0
        self._drives: JunctionDrives | None = None
        self._opened = False
        self._changed = True  # whether an actor was moved since the last tick
        self._library = library
        self._cameras: dict[str, CarlaCamera] = {}
        self._undo = Undo()
        self._client: Any = None
        self._car: CarlaCar | None = None
        # Also if the scene is never closed: a world left synchronous stands still for every client.
        self._at_exit = weakref.finalize(self, self._undo.run)

    @property
    def traits(self) -> Traits:
        """A server steps one world, in whole ticks."""
        return Traits(UNSEEN_OF_A_CAR, exclusive=True, step_s=self.config.render.fixed_delta_s)

    def __enter__(self) -> CarlaScene:
        if not self._at_exit.alive:
            raise CarlaError("expected a scene that was never closed, got one that was; make another one")
        self._library = load_carla() if self._library is None else self._library
        try:
            with server_answers("opening the scene"):
                self._open()
        except BaseException:
            self._put_back()
            raise
        return self

    def _open(self) -> None:
        config, library = self.config, self._library
        self._client = connect(config.server, library)
        self._world = open_world(self._client, config.server)
        check_nobody_else(self._world, config.server)
        self._drives = find_drives(self._world.get_map(), library, config.junction)
        self._ticked = TickedWorld(
            self._world, config.render.fixed_delta_s, config.server.timeout_s, self._undo
        )
        set_scenery(self._world, library, config.render, self._undo)
        self._car = CarlaCar(self._world, library, self._drives.frame, config, self._undo)
        self._opened = True

    @property
    def drives(self) -> JunctionDrives:
        """Junction, frame and lanes read from the map.

        Raises:
            NotOpenError: The scene was never opened.
        """
        if self._drives is None:
            raise NotOpenError(
                "expected an open CARLA scene, whose map says where its drives are; use it as a context manager"
            )
        return self._drives

    def describe(self) -> WorldDescription:
        """The drives, lanes and place from the map; the town and the sky outside the box are contracted.

        Raises:
            NotOpenError: The scene was never opened.
        """
        reach, drives = self.config.junction.reach_m, self.drives
        return WorldDescription(
            paths={str(name): path for name, path in drives.paths.items()},
            off_track_m=self.off_track_m,
            car=self.config.car.description,
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box((-reach, -reach, _LOW_M), (reach, reach, _HIGH_M), contraction=True),
            facts=drives.place,
        )

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Poses ``T_world_from_camera [4, 4]`` along, beside and above the drives; see `road_photo_poses`."""
        paths = [path.stretch(0.0, min(_PHOTOGRAPHED_M, path.length_m)) for path in self.paths.values()]
        return road_photo_poses(paths, self.drives.lane_width_m, self.config.camera, count, rng)

    def overview(self) -> tuple[Rgb, Pinhole, Array]:
        """A photograph ``[H, W, 3]`` from above the straight drive, its lens, and ``T_world_from_camera [4, 4]``."""
        T = look_at(_FROM_ABOVE_M, np.zeros(3))
        return self.photograph(T), self.photo_pinhole, T

    @property
    def paths(self) -> dict[PathName, ReferencePath]:
        """The reference paths straight, right and left."""
        return self.drives.paths

    @property
    def off_track_m(self) -> float:
        """Cross-track error beyond which the car has left its lane [m]."""
        return 0.5 * self.drives.lane_width_m

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        return self._driven.state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against something solid or at the end of the world."""
        return self._driven.blocked

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest, turning nowhere."""
        self._require_open()
        self._changed = True
        with server_answers("putting the car down"):
            return self._driven.reset(x_m, y_m, yaw_rad)

    def step(self, turn_rate_radps: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Hold one command for a while.

        Args:
            turn_rate_radps: Commanded turn rate, left positive [rad/s]; clipped to the car's bound.
            speed_mps: Speed, reached at once [m/s].
            duration_s: Time to the next observation, a whole number of ticks [s].

        Raises:
            ValueError: The duration is not a whole number of ticks, or a value is not finite.
            CarlaError: The server did not answer.
        """
        self._require_open()
        delta, ticks = self.config.render.fixed_delta_s, self.config.render.whole_ticks(duration_s)
        with server_answers("moving the car"):
            for _ in range(ticks):
                before = self._driving_pose()
                self._driven.advance(turn_rate_radps, speed_mps, delta)
                after = self._driving_pose()
                for name in (RGB, DEPTH):
                    if name in self._cameras:
                        self._cameras[name].aim(after, jump=self._cameras[name].pose != before)
                self._tick()
        return self.state

    def observe(self, depth: bool = True) -> View:
        """View of the driving camera: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None if not wanted.

        Raises:
            CarlaFrameError: The pictures did not come in time.
            CarlaUnreachable: The server did not answer.
        """
        return self._see(self.state.T_world_from_car, depth)

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> View:
        """The driving camera's view from another pose of the car (see :meth:`observe`); the car does not move, and is out of sight."""
        with server_answers("looking from elsewhere"), self._without_car():
            return self._see(planar_pose(x_m, y_m, yaw_rad), depth)

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with ``photo_pinhole``, without the car, in the driving camera's colours."""
        p = self.photo_pinhole
        with server_answers("taking a photograph"), self._without_car():
            (image,) = self._pictures({"photo": (RGB, p)}, T_world_from_camera)
            return rgb_of(image, p.width, p.height)

    def close(self) -> None:
        """Remove cameras and car and put the world back; safe to call twice.

        Raises:
            CarlaError: Something could not be put back; the message says what.
        """
        failed = self._put_back()
        if failed:
            raise CarlaError(
                f"could not put CARLA's world back: {'; '.join(failed)}. If the server still runs, `advnerf scene carla release` frees it"
            )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        # Raise the original error; failures to restore, often for the same reason, are only added as notes.
        for what in self._put_back():
            _log.warning("could not put back %s", what)

    def _put_back(self) -> list[str]:
        self._opened = False
        self._cameras.clear()
        self._at_exit.detach()
        if self._client is not None:
            # Do not wait again and again for a server that is gone.
            self._client.set_timeout(min(_CLOSING_TIMEOUT_S, self.config.server.timeout_s))
        return self._undo.run()

    @property
    def _driven(self) -> CarlaCar:
        if self._car is None:
            raise NotOpenError(
                "expected an open CARLA scene, as its car stands in the server's world; use it as a context manager"
            )
        return self._car

    def _require_open(self) -> None:
        if not self._opened:
            raise CarlaError(
                "expected an open scene, this one is closed: CARLA's world is not ours; use a scene as a context manager"
            )

    def _tick(self) -> None:
        self._ticked.tick()
        self._changed = False

    @contextlib.contextmanager
    def _without_car(self) -> Iterator[None]:
        if not self._driven.hide():
            yield
            return
        self._changed = True
        try:
            yield
        finally:
            self._driven.show()
            self._changed = True

    def _driving_pose(self) -> CarlaPose:
        return self.drives.frame.camera_pose(self.state.T_world_from_car @ self.T_car_from_camera)

    def _see(self, T_world_from_car: Array, depth: bool) -> View:
        p = self.camera_pinhole
        wanted = {RGB: (RGB, p)} | ({DEPTH: (DEPTH, p)} if depth else {})
        with server_answers("taking a picture"):
            images = self._pictures(wanted, T_world_from_car @ self.T_car_from_camera)
        return rgb_of(images[0], p.width, p.height), depth_of(images[1], p.width, p.height) if depth else None

    def _pictures(self, wanted: dict[str, tuple[str, Pinhole]], T_world_from_camera: Array) -> list[Any]:
        """Raw pictures of one tick from one pose, by several cameras (created on first use)."""
        self._require_open()
        pose = self.drives.frame.camera_pose(T_world_from_camera)
        for name, (kind, pinhole) in wanted.items():
            if name not in self._cameras:
                parts = (self._world, self._library, kind, pinhole, pose, self.config.render, self._undo)
                self._cameras[name] = CarlaCamera(*parts)
            elif self._cameras[name].pose != pose:
                self._cameras[name].aim(pose, jump=True)
        cameras = [self._cameras[name] for name in wanted]
        if not all(camera.settled for camera in cameras):
            for _ in range(self.config.render.settle_ticks + 1):
                self._tick()
            for camera in cameras:
                camera.settled = True
        elif self._changed:
            self._tick()
        for _ in range(_ATTEMPTS - 1):
            try:
                return [self._picture(camera) for camera in cameras]
            except CarlaFrameError:
                self.repeated_frames += 1
                self._tick()
        return [self._picture(camera) for camera in cameras]

    def _picture(self, camera: CarlaCamera) -> Any:
        return camera.picture(self._ticked.frame, self.config.server.frame_timeout_s)
