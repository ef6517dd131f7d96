"""The base of the exceptions that a user of advnerf is meant to see."""

from __future__ import annotations


class AdvnerfError(Exception):
    """Something a person can put right; the message says what was expected, what was found and what to do.

    The command line prints it as one line, without a traceback. Anything else that escapes is a defect of ours.
    """


class DeviceError(AdvnerfError, RuntimeError):
    """A GPU was asked for, and there is none that can be used, or it cannot do what is asked."""


class ConfigError(AdvnerfError, ValueError):
    """A file that a person wrote, or an override of it, is wrong."""


class MissingFileError(ConfigError, FileNotFoundError):
    """A file does not exist."""


class UnreadableFileError(ConfigError, OSError):
    """A file exists, and cannot be read."""
