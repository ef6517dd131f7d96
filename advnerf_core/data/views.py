"""Posed images: the list of a data set, and undistorted images in memory for training.

On disk an image has a lens and possibly a mask and transparency; in memory there are ideal pinholes with pixel centres at +0.5
and, where a set needs them, an opacity and a validity flag per pixel.
"""

from __future__ import annotations

import filecmp
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.data.errors import DatasetError, raise_all
from advnerf_core.data.image_files import OPAQUE, Grey, Rgb
from advnerf_core.data.lens import require_size
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.view_loading import LoadedView, load_view
from advnerf_core.geometry import Array, Pinhole

# Instant-NGP maps the file's coordinates into its unit cube by 0.33 x + 0.5, unless the file says otherwise.
NGP_SCALE, NGP_OFFSET = 0.33, (0.5, 0.5, 0.5)
TRAIN, HELD_OUT_SPLITS = "train", ("val", "test")
# Poses that are estimated for a file and for its copy differ so little, in parts of the cameras' spread and of the rotation.
_ONE_POSE = 1e-3
_MOST_COMPARED = 8  # of the images at one pose, with each: a car may have stood there for long


@dataclass(frozen=True, eq=False)
class ImageSet:
    """Undistorted images in memory, all of one size.

    Attributes:
        rgb: ``[N, H, W, 3]`` uint8.
        T_world_from_camera: ``[N, 4, 4]``.
        alpha: Opacity ``[N, H, W]`` uint8; None if all are opaque.
        valid: ``[N, H, W]`` bool, pixels to learn from and to compare with; None if all are valid.
        camera_ids: Camera id of each image; empty if unknown.
    """

    rgb: Rgb
    pinholes: tuple[Pinhole, ...]
    T_world_from_camera: Array
    alpha: Grey | None = None
    valid: NDArray[np.bool_] | None = None
    camera_ids: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.rgb) == len(self.pinholes) == len(self.T_world_from_camera):
            raise ValueError(
                f"expected as many images as pinholes and poses, got {len(self.rgb)}, {len(self.pinholes)} and "
                f"{len(self.T_world_from_camera)}"
            )
        for name, plane in (("alpha", self.alpha), ("valid", self.valid)):
            if plane is not None and plane.shape != self.rgb.shape[:3]:
                raise ValueError(f"expected {name} of shape {self.rgb.shape[:3]}, got {plane.shape}")

    @property
    def transparent(self) -> bool:
        """Whether any pixel is not wholly opaque. Pictures of a place may have an alpha channel that says nothing."""
        return self.alpha is not None and bool((self.alpha < OPAQUE).any())

    def on_background(self, colour: ArrayLike) -> Rgb:
        """The images over one colour ``[3]`` in 0..1, ``[N, H, W, 3]`` uint8."""
        if self.alpha is None:
            return self.rgb
        opacity = self.alpha[..., None].astype(np.float32) / OPAQUE
        behind = np.asarray(colour, np.float32) * np.float32(255.0)
        return np.rint(opacity * self.rgb + (1.0 - opacity) * behind).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class PosedImages:
    """The list of a data set.

    Attributes:
        frames: Images that exist, in the file's order.
        missing: Listed files that do not exist.
        aabb_scale: Instant-NGP's box size, if the file has one.
        scale: Instant-NGP's scale from the file's coordinates to its unit cube.
        offset: Offset to the unit cube, applied after the scale.
        file: The file of the list.
        ignored: Keys of the file that other software reads and that have no effect here.
    """

    frames: tuple[PosedImage, ...]
    missing: tuple[Path, ...]
    aabb_scale: float | None
    scale: float = NGP_SCALE
    offset: tuple[float, float, float] = NGP_OFFSET
    file: Path | None = None
    ignored: tuple[str, ...] = ()

    @property
    def files(self) -> list[Path]:
        """Every file that the data set reads."""
        masks = [frame.mask for frame in self.frames if frame.mask is not None]
        return [*([] if self.file is None else [self.file]), *(frame.path for frame in self.frames), *masks]

    def name_of(self, frame: PosedImage) -> str:
        """The path of an image from the folder of the list, with slashes: several folders may have files of one name."""
        path = frame.path if self.file is None else Path(os.path.relpath(frame.path, self.file.parent))
        return path.as_posix()

    @property
    def remarks(self) -> list[str]:
        """Unused parts of the file, in lines for its user."""
        lines = [f"skipped, file not found: {path}" for path in self.missing]
        if self.ignored:
            lines.append(f"no effect here: the keys {', '.join(self.ignored)} of {self._name}")
        left = [self.name_of(frame) for frame in self.frames if frame.split is None]
        if left and {TRAIN} < set(self.splits):
            lines.append(
                f"not used: {len(left)} of {len(self.frames)} images, which are in no split of {self._name}: {left[0]}, ..."
            )
        return lines

    def require_places(self) -> None:
        """Refuse cameras that are all at one place: their images show no depth.

        Raises:
            DatasetError: There are several cameras, all at one place.
        """
        places = np.stack([frame.T_world_from_camera[:3, 3] for frame in self.frames])
        if len(places) > 1 and not np.ptp(places, axis=0).any():
            x, y, z = places[0]
            raise DatasetError(
                f"expected cameras at different places in {self._name}, got all {len(places)} at {x:g}, {y:g}, {z:g}; give the pose of each image, "
                "or move the camera instead of only turning it"
            )

    def require_no_copies(self) -> None:
        """Refuse a photograph that is in the set twice: held out as one, it is learned as the other.

        Raises:
            DatasetError: Two files at one pose have the same content.
        """
        for one, other in self._at_one_pose():
            if filecmp.cmp(one.path, other.path, shallow=False):
                raise DatasetError(
                    f"expected each photograph once in {self._name}, as some are held out from learning, got {self.name_of(one)} again as "
                    f"{self.name_of(other)}; take one of the two out of the file"
                )

    def _at_one_pose(self) -> Iterator[tuple[PosedImage, PosedImage]]:
        poses = np.stack([frame.T_world_from_camera for frame in self.frames])
        spread = float(np.ptp(poses[:, :3, 3], axis=0).max()) or 1.0
        rows = np.concatenate([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3] / spread], axis=1)
        for index, frame in enumerate(self.frames):
            later = np.flatnonzero(np.abs(rows[index + 1 :] - rows[index]).max(axis=1) <= _ONE_POSE)
            for other in later[:_MOST_COMPARED]:
                yield frame, self.frames[index + 1 + other]

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits defined by the data set itself, e.g. ``("train", "test")``; empty if it has none."""
        return tuple(dict.fromkeys(frame.split for frame in self.frames if frame.split is not None))

    @property
    def camera_ids(self) -> tuple[str, ...]:
        """Cameras in the set, in order of appearance."""
        return tuple(dict.fromkeys(frame.camera_id for frame in self.frames))

    def with_frames(self, frames: Sequence[PosedImage]) -> PosedImages:
        """The same data set with other frames."""
        return replace(self, frames=tuple(frames))

    def sorted_by_name(self) -> PosedImages:
        """The same data set, in the order of file names."""
        return self.with_frames(sorted(self.frames, key=lambda f: f.path.name))

    def of_camera(self, camera_id: str) -> PosedImages:
        """Only the images of one camera."""
        if camera_id not in self.camera_ids:
            raise DatasetError(
                f"expected one of the cameras {', '.join(self.camera_ids)} of {self._name}, got {camera_id!r}"
            )
        return self.with_frames([frame for frame in self.frames if frame.camera_id == camera_id])

    def of_split(self, *names: str) -> PosedImages:
        """Only the images of some of the data set's own splits."""
        return self.with_frames([frame for frame in self.frames if frame.split in names])

    def split(self, every: int) -> tuple[PosedImages, PosedImages]:
        """Training and held-out images: in the current order, every ``every``-th, from the first, is held out.

        Raises:
            DatasetError: Fewer than 2 images, or one that is there twice.
        """
        if every < 2:
            raise ValueError(f"expected to hold out every 2nd image or fewer, got every {every}")
        if len(self.frames) < 2:
            raise DatasetError(
                f"expected at least 2 images in {self._name} to hold some of them out, got {len(self.frames)}; take more photographs"
            )
        self.require_no_copies()
        held = [f for i, f in enumerate(self.frames) if i % every == 0]
        rest = [f for i, f in enumerate(self.frames) if i % every != 0]
        return self.with_frames(rest), self.with_frames(held)

    def training_and_held_out(self, every: int = 8) -> tuple[PosedImages, PosedImages]:
        """The data set's own split if it has one (all but ``train`` is held out), else every ``every``-th by name.

        Raises:
            DatasetError: Fewer than 2 images, or one that is there twice.
        """
        training, held_out = self.of_split(TRAIN), self.of_split(*HELD_OUT_SPLITS)
        if training.frames and held_out.frames:
            self.require_no_copies()
            return training, held_out
        return self.sorted_by_name().split(every)

    def load(self, size: tuple[int, int] | None = None, keep_all: bool = False) -> ImageSet:
        """Read, undistort and resize all images.

        Args:
            size: ``(width, height)`` [px] to resample all images to by area averaging; None keeps the size on disk.
            keep_all: Whether undistortion keeps the whole view, with ``valid`` marking existing pixels; otherwise it crops.

        Raises:
            DatasetError: An image or the size cannot be used.
        """
        if not self.frames:
            raise DatasetError(f"expected at least one image in {self._name} to load, got none")
        if size is not None:
            require_size(*size)
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            found = list(pool.map(lambda frame: _view_or_error(frame, size, keep_all), self.frames))
        views = [each for each in found if isinstance(each, LoadedView)]
        raise_all([each for each in found if isinstance(each, DatasetError)], len(found), "images")
        sizes = {(view.pinhole.width, view.pinhole.height) for view in views}
        if len(sizes) > 1:
            raise DatasetError(
                f"expected images of one size in {self._name}, got {sorted(sizes)}; give --size WIDTH HEIGHT to bring them to one"
            )
        shape = views[0].rgb.shape[:2]
        opaque, whole = np.full(shape, OPAQUE, np.uint8), np.ones(shape, np.bool_)
        alphas, valids = [view.alpha for view in views], [view.valid for view in views]
        return ImageSet(
            np.stack([view.rgb for view in views]),
            tuple(view.pinhole for view in views),
            np.stack([frame.T_world_from_camera for frame in self.frames]),
            None
            if all(a is None for a in alphas)
            else np.stack([opaque if a is None else a for a in alphas]),
            None if all(v is None for v in valids) else np.stack([whole if v is None else v for v in valids]),
            tuple(frame.camera_id for frame in self.frames),
        )

    def pinholes(self, size: tuple[int, int] | None = None) -> list[Pinhole]:
        """Intrinsics of all images, undistorted and resized as by `load`; their sizes may differ.

        Args:
            size: ``(width, height)`` [px] that all images are resized to; None keeps the size on disk.

        Raises:
            DatasetError: An image or the size cannot be used.
        """
        if size is not None:
            require_size(*size)
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            return list(pool.map(lambda frame: load_view(frame, size).pinhole, self.frames))

    def box(self) -> tuple[Array, Array]:
        """Low and high corner ``[3]`` of Instant-NGP's box for this file, in its world units."""
        half = 0.5 * (self.aabb_scale or 1.0) / self.scale
        centre = (0.5 - np.array(self.offset)) / self.scale
        return centre - half, centre + half

    def inner_box(self) -> tuple[Array, Array]:
        """Low and high corner ``[3]`` of the full-detail region of a contracted field: Instant-NGP's unit cube, larger if cameras need it."""
        centre = (0.5 - np.array(self.offset)) / self.scale
        places = np.stack([frame.T_world_from_camera[:3, 3] for frame in self.frames])
        half = max(0.5 / self.scale, float(np.abs(places - centre).max()))
        return centre - half, centre + half

    @property
    def _name(self) -> str:
        return str(self.file) if self.file is not None else "the data set"


def _view_or_error(
    frame: PosedImage, size: tuple[int, int] | None, keep_all: bool
) -> LoadedView | DatasetError:
    try:
        return load_view(frame, size, keep_all)
    except DatasetError as error:
        return error
