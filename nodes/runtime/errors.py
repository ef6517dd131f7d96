"""Exceptions of the runtime. Each message is one line."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError
from advnerf_core.errors import ConfigError as ConfigError


class RuntimeFault(AdvnerfError):
    """Base of the errors raised by nodes and the runtime."""


class MessageError(RuntimeFault, ValueError):
    """Bytes do not decode to the expected message, or a message does not fit its type."""


class TopicError(RuntimeFault, KeyError):
    """A topic is not in the topic table."""

    def __str__(self) -> str:
        return str(self.args[0])


class BusError(RuntimeFault, OSError):
    """An endpoint cannot be used."""


class TakenError(BusError):
    """Other processes have all endpoints of a topic."""


class SecurityError(RuntimeFault):
    """A key is missing, unsafe or unknown, or an address may not be used without one."""


class LaunchError(RuntimeFault):
    """A launch could not start, or one of its required nodes died."""


class BagError(RuntimeFault):
    """A bag cannot be written or read."""


class NodeFinished(Exception):
    """Raised by a node that has finished, such as a player at the end of its bag. The loop then ends with exit code 0."""
