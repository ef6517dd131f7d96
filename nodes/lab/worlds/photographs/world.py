"""A place that is known by posed photographs alone: attacks are searched in the scene learned from them, and nothing is driven there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.epipolar import require_agreeing_poses
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.view_loading import load_image, load_view
from advnerf_core.geometry import Array, Pinhole, camera_mount, invert_transform, make_transform
from hardware.worlds.world import Box, Photograph, Rgb, WorldDescription, WorldError
from nodes.lab.worlds.photographs.config import PhotographsConfig, read_images
from nodes.lab.worlds.photographs.track import driven_track, driving_order, path_along, points_of
from nodes.lab.worlds.undriven import Undriven

PATH = "track"
# The learned box reaches beyond cameras and path by this share of their extent; anything outside is learned with less detail.
_BESIDE, _BELOW_M = 0.5, 0.1
# Of a picture: estimated intrinsics differ from declared ones, so that so much beyond its border is taken from the border.
_BEYOND = 0.01
# A camera that is screwed on; its roll is left out of the mount.
_MOST_ROLL_RAD = math.radians(10.0)
# So far from the nearest photograph a path may always lead [m].
_NEAR_M = 5.0
_HALF_PX = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


class Photographs(Undriven):
    """A place of photographs. Its frame is the photographs' frame, moved up or down so that the ground is at z = 0.

    Args:
        config: The photographs, the path, the car and its camera.
    """

    Config: ClassVar[type[PhotographsConfig]] = PhotographsConfig
    known_by = "photographs"

    def __init__(self, config: PhotographsConfig) -> None:
        self.config = config

    @cached_property
    def T_car_from_camera(self) -> Array:
        """Pose ``[4, 4]`` of the driving camera on the car."""
        camera = self.config.camera
        pitch = camera.pitch_down_rad
        if pitch is None:
            turned = np.stack([each.T_world_from_camera[:3, :3] for each in self._listed])
            _require_upright(turned)
            pitch = float(np.median(np.arcsin(np.clip(-turned[:, 2, 2], -1.0, 1.0))))
        return camera_mount(camera.x_m, camera.y_m, camera.z_m, pitch)

    @cached_property
    def camera_pinhole(self) -> Pinhole:
        """Intrinsics of the driving camera."""
        return self.config.camera.pinhole or load_image(self._listed[0])[1]

    @cached_property
    def photo_pinhole(self) -> Pinhole:
        """Intrinsics of the first photograph; each has its own, see `photographs`."""
        return load_image(self._all[0])[1]

    @cached_property
    def _listed(self) -> tuple[PosedImage, ...]:
        """The photographs that were taken while driving, as they are listed."""
        return tuple(self.config.driven.frames)

    @cached_property
    def _driven(self) -> tuple[PosedImage, ...]:
        """The same in the order of the drive."""
        if not self.config.shows_path:
            return self._listed
        cars = self._cars_of(self._listed)
        return tuple(self._listed[k] for k in driving_order(cars, [each.path.name for each in self._listed]))

    @cached_property
    def _all(self) -> tuple[PosedImage, ...]:
        return tuple(read_images(self.config.images).frames)

    def _cars_of(self, driven: Sequence[PosedImage]) -> Array:
        """``T_images_from_car [N, 4, 4]`` of driven photographs."""
        poses = np.stack([each.T_world_from_camera for each in driven])
        return poses @ invert_transform(self.T_car_from_camera)

    @cached_property
    def _T_world_from_images(self) -> Array:
        ground_m = self.config.ground_z_m
        if ground_m is None:
            ground_m = float(np.median(self._cars_of(self._listed)[:, 2, 3]))
        return make_transform(np.eye(3), [0.0, 0.0, -ground_m])

    def describe(self) -> WorldDescription:
        """The description for an experiment: the path comes from the photographs taken while driving, or from the file."""
        config, points = self.config, self.path_points()
        path = path_along(points, config.off_track_m, config.closed)
        return WorldDescription(
            paths={PATH: path},
            off_track_m=config.off_track_m,
            car=config.car.described,
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=self._box(points),
            facts={"photographs": len(self._all)},
        )

    def path_points(self) -> Array:
        """Measured points ``[N, 2]`` of the path [m]."""
        if self.config.shows_path:
            return driven_track(self._cars_of(self._driven))
        points = points_of(Path(self.config.path))
        away_m = self._distances_m(points).min(axis=0)
        if len(points) and away_m.max() > max(self.extent_m, _NEAR_M):
            x_m, y_m = points[away_m.argmax()]
            raise WorldError(
                f"expected a path among the photographs, in their frame and in metres, got x = {x_m:g} m, y = {y_m:g} m, which is "
                f"{away_m.max():.0f} m from the nearest of them; nothing there was seen"
            )
        return points

    def _distances_m(self, points: Array) -> Array:
        """From each photograph to each point ``[N, M]`` on the ground."""
        places = np.stack([each.T_world_from_camera[:2, 3] for each in self._all])
        return np.linalg.norm(places[:, None] - points[None], axis=2)

    def _box(self, points: Array) -> Box:
        poses = np.stack([each.T_world_from_camera for each in self._all])
        cameras = (self._T_world_from_images @ poses)[:, :3, 3]
        seen = np.concatenate([cameras, np.column_stack([points, np.zeros(len(points))])])
        low, high = seen.min(axis=0), seen.max(axis=0)
        reach_m = self.config.reach_m
        beside_m = _BESIDE * float((high - low).max()) if reach_m is None else reach_m
        x, y, z = (high + beside_m).tolist()
        below = float(low[0] - beside_m), float(low[1] - beside_m), -_BELOW_M
        return Box(below, (x, y, z), contraction=reach_m is None)

    @property
    def extent_m(self) -> float:
        """Longest side of the box around the cameras [m]."""
        places = np.stack([each.T_world_from_camera[:3, 3] for each in self._all])
        return float(np.ptp(places, axis=0).max())

    def photographs(self, held_out: int) -> tuple[list[Photograph], list[Photograph]]:
        """Photographs to learn from, and held-out views of the driving camera.

        Args:
            held_out: Number of photographs to hold out, equally spaced among those taken while driving, or nearest to the path, that have no
                mask: a masked one is not all that the driving camera sees.

        Raises:
            WorldError: Too few photographs.
            DatasetError: One photograph is there twice, or the poses are not those of the photographs.
        """
        self._require_no_copies()
        along = [each for each in self.along if each.mask is None]
        if not 3 <= held_out <= len(along) // 3:
            masked = (
                f"; {len(self.along) - len(along)} more have a mask" if len(along) < len(self.along) else ""
            )
            raise WorldError(
                f"expected capture.held_out from 3 to a third of the {len(along)} photographs along the path, got {held_out}{masked}"
            )
        chosen = [along[index] for index in np.linspace(0, len(along) - 1, held_out + 2).astype(int)[1:-1]]
        left_out = {each.path.resolve() for each in chosen}
        learned = [each for each in self._all if each.path.resolve() not in left_out]
        require_agreeing_poses(learned, self.config.images)
        if self.config.half is not None:
            learned = learned[self.config.half == "odd" :: 2]
        return [self._photograph(each, None) for each in learned], [
            self._photograph(each, self.camera_pinhole) for each in chosen
        ]

    def _require_no_copies(self) -> None:
        """Raise for a photograph with a copy: of a second list as well, and with another name for the same file counted once."""
        once = {each.path.resolve(): each for each in (*self._all, *self._listed)}
        read_images(self.config.images).with_frames(list(once.values())).require_no_copies()

    @property
    def along(self) -> Sequence[PosedImage]:
        """Photographs that views can be held out of: those taken while driving, or nearest to the path."""
        return self._driven if self.config.shows_path else self._nearest()

    def _nearest(self) -> list[PosedImage]:
        """The half of the photographs whose cameras are nearest to the points of the path, in their order."""
        away_m = self._distances_m(self.path_points()).min(axis=1)
        near = np.sort(np.argsort(away_m, kind="stable")[: (len(away_m) + 1) // 2])
        return [self._all[index] for index in near]

    def _photograph(self, image: PosedImage, pinhole: Pinhole | None) -> Photograph:
        """One photograph, undistorted; in the driving camera's intrinsics if they are given."""
        pose = self._T_world_from_images @ image.T_world_from_camera

        def look() -> tuple[Rgb, Pinhole]:
            rgb, own = load_image(image)
            return (rgb, own) if pinhole is None else (_through(pinhole, rgb, own, image.path), pinhole)

        def valid() -> NDArray[np.bool_]:
            found = load_view(image).valid
            assert found is not None  # it has a mask
            return found

        return Photograph(pose, look, None if image.mask is None else valid)

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Poses of the photographs, for any ``count``."""
        return [self._T_world_from_images @ each.T_world_from_camera for each in self._all]


def _require_upright(R_world_from_camera: Array) -> None:
    """Raise unless cameras ``[N, 3, 3]`` look ahead with the horizon level, as the mount of a driving camera is taken to.

    Raises:
        WorldError: They are rolled, upside down, or not in a frame with z up.
    """
    rolls_rad = np.arctan2(R_world_from_camera[:, 2, 0], -R_world_from_camera[:, 2, 1])
    roll_rad = float(np.median(np.abs(rolls_rad)))
    if roll_rad > _MOST_ROLL_RAD:
        raise WorldError(
            f"expected upright photographs in a frame with z up, got cameras that are rolled by {math.degrees(roll_rad):.0f} degrees in the "
            "median; turn pictures and poses together, or make the data set with advnerf scene from-scan, which puts z up"
        )


def _through(pinhole: Pinhole, rgb: Rgb, own: Pinhole, file: Path) -> Rgb:
    """A photograph as a camera with other intrinsics would have taken it from the same pose.

    Raises:
        WorldError: The photographs do not show that camera's whole view.
    """
    if pinhole == own:
        return rgb
    directions_from_wanted = np.linalg.inv(pinhole.matrix)
    corners = np.array([[x, y, 1.0] for x in (0.5, pinhole.width - 0.5) for y in (0.5, pinhole.height - 0.5)])
    seen = corners @ (own.matrix @ directions_from_wanted).T
    size_px = np.array([own.width, own.height])
    if (seen[:, :2] < -_BEYOND * size_px).any() or (seen[:, :2] > (1.0 + _BEYOND) * size_px).any():
        raise WorldError(
            f"expected photographs that show all that the driving camera {pinhole} sees, got {file.name} with {own}; take wider ones, or "
            "correct camera.pinhole"
        )
    smaller = max(pinhole.fx / own.fx, pinhole.fy / own.fy)
    # The warp reads four pixels for each of its own: of a larger photograph it would skip the others.
    if smaller < 1.0:
        shrunk = math.ceil(smaller * own.width), math.ceil(smaller * own.height)
        rgb = np.asarray(cv2.resize(rgb, shrunk, interpolation=cv2.INTER_AREA), np.uint8)
        own = own.resized(*shrunk)
    # OpenCV counts pixels from their centres.
    index_map = np.linalg.inv(_HALF_PX) @ (own.matrix @ directions_from_wanted) @ _HALF_PX
    size = (pinhole.width, pinhole.height)
    warped = cv2.warpPerspective(
        rgb, index_map, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, dtype=np.uint8)
