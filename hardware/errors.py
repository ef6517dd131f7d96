"""Exceptions of devices. Each also derives from the matching builtin exception."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class HardwareError(AdvnerfError, RuntimeError):
    """A device did not do what was requested. The message says what was expected, what came, and what to do."""


class DeviceNotFound(HardwareError, FileNotFoundError):
    """The device, port or socket does not exist."""


class DeviceBusy(HardwareError, OSError):
    """Another process holds the device."""


class LinkLost(HardwareError, ConnectionError):
    """The connection to the device was lost: unplugged, closed, or its server ended."""


class LinkTimeout(HardwareError, TimeoutError):
    """The device exists, but does not answer in time."""


class ProtocolError(HardwareError, ValueError):
    """The device sent bytes that do not follow its protocol."""
