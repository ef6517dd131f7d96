"""Keyboard input from a terminal. Terminals send no key-up events, so a key counts as held while it repeats.

So a tap never moves the car: holding begins with the second repeat in a row and ends when the next one is late. A key that only seemed
to be let go, as the terminal or ssh was held up, repeats at once; one that is pressed again waits for a quarter of a second and more
after its first letter, and only this counts as holding again. The hand drives
with w (straight), a and d (left, right) and s (backwards); o lets the software drive; space is the e-stop, r re-arms.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import termios
import tty
from collections.abc import Callable
from typing import Any

from hardware.errors import HardwareError
from hardware.operator.hands import Hands

_DRIVE = {"w": (1.0, 0.0), "a": (1.0, 1.0), "d": (1.0, -1.0), "s": (-1.0, 0.0)}
_AUTONOMY, _STOP, _REARM = "o", " ", "r"
# What a terminal sends for an arrow, a function key or Alt with a letter (ECMA-48, section 5.4); its last letter is no key that was pressed.
_ESCAPE = re.compile(r"\x1b(\[[0-?]*[ -/]*[@-~]?|O[^\x1b]?|[^\[O\x1b])?")
_BEGUN = re.compile(r"\x1b(\[[0-?]*[ -/]*|O)?$")
# A repeat that comes later than this after the last one does not count.
_LATE_NS = 150_000_000
HELP = "hold w a d s: drive, hold o: let the software drive, space: e-stop, r: re-arm, Ctrl-C: end"


class Keyboard:
    """The terminal on a file descriptor, in raw mode while it is open."""

    def __init__(self, fd: int, mono_ns: Callable[[], int]) -> None:
        if not os.isatty(fd):
            raise HardwareError(
                "expected a terminal to read keys from, got none; run the command in a terminal, or use a gamepad"
            )
        self._fd, self._mono_ns = fd, mono_ns
        self._before: list[Any] | None = termios.tcgetattr(fd)
        tty.setcbreak(fd, termios.TCSANOW)
        self._key, self._repeats, self._key_ns = "", 0, 0
        self._lapsed = False
        self._stops = self._rearms = 0
        self._lost = False
        self._rest = ""

    def read(self, timeout_s: float = 0.05) -> Hands:
        """Wait for keys for at most a timeout [s], and return the input."""
        with contextlib.suppress(InterruptedError):
            if select.select([self._fd], [], [], timeout_s)[0] and not self._lost:
                self._take()
        now_ns = self._mono_ns()
        held = self._key if self._is_held and now_ns - self._key_ns <= _LATE_NS else ""
        throttle, steering = _DRIVE.get(held, (0.0, 0.0))
        return Hands(
            held in _DRIVE,
            held == _AUTONOMY,
            throttle,
            steering,
            self._stops,
            self._rearms,
            not self._lost,
            "the terminal is gone" if self._lost else "keyboard",
        )

    def close(self) -> None:
        """Restore the terminal."""
        if self._before is not None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._fd, termios.TCSANOW, self._before)
        self._before = None

    @property
    def _is_held(self) -> bool:
        return self._repeats >= 2 and not self._lapsed

    def _take(self) -> None:
        try:
            got = os.read(self._fd, 256).decode("ascii", "replace")
        except OSError:
            got = ""
        self._lost = not got
        if not got:
            return
        now_ns = self._mono_ns()
        self._stops += got.count(_STOP)  # also one after the Esc key, with which it looks like Alt and space
        keys = self._rest + got
        begun = _BEGUN.search(keys)
        keys, self._rest = (keys, "") if begun is None else (keys[: begun.start()], begun[0])
        keys = _ESCAPE.sub("", keys).lower()
        self._rearms += keys.count(_REARM)
        # A burst after a pause shows pressed keys, not a held one: it counts as one.
        key = keys[-1:]
        late = now_ns - self._key_ns > _LATE_NS
        if late:
            # A second pause, after one letter alone: the key was pressed again.
            self._lapsed = self._is_held or (self._lapsed and self._repeats > 0)
        again = bool(key) and key == self._key and not late
        self._key, self._repeats, self._key_ns = key, self._repeats + 1 if again else 0, now_ns
