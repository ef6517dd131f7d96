"""A place described by a learned scene: a scene file, and the calibration of the room, the car and its camera."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from advnerf_core.driving.path import Line
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.strict import Angle, LengthM, SpeedMps, StrictModel
from calibration.schema import CameraCalibration, RoomCalibration, VehicleCalibration, load_calibration
from hardware.worlds.paths import ReferencePath, Segment
from hardware.worlds.world import Box, CarDescription, WorldDescription, WorldError
from nodes.lab.located import NamedFile, NamedFolder
from nodes.lab.worlds.undriven import Undriven

SCENE, PATH = "scene", "track"
_FILES = ("camera", "vehicle", "room")
Pose = tuple[float, float, Angle]


class OwnSceneConfig(StrictModel):
    """A place described by a learned scene.

    Attributes:
        file: Scene file of ``advnerf scene train`` or ``advnerf scene from-splat``.
        calibration: Folder with ``camera.yaml``, ``vehicle.yaml`` and ``room.yaml``.
        camera: Camera calibration, instead of the folder's.
        vehicle: Vehicle calibration, instead of the folder's.
        room: Room calibration, instead of the folder's: path, fence, width of the track and where drives start.
        start: x [m], y [m], yaw [rad] of the start of drives; None: the start of the room calibration.
        goal: Goal for a goal-conditioned policy; empty: none.
        speed_mps: Driving speed [m/s].
        depth_tolerance_m: A surface hides an object only if it is nearer by more than this [m].
    """

    file: NamedFile
    calibration: NamedFolder | None = Field(default=None, exclude=True)
    camera: NamedFile | None = None
    vehicle: NamedFile | None = None
    room: NamedFile | None = None
    start: Pose | None = None
    goal: tuple[float, ...] = ()
    speed_mps: Annotated[SpeedMps, Field(gt=0.0)] = 0.8
    depth_tolerance_m: Annotated[LengthM, Field(ge=0.0)] = 0.15

    @model_validator(mode="before")
    @classmethod
    def _from_the_folder(cls, given: Any) -> Any:
        """Set the three files, whose paths are then resolved like any others."""
        if not isinstance(given, dict):
            return given
        folder = given.get("calibration")
        missing = [name for name in _FILES if given.get(name) is None]
        if folder is None and missing:
            raise ValueError(f"expected a calibration folder, or files for {', '.join(missing)}")
        return given | {name: str(Path(str(folder)) / f"{name}.yaml") for name in missing}


class OwnScene(Undriven):
    """A learned scene with a path through it."""

    Config: ClassVar[type[OwnSceneConfig]] = OwnSceneConfig
    known_by = "a learned scene"
    photo_poses = Undriven._refuse

    def __init__(self, config: OwnSceneConfig) -> None:
        self.config = config

    @cached_property
    def _calibrated(self) -> tuple[CameraCalibration, VehicleCalibration, RoomCalibration]:
        camera, vehicle, room = (Path(str(getattr(self.config, name))) for name in _FILES)
        return (
            load_calibration(CameraCalibration, camera),
            load_calibration(VehicleCalibration, vehicle),
            load_calibration(RoomCalibration, room),
        )

    @property
    def camera_pinhole(self) -> Pinhole:
        """Intrinsics of the calibrated camera."""
        return self._calibrated[0].pinhole

    @property
    def photo_pinhole(self) -> Pinhole:
        """The camera's intrinsics, as there are no photographs."""
        return self.camera_pinhole

    @property
    def T_car_from_camera(self) -> Array:
        """Pose of the driving camera on the car ``[4, 4]``."""
        return self._calibrated[0].mount

    def describe(self) -> WorldDescription:
        """Description of the world from its calibration.

        Raises:
            SceneFileError: The file holds no scene.
            CalibrationError: A calibration file is missing or wrong.
        """
        camera, vehicle, room = self._calibrated
        limits = (vehicle.limits.steering_min_rad, vehicle.limits.steering_max_rad)
        start, box = self.config.start or room.start_pose, self._box()
        low, high = np.array(box.min_m[:2]), np.array(box.max_m[:2])
        if not ((low <= start[:2]) & (start[:2] <= high)).all():
            raise WorldError(
                f"expected drives that start in the learned box, x {low[0]:g} to {high[0]:g} m and y {low[1]:g} to {high[1]:g} m, "
                f"got x = {start[0]:g} m, y = {start[1]:g} m; are scene and room calibration in one frame?"
            )
        height_m = float(camera.mount[2, 3])
        if not box.min_m[2] <= height_m <= box.max_m[2]:
            raise WorldError(
                f"expected a driving camera in the learned box, z {box.min_m[2]:g} to {box.max_m[2]:g} m, got one {height_m:g} m above the ground; "
                "is the ground of the scene at z = 0, and its metre right? If so, correct the camera's mount"
            )
        return WorldDescription(
            paths={PATH: _reference(room.reference_path, start, self.config.goal)},
            off_track_m=room.off_track_m,
            car=CarDescription("ackermann", self.config.speed_mps, limits, vehicle.wheelbase_m),
            camera=camera.pinhole,
            T_car_from_camera=camera.mount,
            box=box,
            fence_m=float(np.abs(np.array(room.fence_m)).min()),
        )

    def _box(self) -> Box:
        from advnerf_core.splats.scene_file import load_box  # brings torch

        learned = load_box(Path(str(self.config.file)))
        return Box(learned.box_low_m, learned.box_high_m, learned.contraction)


def _reference(path: DrivingPath, start: Pose, goal: tuple[float, ...]) -> ReferencePath:
    """A calibrated path in the form that worlds use."""
    pieces: list[Segment] = [
        ("line", piece.length_m) if isinstance(piece, Line) else ("arc", piece.radius_m, piece.angle_rad)
        for piece in path.segments
    ]
    x, y, yaw = path.start_pose
    return ReferencePath((x, y, yaw), tuple(pieces), goal, path.closed, start)
