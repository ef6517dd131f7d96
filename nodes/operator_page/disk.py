"""Writes to the disk in a separate thread, so that a full or hanging disk neither ends nor delays the node."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

_MOST_WAITING = 2000
_RETRY_S, _SLOW_S = 1.0, 2.0


class DiskWriter:
    """Runs write jobs one after the other. A job that fails is repeated every second, so it must continue where it stopped.

    Attributes:
        lost: Number of jobs that were dropped because too many waited.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._jobs: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._failure = ""
        self._began_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], None]) -> None:
        """Run a job soon. Never blocks, never raises (any thread)."""
        with self._changed:
            if len(self._jobs) >= _MOST_WAITING:
                self.lost += 1
                return
            self._jobs.append(job)
            self._changed.notify_all()

    @property
    def trouble(self) -> str:
        """Why the newest write is not on the disk; empty if it is, or soon will be."""
        began_s = self._began_s
        if self._failure or began_s is None or time.monotonic() - began_s < _SLOW_S:
            return self._failure
        return f"the disk has not answered for {time.monotonic() - began_s:.0f} s"

    def close(self, timeout_s: float = 1.0) -> None:
        """Finish the waiting jobs, if the disk takes them within the timeout [s]."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closing)
                if not self._jobs:
                    return
                job = self._jobs[0]
            self._began_s = time.monotonic()
            try:
                job()
            except OSError as error:
                self._failure, self._began_s = f"cannot write: {error.strerror or error}", None
                if self._wait_to_retry():
                    return
                continue
            self._failure, self._began_s = "", None
            with self._changed:
                self._jobs.popleft()

    def _wait_to_retry(self) -> bool:
        """Wait before the next attempt. Returns whether the writer was closed instead."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closing, _RETRY_S)
