"""What can go wrong with a device: one short tree, each error also being the builtin a caller would expect."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class HardwareError(AdvnerfError, RuntimeError):
    """A device did something other than asked; the message says what was expected, what came, and what to do."""


class DeviceNotFound(HardwareError, FileNotFoundError):
    """There is no such device, port or socket."""


class DeviceBusy(HardwareError, OSError):
    """Another process holds the device."""


class LinkLost(HardwareError, ConnectionError):
    """The device was there and went away: unplugged, hung up, or its server ended."""


class LinkTimeout(HardwareError, TimeoutError):
    """The device is there and does not answer in time."""


class ProtocolError(HardwareError, ValueError):
    """The device sent bytes that do not follow its protocol."""
