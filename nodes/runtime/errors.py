"""Exceptions of the runtime: what can go wrong between nodes, told in one line each."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class RuntimeFault(AdvnerfError):
    """Base of the errors raised by nodes and by what they share."""


class ConfigError(RuntimeFault, ValueError):
    """A configuration file or an override is wrong."""


class MessageError(RuntimeFault, ValueError):
    """Bytes are not the message they claim to be, or a message does not fit its type."""


class TopicError(RuntimeFault, KeyError):
    """A topic is not in the topic table."""

    def __str__(self) -> str:
        return str(self.args[0])


class BusError(RuntimeFault, OSError):
    """An endpoint cannot be used."""


class SecurityError(RuntimeFault):
    """A key is missing, unsafe or unknown, or an address may not be used without one."""


class LaunchError(RuntimeFault):
    """A launch could not start, or one of its required nodes died."""


class BagError(RuntimeFault):
    """A bag cannot be written or read."""


class NodeFinished(Exception):
    """Raised by a node whose work is done (a player at the end of its bag); the loop then ends with exit code 0."""
