"""Keys of the player: space pauses and resumes, right arrow or s steps, + and - change the speed, q quits."""

from __future__ import annotations

import os
import select
import termios
import tty

HELP = "space: pause, resume   right or s: one message   + -: speed   q: quit"
_WAIT_S = 0.1
_WORDS = {
    b" ": "toggle",
    b"s": "step",
    b"\x1b[C": "step",
    b"\x1bOC": "step",
    b"+": "faster",
    b"-": "slower",
    b"q": "stop",
}


class Keys:
    """Reads single keys of a terminal, given by its file descriptor. Ctrl-C still interrupts."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._before = termios.tcgetattr(descriptor)
        tty.setcbreak(descriptor)

    def read(self) -> str | None:
        """Read a key and return its command: ``toggle``, ``step``, ``faster``, ``slower`` or ``stop``; None after 0.1 s without a key."""
        if not select.select([self._descriptor], [], [], _WAIT_S)[0]:
            return None
        return _WORDS.get(os.read(self._descriptor, 16))

    def close(self) -> None:
        """Restore the terminal."""
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
