"""COLMAP models that pycolmap itself writes, and images that fit them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

WIDTH, HEIGHT = 64, 48
# Parameters of every camera model for images of 64 x 48 pixels.
CAMERAS: dict[str, Sequence[float]] = {
    "SIMPLE_PINHOLE": [50, 32, 24],
    "PINHOLE": [50, 51, 32.5, 23.5],
    "SIMPLE_RADIAL": [50, 32, 24, -0.08],
    "RADIAL": [50, 32, 24, -0.1, 0.02],
    "OPENCV": [50, 51, 32, 24, -0.1, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [50, 51, 32, 24, -0.1, 0.02, 0.001, -0.002, 0.003, 0, 0, 0],
    "SIMPLE_FISHEYE": [30, 32, 24],
    "FISHEYE": [30, 31, 32, 24],
    "SIMPLE_RADIAL_FISHEYE": [30, 32, 24, 0.02],
    "RADIAL_FISHEYE": [30, 32, 24, 0.02, -0.01],
    "OPENCV_FISHEYE": [30, 31, 32, 24, 0.01, -0.002, 0.001, 0.0005],
}
OTHER_CAMERAS: dict[str, Sequence[float]] = {
    "FULL_OPENCV": [50, 51, 32, 24, -0.1, 0.02, 0.001, -0.002, 0.003, 0.01, 0, 0],
    "FOV": [50, 51, 32, 24, 0.8],
    "THIN_PRISM_FISHEYE": [30, 31, 32, 24, 0.01, 0.002, 0.0005, 0.0005, 0, 0, 0.001, 0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [30, 31, 32, 24, 0.01, 0.002, 0, 0, 0, 0, 0.001, 0.001, 0, 0, 0, 0],
    "SIMPLE_DIVISION": [50, 32, 24, -0.1],
    "DIVISION": [50, 51, 32, 24, -0.1],
    "EUCM": [50, 51, 32, 24, 0.6, 1.1],
}


def camera(name: str = "SIMPLE_RADIAL", params: Sequence[float] | None = None) -> Any:
    import pycolmap

    params = CAMERAS[name] if params is None else params
    return pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params, camera_id=1)


def synthetic(
    frames: int = 5,
    per_rig: int = 1,
    name: str = "SIMPLE_RADIAL",
    params: Sequence[float] | None = None,
    seed: int = 0,
) -> Any:
    """A model that pycolmap made up: cameras on a sphere around points."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, per_rig, frames
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.__members__[name]
    options.camera_params = CAMERAS[name] if params is None else params
    pycolmap.set_random_seed(seed)
    return pycolmap.synthesize_dataset(options)


def posed(
    poses: Sequence[NDArray[np.float64]], names: Sequence[str], points: Sequence[ArrayLike] = ()
) -> Any:
    """A model of one camera with poses ``T_world_from_camera`` and points that the first three images see."""
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera("PINHOLE"))
    for number, (T, name) in enumerate(zip(poses, names, strict=True), 1):
        seen = [pycolmap.Point2D(np.zeros(2)) for _ in points]
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=pycolmap.Point2DList(seen))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(T)[:3]))
    for index, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(number, index) for number in (1, 2, 3)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def write(model: Any, folder: Path, text: bool = False, rigs: bool = True) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    model.write_text(folder) if text else model.write_binary(folder)
    if not rigs:  # as COLMAP wrote models before version 3.12
        for file in (*folder.glob("rigs.*"), *folder.glob("frames.*")):
            file.unlink()
    return folder


def write_images(folder: Path, names: Iterable[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    for number, name in enumerate(names):
        pixels = np.random.default_rng(number).integers(0, 256, (size[1], size[0], 3), np.uint8)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), pixels)
    return folder


def poses_by_name(model: Any) -> dict[str, NDArray[np.float64]]:
    """``T_world_from_camera`` by image name, as pycolmap says."""
    found = {}
    for image in model.images.values():
        found[image.name] = np.eye(4)
        found[image.name][:3] = image.cam_from_world().inverse().matrix()
    return found
