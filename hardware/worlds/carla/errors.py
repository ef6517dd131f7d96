"""What can go wrong with a CARLA server, each with what to do about it."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class CarlaError(AdvnerfError, RuntimeError):
    """Base of the errors of the CARLA scene."""


class CarlaNotInstalled(CarlaError):
    """The client library is missing."""


class CarlaUnreachable(CarlaError, ConnectionError):
    """There is no server where one was expected, or it went away."""


class CarlaVersionMismatch(CarlaError):
    """Server and client library are of different versions, which fails in ways that are hard to see."""


class CarlaBusy(CarlaError):
    """Somebody else drives the server's world."""


class CarlaMapError(CarlaError, ValueError):
    """The map, or the junction in it, is not what the experiment needs."""


class CarlaFrameError(CarlaError):
    """The server ticked, and the picture that belongs to the tick did not come, or is not the one asked for."""
