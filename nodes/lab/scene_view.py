"""Shows a scene in the browser with viser: the field with cameras, objects and the reference path.

Each browser has its own thread that renders its view: at low resolution while it moves, at full resolution when it rests. The depth is
sent too, so that walls hide what viser draws (cameras, path).
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import viser
from numpy.typing import NDArray

from advnerf_core.data.image_files import Rgb
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.data.views import PosedImages
from advnerf_core.geometry import (
    Array,
    Pinhole,
    make_transform,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from advnerf_core.objects.voxel.model import load_object
from advnerf_core.render.cast_object import ObjectCast, cast_work, made_opaque
from advnerf_core.scene.surrogate import Surrogate
from advnerf_core.splats.scene_file import load_renderer
from calibration.schema import RoomCalibration, load_calibration

_MOVING_PX, _RESTING_PX = 160, 640  # image width
_REST_S = 0.25
_THUMBNAIL_PX = 96
_MOST_CAMERAS = 60
_FAR_M = 1000.0
_PATH_POINTS = 200


class SceneView:
    """A web server that shows a scene.

    Args:
        cameras: ``transforms.json`` whose cameras and images are shown, or None.
        objects: Object files, placed at the world's origin in their own colours.
        room: Room calibration whose path is drawn, or None.
        port: Preferred port; the next free one is used.
    """

    def __init__(
        self,
        scene: Path,
        cameras: Path | None = None,
        objects: Sequence[Path] = (),
        room: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        self._renderer = load_renderer(scene)
        self._objects = [load_object(path).placed(np.eye(4)) for path in objects]
        self._lock = threading.Lock()  # the renderer's threads are shared
        self.rendered = 0
        self._viewers: dict[int, _Viewer] = {}
        views = None if cameras is None else load_transforms(cameras)
        self._server = viser.ViserServer(host=host, port=port, label="advnerf", verbose=False)
        self._server.scene.set_up_direction("+z")
        self._mode = self._server.gui.add_dropdown("show", ("colour", "depth"))
        self._show_cameras = self._server.gui.add_checkbox("cameras", views is not None)
        self._frustums: list[Any] = []
        if views is not None:
            self._add_cameras(views)
        if room is not None:
            self._add_path(load_calibration(RoomCalibration, room))
        self._mode.on_update(lambda event: self._refresh())
        self._show_cameras.on_update(lambda event: self._toggle_cameras())
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """Port on which the server listens."""
        return int(self._server.get_port())

    def serve(self) -> None:
        """Serve until Ctrl-C."""
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Stop the server and its threads."""
        for viewer in list(self._viewers.values()):
            viewer.stop()
        self._server.stop()

    def picture(
        self, T_world_from_camera: Array, pinhole: Pinhole, mode: str = "colour"
    ) -> tuple[NDArray[np.uint8], Array]:
        """Render the scene with its objects: pixels ``[H, W, 3]`` and planar depth ``[H, W]`` [m]."""
        with self._lock, torch.no_grad():
            rgb, depth_m, _ = self._renderer.render(T_world_from_camera[None], pinhole)
            image, depth = rgb[0].numpy(), np.nan_to_num(depth_m[0].numpy().astype(np.float64), posinf=_FAR_M)
            if self._objects:
                surrogate = Surrogate(self._renderer.render, pinhole, np.eye(4), self._objects, supersample=1)
                casts = cast_work(self._objects, T_world_from_camera, pinhole, supersample=1).run()
                drawn = surrogate.composed(casts, rgb, depth_m).render(surrogate.plain_theta()).images
                image, depth = drawn[0].permute(1, 2, 0).numpy(), _nearest(depth, casts)
            self.rendered += 1
        if mode == "depth":
            return _coloured(depth), depth
        return np.rint(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8), depth

    @property
    def mode(self) -> str:
        """Display mode: ``colour`` or ``depth``."""
        return str(self._mode.value)

    def _connect(self, client: Any) -> None:
        low, high = (
            np.array(corner) for corner in (self._renderer.config.box_low_m, self._renderer.config.box_high_m)
        )
        client.camera.position = 0.5 * (low + high) + np.array([-0.25, -0.25, 0.1]) * (high - low)
        client.camera.look_at = 0.5 * (low + high)
        self._viewers[client.client_id] = _Viewer(self, client)

    def _disconnect(self, client: Any) -> None:
        viewer = self._viewers.pop(client.client_id, None)
        if viewer is not None:
            viewer.stop()

    def _refresh(self) -> None:
        for viewer in list(self._viewers.values()):
            viewer.moved()

    def _toggle_cameras(self) -> None:
        for frustum in self._frustums:
            frustum.visible = bool(self._show_cameras.value)

    def _add_cameras(self, views: PosedImages) -> None:
        shown = views.frames[:: max(1, -(-len(views.frames) // _MOST_CAMERAS))]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            thumbnails = list(pool.map(_thumbnail, shown))
        for frame, (small, lens) in zip(shown, thumbnails, strict=True):
            T = frame.T_world_from_camera
            frustum = self._server.scene.add_camera_frustum(
                f"/cameras/{views.name_of(frame)}",
                2 * float(np.arctan(0.5 * lens.height / lens.fy)),
                lens.width / lens.height,
                scale=0.02 * self._renderer.config.extent_m,
                image=small,
                wxyz=_quaternion(T),
                position=T[:3, 3],
            )
            frustum.on_click(functools.partial(_stand_at, T))
            self._frustums.append(frustum)

    def _add_path(self, room: RoomCalibration) -> None:
        path = room.reference_path
        poses = [path.pose_at(s) for s in np.linspace(0.0, path.length_m, _PATH_POINTS)]
        points = np.array([[pose[0], pose[1], 0.05] for pose in poses])  # a learned floor is not exact
        self._server.scene.add_spline_catmull_rom("/path", points, line_width=3.0, color=(30, 160, 70))


class _Viewer:
    """Renders for one browser."""

    def __init__(self, view: SceneView, client: Any) -> None:
        self._view, self._client = view, client
        self._changed, self._stopping = threading.Event(), False
        client.camera.on_update(lambda camera: self.moved())
        self._thread = threading.Thread(target=self._run, name="scene view", daemon=True)
        self._thread.start()
        self.moved()

    def moved(self) -> None:
        self._changed.set()

    def stop(self) -> None:
        self._stopping = True
        self._changed.set()

    def _run(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            if self._stopping:
                return
            self._send(_MOVING_PX)
            if not self._changed.wait(_REST_S):
                self._send(_RESTING_PX)

    def _send(self, width: int) -> None:
        camera = self._client.camera
        height = max(8, round(width / max(float(camera.aspect), 0.1)))
        f = 0.5 * height / np.tan(0.5 * float(camera.fov))
        T = _pose(np.asarray(camera.wxyz, dtype=np.float64), np.asarray(camera.position, dtype=np.float64))
        if not np.isfinite(T).all():
            return
        picture, depth = self._view.picture(
            T, Pinhole(width, height, f, f, 0.5 * width, 0.5 * height), self._view.mode
        )
        self._client.scene.set_background_image(picture, depth=depth.astype(np.float32))


def _thumbnail(frame: PosedImage) -> tuple[Rgb, Pinhole]:
    rgb, lens = load_image(frame)
    size = _THUMBNAIL_PX, max(1, _THUMBNAIL_PX * lens.height // lens.width)
    return np.asarray(cv2.resize(rgb, size), np.uint8), lens


def _nearest(depth_m: Array, casts: Sequence[ObjectCast]) -> Array:
    """Depth ``[H, W]`` [m] of the scene, or of objects that are in front of it and cover at least half of the pixel."""
    nearest = depth_m.copy()
    for cast in map(made_opaque, casts):
        nearest.flat[cast.pixels] = np.minimum(nearest.flat[cast.pixels], cast.depth_m)
    return nearest


def _stand_at(T: Array, event: Any) -> None:
    """Move the browser's camera to the pose of the clicked photograph."""
    client = event.client
    client.camera.wxyz, client.camera.position = _quaternion(T), T[:3, 3]


def _quaternion(T: Array) -> Array:
    return np.roll(quaternion_from_rotation(T[:3, :3]), 1)


def _pose(wxyz: Array, position: Array) -> Array:
    return make_transform(rotation_from_quaternion(np.roll(wxyz, -1)), position)


def _coloured(depth_m: Array) -> NDArray[np.uint8]:
    """Convert depth to colours. Near is bright; the 95th percentile sets the scale."""
    seen = depth_m[depth_m < _FAR_M]
    far = float(np.quantile(seen, 0.95)) if seen.size else 1.0
    grey = np.rint(255 * (1.0 - np.clip(depth_m / max(far, 1e-6), 0.0, 1.0))).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1])
