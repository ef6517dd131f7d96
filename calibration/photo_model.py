"""Input and result of structure from motion: photographs and their model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from advnerf_core.data.lens import Lens
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.plain import Numbers, PlainData

Report = Callable[[float, str], None]
MIN_IMAGES = 3


class ReconstructionError(AdvnerfError):
    """Structure from motion failed. The message says how far it went and what to do."""


@dataclass(frozen=True)
class PhotoSource:
    """Photographs from one source: a folder, a video, or a camera with known intrinsics.

    Sources with the same ``camera_id`` share a camera. A source holds several cameras if its images differ in size, or if their
    EXIF data name another camera or focal length.

    Attributes:
        camera_id: Name of the camera.
        images: Files, relative to the folder of all images.
        ordered: Whether they follow each other in time, so that neighbours overlap.
        pinhole: Known intrinsics, which are held; None if unknown.
        lens: Known distortion; None if unknown.
    """

    camera_id: str
    images: tuple[str, ...]
    ordered: bool = False
    pinhole: Pinhole | None = None
    lens: Lens = field(default_factory=Lens)

    def __post_init__(self) -> None:
        if not self.images:
            raise ReconstructionError(f"expected images of camera {self.camera_id!r}, got none")
        if self.lens.fisheye:
            raise ReconstructionError(
                f"expected camera {self.camera_id!r} with the OPENCV model, got a fisheye; undistort its images first"
            )


@dataclass(frozen=True)
class SfmConfig:
    """Settings of structure from motion.

    Attributes:
        max_features: Most local features of an image.
        peak_threshold: Contrast below which a spot is no feature; lower finds more in smooth rooms.
        all_pairs_up_to: Number of images up to which all pairs are matched. With more, neighbours and similar images are matched.
        overlap: Number of following images in its video that an image is matched with.
        look_alikes: Number of similar images that each is matched with.
        min_registered_share: With fewer registered images than this share the result is rejected.
        seed: Seed of all randomness.
    """

    max_features: int = 4096
    peak_threshold: float = 0.002
    all_pairs_up_to: int = 100
    overlap: int = 10
    look_alikes: int = 30
    min_registered_share: float = 0.5
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Registered:
    """One image that has a pose.

    Attributes:
        name: File, relative to the folder of all images.
        camera_id: Id of its camera, as in `Model.cameras`.
        T_world_from_camera: Pose ``[4, 4]`` in the model's own world and scale, OpenCV axes.
        pinhole: Intrinsics.
        lens: Distortion.
    """

    name: str
    camera_id: str
    T_world_from_camera: Numbers
    pinhole: Pinhole
    lens: Lens


@dataclass(frozen=True)
class FoundCamera:
    """A camera of the model.

    Attributes:
        camera_id: Name of the camera: the source's, or the source and the image or image size if a source has several cameras.
        images: Number of its images with a pose.
        model: COLMAP's name of the lens model that was chosen.
        why: Reason for this model.
        pinhole: Intrinsics.
        lens: Distortion.
        focal_error_percent: Standard error of the focal length [%]; None if it was held, or could not be computed.
    """

    camera_id: str
    images: int
    model: str
    why: str
    pinhole: Pinhole
    lens: Lens
    focal_error_percent: float | None

    def summary(self) -> dict[str, Any]:
        """The camera in the form of an import report."""
        p = self.pinhole
        return {
            "model": self.model,
            "why": self.why,
            "registered": self.images,
            "width": p.width,
            "height": p.height,
            "fl_x": p.fx,
            "fl_y": p.fy,
            "cx": p.cx,
            "cy": p.cy,
            "distortion": list(self.lens.coefficients),
            "focal_error_percent": self.focal_error_percent,
        }


@dataclass(frozen=True)
class LeftOut:
    """An image that is not in the model.

    Attributes:
        name: File, relative to the folder of all images.
        why: The reason.
    """

    name: str
    why: str


@dataclass(frozen=True, eq=False)
class Model(PlainData):
    """Result of structure from motion.

    Attributes:
        images: Images with poses, in the order they were given.
        left_out: Images without a pose, and why.
        points: Points of the scene ``[M, 3]``, seen from three images or more.
        reprojection_error_px: Mean distance of a point's projection from where it was seen [px]; None if unknown.
        parts: Number of separate models; this is the largest.
        cameras: The cameras of the images with poses.
    """

    images: tuple[Registered, ...]
    left_out: tuple[LeftOut, ...]
    points: Numbers
    reprojection_error_px: float | None
    parts: int
    cameras: tuple[FoundCamera, ...] = ()

    @property
    def poses(self) -> Array:
        """``T_world_from_camera`` ``[N, 4, 4]``."""
        return np.stack([image.T_world_from_camera for image in self.images])

    def summary(self) -> dict[str, Any]:
        """The model in the form of an import report."""
        return {
            "registered": len(self.images),
            "left_out": [asdict(image) for image in self.left_out],
            "points": len(self.points),
            "reprojection_error_px": self.reprojection_error_px,
            "parts": self.parts,
            "cameras": {camera.camera_id: camera.summary() for camera in self.cameras},
        }
