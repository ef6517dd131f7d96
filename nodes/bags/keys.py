"""Keys for a player: space pauses and goes on, right arrow or s steps, + and - change the speed, q ends."""

from __future__ import annotations

import os
import select
import termios
import tty

HELP = "space: pause, go on   right or s: one message   + -: speed   q: end"
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
    """Reads single keys of a terminal; Ctrl-C keeps its meaning.

    Args:
        descriptor: File descriptor of the terminal.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._before = termios.tcgetattr(descriptor)
        tty.setcbreak(descriptor)

    def read(self) -> str | None:
        """The word of the next key: ``toggle``, ``step``, ``faster``, ``slower`` or ``stop``; None after 0.1 s without one."""
        if not select.select([self._descriptor], [], [], _WAIT_S)[0]:
            return None
        return _WORDS.get(os.read(self._descriptor, 16))

    def close(self) -> None:
        """Make the terminal what it was."""
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
