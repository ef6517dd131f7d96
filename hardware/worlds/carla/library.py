"""The only module that imports ``carla``, so that everything else works without it and its absence gives one clear error."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hardware.worlds.carla.errors import CarlaError, CarlaMapError, CarlaNotInstalled, CarlaUnreachable


def load_carla() -> Any:
    """The client library.

    Raises:
        CarlaNotInstalled: The library is not installed, or cannot be loaded on this machine.
    """
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise CarlaNotInstalled(
            f"expected the Python package carla, it cannot be imported ({error}): pip install 'advnerf[carla]' (x86-64, "
            "Python 3.10 to 3.12), of the same version as the server"
        ) from error


@contextlib.contextmanager
def server_answers(doing: str) -> Iterator[None]:
    """Turn the bare ``RuntimeError`` that the library raises when the server does not answer into `CarlaUnreachable`.

    Args:
        doing: The action under way, for the message.
    """
    try:
        yield
    except CarlaError:
        raise
    except RuntimeError as error:
        raise CarlaUnreachable(
            f"the CARLA server did not answer to {doing}: {error}; is it still running? Another client that ticks, or a map that still "
            "loads, looks the same"
        ) from error


def read_opendrive(file: Path, library: Any) -> Any:
    """A ``carla.Map`` of an OpenDRIVE file; no server is needed.

    Raises:
        CarlaMapError: The file cannot be read, or is not a map with roads.
    """
    try:
        carla_map = library.Map(file.stem, file.read_text(encoding="utf-8"))
        roads = carla_map.get_topology()
    except (OSError, UnicodeDecodeError, RuntimeError) as error:
        raise CarlaMapError(f"expected an OpenDRIVE map in {file}, got: {error}") from error
    if not roads:
        raise CarlaMapError(f"expected an OpenDRIVE map with roads in {file}, got one without")
    return carla_map
