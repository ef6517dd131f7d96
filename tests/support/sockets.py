"""Cameras on the sockets of frame servers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hardware.cameras.socket import SocketCamera


@contextmanager
def connected(path: Path) -> Iterator[SocketCamera]:
    """A camera that is open."""
    camera = SocketCamera(path)
    try:
        camera.open()
        yield camera
    finally:
        camera.close()
