"""File descriptors in reserve. ZeroMQ ends the process when a reader connects and no descriptor is free.

Source: libzmq 4.3.5, ``ipc_listener.cpp`` (accept) and ``epoll.cpp`` abort on EMFILE.
"""

from __future__ import annotations

import errno
import os
import resource

from nodes.runtime.errors import BusError

# A ZeroMQ context with its first sockets and connections needs fewer.
_NEEDED = 32
_RESERVED = 32
_RAN_OUT = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


def has_run_out(number: int | None) -> bool:
    """Whether an operation failed, by its errno, because there is no descriptor or memory left, so that it may succeed later."""
    return number in _RAN_OUT


def raise_limit() -> None:
    """Raise this process's limit of open files as far as the system lets it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def require_free() -> None:
    """Raise a `BusError` unless enough descriptors are free."""
    held = _take(_NEEDED)
    for descriptor in held:
        os.close(descriptor)
    if len(held) < _NEEDED:
        raise BusError(
            f"expected {_NEEDED} free file descriptors for the sockets, got {len(held)}: too many files are open;"
            " close some, or raise the limit (ulimit -n)"
        )


class Reserve:
    """Descriptors that are held until no other is free."""

    def __init__(self) -> None:
        self._held = _take(_RESERVED)

    def check(self) -> str:
        """Free the reserve when no other descriptor is left. Returns what is wrong; empty while descriptors are free."""
        if self._held:
            if spare := _take(1):
                os.close(spare[0])
                return ""
            self.close()
        elif len(spare := _take(2 * _RESERVED)) == 2 * _RESERVED:
            self._held = spare[:_RESERVED]
            for descriptor in spare[_RESERVED:]:
                os.close(descriptor)
            return ""
        else:
            for descriptor in spare:
                os.close(descriptor)
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return f"no file descriptor is free, the limit is {limit}; close readers of this node, or raise the limit (ulimit -n)"

    def close(self) -> None:
        """Free the reserve."""
        for descriptor in self._held:
            os.close(descriptor)
        self._held = []


def _take(count: int) -> list[int]:
    taken: list[int] = []
    try:
        while len(taken) < count:
            taken.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
    except OSError:
        pass
    return taken
