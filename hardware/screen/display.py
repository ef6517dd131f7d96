"""Displays: show an image pixel by pixel on a screen, and read the screen back.

No scaling by the system, no colour management, no window border: the picture has exactly the size of the screen, or it is refused.
`PygameDisplay` is a real screen (SDL); `TwinDisplay` is the simulated lab's monitor, which its cameras see.
"""

from __future__ import annotations

import hashlib
import os
import select
import socket
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkLost, LinkTimeout
from hardware.screen.edid import BLOCK_BYTES, Edid, parse_edid

Rgb = NDArray[np.uint8]
_TIMEOUT_S = 2.0


class Display(Protocol):
    """A screen.

    Attributes:
        size_px: Width and height [px].
        edid: EDID of the screen; None if unknown.
    """

    size_px: tuple[int, int]
    edid: Edid | None

    def show(self, rgb: Rgb) -> float:
        """Show a picture ``[height, width, 3]`` and return when it is shown; the time it took [s]."""

    def read_back(self) -> Rgb:
        """Read back the pixels of the screen ``[height, width, 3]``."""

    def keep_alive(self) -> None:
        """Handle events of the window system. Raises `LinkLost` if the screen is lost."""

    def close(self) -> None:
        """Close the display."""


def check_picture(rgb: Rgb, size_px: tuple[int, int]) -> None:
    """Refuse an image of another size than the screen's, because images are not scaled."""
    width, height = size_px
    if rgb.shape != (height, width, 3) or rgb.dtype != np.uint8:
        raise ValueError(
            f"expected a picture of [{height}, {width}, 3] uint8, got {list(rgb.shape)} {rgb.dtype}"
        )


class PygameDisplay:
    """A whole screen through SDL, without border and without scaling.

    Args:
        index: Number of the screen in the window system.
        size_px: Required width and height; None takes the desktop's.
        edid: The monitor's EDID, for its size in millimetres.

    Raises:
        DeviceNotFound: The screen or the window system does not exist.
        HardwareError: The window did not get the requested size (scaling, another resolution).
    """

    def __init__(
        self, index: int = 0, size_px: tuple[int, int] | None = None, edid: Edid | None = None
    ) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ModuleNotFoundError as error:
            raise DeviceNotFound("a display needs pygame-ce: pip install 'advnerf[monitor]'") from error
        self._pygame: Any = pygame
        self.edid = edid
        try:
            pygame.display.init()
            screens = pygame.display.get_desktop_sizes()
        except pygame.error as error:
            raise DeviceNotFound(
                f"no window system for a display: {error}; is DISPLAY or WAYLAND_DISPLAY set?"
            ) from error
        try:
            if not 0 <= index < len(screens):
                sizes = ", ".join(f"{n}: {w} x {h}" for n, (w, h) in enumerate(screens))
                raise DeviceNotFound(f"expected a screen with index {index}, found {sizes}")
            self.size_px = size_px or screens[index]
            self._surface = pygame.display.set_mode(self.size_px, pygame.NOFRAME, display=index)
            # Some drivers silently give another size; a scaled attack has the wrong size in metres.
            if self._surface.get_size() != self.size_px:
                raise HardwareError(
                    f"expected a window of {self.size_px[0]} x {self.size_px[1]} px, got {self._surface.get_size()}; set the "
                    "monitor to its native resolution and its scaling to 100 %"
                )
            pygame.mouse.set_visible(False)
            pygame.event.set_allowed(pygame.QUIT)
        except BaseException:
            pygame.display.quit()
            raise

    def show(self, rgb: Rgb) -> float:
        """Blit pixel by pixel and flip."""
        check_picture(rgb, self.size_px)
        began = time.perf_counter()
        self._pygame.surfarray.blit_array(self._surface, rgb.swapaxes(0, 1))
        self._pygame.display.flip()
        self.keep_alive()
        return time.perf_counter() - began

    def read_back(self) -> Rgb:
        """Pixels of the window's surface."""
        return np.ascontiguousarray(self._pygame.surfarray.array3d(self._surface).swapaxes(0, 1))

    def keep_alive(self) -> None:
        """Handle the window system's events: a window that never does is greyed out as hung."""
        if any(event.type == self._pygame.QUIT for event in self._pygame.event.get()):
            raise LinkLost("the window of the attack was closed at the monitor; restart the launch")
        now = self._pygame.display.get_window_size()
        if now != self.size_px:
            raise LinkLost(
                f"expected the window to keep {self.size_px}, got {now}; was the resolution changed?"
            )

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()


class TwinDisplay:
    """The monitor of the simulated lab; see `hardware.emulators.monitor_port` for the protocol."""

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(_TIMEOUT_S)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise DeviceNotFound(
                f"expected the simulated monitor at {path}: {error.strerror}; is the twin running?"
            ) from error
        try:
            self.edid: Edid | None = parse_edid(self._receive(BLOCK_BYTES))
        except LinkTimeout:
            self.close()
            raise DeviceBusy(
                f"the simulated monitor at {path} is used by another program; stop that first"
            ) from None
        except BaseException:
            self.close()
            raise
        assert self.edid is not None
        self.size_px = self.edid.size_px

    def show(self, rgb: Rgb) -> float:
        """Send the picture and wait until the panel shows it."""
        check_picture(rgb, self.size_px)
        began, pixels = time.perf_counter(), np.ascontiguousarray(rgb).tobytes()
        self._send(b"S" + pixels)
        if (shown := self._receive(32)) != hashlib.sha256(pixels).digest():
            raise HardwareError(
                f"expected the simulated monitor to show the sent image, got hash {shown.hex()[:12]}"
            )
        return time.perf_counter() - began

    def read_back(self) -> Rgb:
        """Pixels of the panel."""
        width, height = self.size_px
        self._send(b"R")
        return np.frombuffer(self._receive(height * width * 3), np.uint8).reshape(height, width, 3)

    def keep_alive(self) -> None:
        """Notice when the twin has hung up."""
        # It never sends unasked: readable data means its end.
        if select.select([self._socket], [], [], 0.0)[0]:
            raise LinkLost(f"the simulated monitor at {self._path} is gone")

    def close(self) -> None:
        """Disconnect; the panel returns to its idle screen."""
        self._socket.close()

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except TimeoutError as error:
            raise LinkTimeout(
                f"the simulated monitor accepted no data for {_TIMEOUT_S:g} s; does the twin hang?"
            ) from error
        except OSError as error:
            raise LinkLost(f"the simulated monitor at {self._path} is gone: {error.strerror}") from error

    def _receive(self, count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            try:
                piece = self._socket.recv(min(count - len(data), 1 << 20))
            except TimeoutError as error:
                raise LinkTimeout(
                    f"the simulated monitor sent no answer for {_TIMEOUT_S:g} s; does the twin hang?"
                ) from error
            except OSError as error:
                raise LinkLost(f"the simulated monitor at {self._path} is gone: {error.strerror}") from error
            if not piece:
                raise LinkLost(f"the simulated monitor at {self._path} closed the connection")
            data += piece
        return bytes(data)
