"""The optics of the simulated monitor: the colours that a camera sees of its pixels.

``seen = (glare + cos(angle)^falloff  M shown^gamma) ^ (1 / response)`` per pixel of the screen, with the angle between the panel's normal and the
direction from that pixel to the camera. The default is the identity.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, invert_transform, transform_points
from hardware.worlds.lab import textures
from hardware.worlds.lab.config import MonitorOpticsConfig, PanelConfig

Rgb = NDArray[np.uint8]
_GRID = (10, 18)  # rows, columns of the coarse map of angles


class ScreenOptics:
    """Turns shown pictures into what the camera sees.

    Args:
        pixels: Width and height at which pictures are computed [px].
    """

    def __init__(self, config: MonitorOpticsConfig, panel: PanelConfig, pixels: tuple[int, int]) -> None:
        self._config, self._pixels = config, pixels
        self._T_face_from_world = invert_transform(panel.T_world_from_face)
        rows, columns = _GRID
        y = ((np.arange(columns) + 0.5) / columns - 0.5) * panel.width_m
        z = (0.5 - (np.arange(rows) + 0.5) / rows) * panel.height_m
        self._places = np.stack(np.broadcast_arrays(0.0, y[None, :], z[:, None]), axis=-1)
        self._light: NDArray[np.float32] = np.zeros((pixels[1], pixels[0], 3), np.float32)

    @property
    def depends_on_place(self) -> bool:
        """Whether the seen colours depend on the camera's position."""
        return self._config.falloff > 0.0

    def show(self, rgb: Rgb) -> None:
        """Put a picture ``[h, w, 3]`` on the screen."""
        shown = textures.fit(rgb, *self._pixels).astype(np.float32) / np.float32(255.0)
        channels = [cv2.pow(np.ascontiguousarray(shown[..., c]), g) for c, g in enumerate(self._config.gamma)]
        mixed = cv2.transform(np.stack(channels, axis=-1), np.asarray(self._config.mixing, np.float32))
        self._light = np.asarray(mixed, np.float32)

    def seen_from(self, position_m: Array) -> Rgb:
        """The screen's picture ``[H, W, 3]`` as seen from a place in the world ``[3]`` [m]."""
        light = self._light
        if self.depends_on_place:
            gain = cv2.resize(self._gain(position_m), self._pixels, interpolation=cv2.INTER_LINEAR)
            light = np.asarray(light * gain[..., None], np.float32)
        total = np.maximum(light + np.asarray(self._config.glare, np.float32), np.float32(0.0))
        return textures.to_uint8(np.asarray(cv2.pow(total, 1.0 / self._config.response), np.float32))

    def _gain(self, position_m: Array) -> NDArray[np.float32]:
        to_camera = transform_points(self._T_face_from_world, position_m) - self._places
        cosine = to_camera[..., 0] / np.maximum(np.linalg.norm(to_camera, axis=-1), 1e-9)
        return (np.clip(cosine, 0.0, 1.0) ** self._config.falloff).astype(np.float32)
