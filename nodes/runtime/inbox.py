"""The queue through which a driver thread passes data to its node. An item wakes the node's loop at once."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from advnerf_core.plugins import exit_refused

T = TypeVar("T")
_MOST_URGENT = 1000


class Inbox(Generic[T]):
    """Queue from one or more driver threads to the loop of one node. When it is full, the oldest item is dropped and counted.

    Urgent items have a separate queue and are taken first. So no other item can displace a request to stop the car.

    Args:
        capacity: Largest number of waiting items.

    Attributes:
        dropped: Number of dropped items.
    """

    def __init__(self, capacity: int = 2) -> None:
        if capacity < 1:
            raise ValueError(f"expected a capacity >= 1, got {capacity}")
        self._items: deque[T] = deque(maxlen=capacity)
        self._urgent: list[T] = []
        self._lock = threading.Lock()
        self._failure: BaseException | None = None
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._closed = False
        self.dropped = 0

    def put(self, item: T, urgent: bool = False) -> None:
        """Add an item and wake the loop (any thread)."""
        with self._lock:
            if self._closed:
                return
            if urgent and len(self._urgent) < _MOST_URGENT:
                self._urgent.append(item)
            else:
                self.dropped += len(self._items) == self._items.maxlen
                self._items.append(item)
            os.eventfd_write(self._event, 1)

    def fail(self, failure: BaseException) -> None:
        """Make the next `take` raise, so that the failure of a driver ends its node (any thread)."""
        with self._lock:
            if self._closed:
                return
            self._failure = failure
            os.eventfd_write(self._event, 1)

    def take(self) -> list[T]:
        """Return all waiting items, urgent ones first, then oldest first (the loop's thread)."""
        with self._lock:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._event)
            if self._failure is not None and not self._urgent:
                raise self._failure
            items = [*self._urgent, *self._items]
            self._urgent.clear()
            self._items.clear()
        return items

    def fileno(self) -> int:
        """File descriptor that is readable while items wait."""
        return self._event

    def close(self) -> None:
        """Close the file descriptor. Later items are ignored."""
        with self._lock:
            if not self._closed:
                self._closed = True
                os.close(self._event)


class ReaderThread(Generic[T]):
    """Read thread of a driver: calls a blocking read in a loop and puts the results into an inbox.

    Args:
        read: Blocks for a bounded time; returns None if no data arrived.
        inbox: Receives the results, and the exception if ``read`` raises.
        name: Thread name.
    """

    def __init__(self, read: Callable[[], T | None], inbox: Inbox[T], name: str) -> None:
        self._read = read
        self._inbox = inbox
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """Stop after the current read."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                # A thread that calls sys.exit ends without a word.
                with exit_refused():
                    item = self._read()
                if item is not None:
                    self._inbox.put(item)
        except Exception as failure:  # raised again in the node's loop
            if not self._stop.is_set():
                self._inbox.fail(failure)
