"""Unix sockets of the twin's emulated devices."""

from __future__ import annotations

import socket
from pathlib import Path

from hardware.errors import DeviceBusy, HardwareError


def listen(path: Path, who: str, backlog: int = 8) -> socket.socket:
    """Listen at ``path`` for this process's user alone; a dead socket of an earlier run is replaced.

    Args:
        path: Path of the socket; its length is limited by the system (108 bytes on Linux).
        who: Name of the server, for messages, e.g. ``"a frame server"``.
        backlog: Number of connections that may wait.

    Raises:
        DeviceBusy: A live server answers there.
        HardwareError: The socket cannot be made.
    """
    if path.exists():
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            try:
                probe.connect(str(path))
            except OSError:
                path.unlink()
            else:
                raise DeviceBusy(
                    f"expected {path} to be free, but {who} answers there; stop the other twin first"
                )
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(str(path))
        path.chmod(0o600)
        listener.listen(backlog)
    except OSError as error:
        listener.close()
        raise HardwareError(
            f"cannot serve {who} at {path}: {error.strerror or error}; try a shorter --folder"
        ) from error
    return listener
