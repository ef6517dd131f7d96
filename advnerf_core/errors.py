"""Base classes of the exceptions for users of advnerf."""

from __future__ import annotations


class AdvnerfError(Exception):
    """An error that the user can correct; the message says what was expected, what was found and what to do.

    The command line prints it as one line, without a traceback. Anything else that escapes is a defect of ours.
    """


class DeviceError(AdvnerfError, RuntimeError):
    """A GPU was requested, but none is usable, or it does not support the request."""


class NotFiniteError(AdvnerfError, ArithmeticError):
    """A drive, loss or gradient has numbers that are NaN or infinite; the message says where they came from."""


class ConfigError(AdvnerfError, ValueError):
    """A file that a user wrote, or an override of it, is wrong."""


class MissingFileError(ConfigError, FileNotFoundError):
    """A file does not exist."""


class UnreadableFileError(ConfigError, OSError):
    """A file exists but cannot be read."""
