"""Errors of a CARLA server; each message says what to do."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class CarlaError(AdvnerfError, RuntimeError):
    """Base of the errors of the CARLA scene."""


class CarlaNotInstalled(CarlaError):
    """The client library is missing."""


class CarlaUnreachable(CarlaError, ConnectionError):
    """No server answers, or the connection was lost."""


class CarlaVersionMismatch(CarlaError):
    """Server and client library are of different versions, which fails in ways that are hard to see."""


class CarlaBusy(CarlaError):
    """Another client controls the server's world."""


class CarlaMapError(CarlaError, ValueError):
    """The map, or the junction in it, is not what the experiment needs."""


class CarlaFrameError(CarlaError):
    """No picture of this tick arrived, or it is not the requested one."""
