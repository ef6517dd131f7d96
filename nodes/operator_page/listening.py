"""Requirements for serving a page: its packages, and its port."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from importlib.util import find_spec

from nodes.runtime.errors import BusError, ConfigError


def require_packages(names: Sequence[str]) -> None:
    """Refuse to serve without these packages of the extra ``page``."""
    if missing := [name for name in names if find_spec(name) is None]:
        raise ConfigError(f"the page needs {', '.join(missing)}, not installed: pip install 'advnerf[page]'")


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket that holds the page's address.

    Args:
        port: TCP port; 0 selects a free one.

    Raises:
        BusError: The port is taken, or the address is not this computer's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind((host, port))
    except OSError as error:
        made.close()
        raise BusError(
            f"cannot serve the page on {host}:{port}: {error.strerror}; choose another port"
        ) from error
    return made
