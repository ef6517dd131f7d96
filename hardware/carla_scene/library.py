"""The one place that imports ``carla``, so that everything else works without it and its absence is one clear error."""

from __future__ import annotations

import importlib
from typing import Any

from hardware.carla_scene.errors import CarlaNotInstalled


def load_carla() -> Any:
    """The client library.

    Raises:
        CarlaNotInstalled: It is not installed, or cannot be loaded on this machine.
    """
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise CarlaNotInstalled(
            f"expected the Python package carla, it cannot be imported ({error}): pip install 'advnerf[carla]' (x86-64, "
            "Python 3.10 to 3.12), of the same version as the server"
        ) from error
