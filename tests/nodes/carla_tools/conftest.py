"""The scripted CARLA server, for the commands."""

from tests.support.carla.fixtures import (
    TJunction,
    as_carla,
    carla,
    library,
    port,
    scripted,
    settings,
    written_map,
)

__all__ = ["TJunction", "as_carla", "carla", "library", "port", "scripted", "settings", "written_map"]
