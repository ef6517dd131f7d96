"""Camera that plays numbered image files at a constant rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from advnerf_core.files import natural_order
from hardware.cameras.played import PlayedCamera
from hardware.errors import DeviceNotFound, LinkLost

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


class FileCamera(PlayedCamera):
    """Delivers the images of a folder in the order of the numbers in their names; hidden files are none of them.

    Args:
        loop: Start over after the last image. Otherwise the device is lost, like an unplugged camera.
    """

    def __init__(self, folder: Path | str, rate_hz: float = 10.0, loop: bool = True) -> None:
        super().__init__(folder, loop)
        self._rate_hz = rate_hz
        self._files: list[Path] = []

    def open(self) -> None:
        """List the images."""
        found = (p for p in self.path.glob("[!.]*") if p.suffix.lower() in IMAGE_SUFFIXES)
        self._files = sorted(found, key=lambda path: natural_order(path.name))
        if not self._files:
            self.close()
            raise DeviceNotFound(f"expected images ({', '.join(IMAGE_SUFFIXES)}) in {self.path}, found none")
        self._begin(1.0 / self._rate_hz)

    def _next_bgr(self) -> Any:
        if self._sequence >= len(self._files) and not self._loop:
            raise LinkLost(
                f"all {len(self._files)} images of {self.path} were played; set loop to repeat them"
            )
        path = self._files[self._sequence % len(self._files)]
        bgr = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if bgr is None:
            raise LinkLost(f"expected an image, cannot decode {path}; remove or replace it")
        return bgr
