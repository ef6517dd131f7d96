"""Gamepads by the Linux input interface, read directly: event devices (``/dev/input/event*``, stable under ``by-id``) and the
older joystick devices (``/dev/input/js*``).

Sources: ``linux/input.h`` (struct input_event, EVIOCGABS, EVIOCGKEY), ``linux/input-event-codes.h``, ``linux/joystick.h``
(struct js_event). A button counts as held regardless of others; the MIT stack's exact match lets go when one more is pressed.
SYN_DROPPED means that the kernel has dropped events, possibly the release of a button, so the state is read again.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hardware.errors import HardwareError
from hardware.operator.hands import Hands

_EVENT = struct.Struct("llHHi")
_JS_EVENT = struct.Struct("IhBB")
_SYN, _KEY, _ABS = 0, 1, 3
_SYN_DROPPED = 3
_JS_BUTTON, _JS_AXIS, _JS_INIT = 1, 2, 0x80
_KEY_BYTES = 96  # KEY_MAX 0x2ff, one bit each
_EVIOCGKEY = (2 << 30) | (_KEY_BYTES << 16) | (ord("E") << 8) | 0x18
_ABSINFO = struct.Struct("6i")
_RETRY_NS = 500_000_000
_DEAD_ZONE = 0.05


@dataclass(frozen=True)
class GamepadLayout:
    """Codes of buttons and axes.

    Attributes:
        human: Held: the hand drives.
        autonomy: Held: the software drives.
        stop: E-stop.
        rearm: Re-arm after an e-stop.
        throttle: Axis, down positive as gamepads have it.
        steering: Axis, right positive.
    """

    human: int
    autonomy: int
    stop: int
    rearm: int
    throttle: int
    steering: int


# BTN_TL, BTN_TR, BTN_EAST (B), BTN_START, ABS_Y, ABS_RX; as the kernel's xpad driver names them.
EVENT_LAYOUT = GamepadLayout(0x136, 0x137, 0x131, 0x13B, 1, 3)
# The same pad as a joystick in XInput mode: LB 4, RB 5, B 1, Start 7, axes 1 and 3.
JS_LAYOUT = GamepadLayout(4, 5, 1, 7, 1, 3)


def _evioc_gabs(axis: int) -> int:
    return (2 << 30) | (_ABSINFO.size << 16) | (ord("E") << 8) | (0x40 + axis)


@dataclass
class _State:
    held: set[int] = field(default_factory=set)
    axes: dict[int, float] = field(default_factory=dict)
    stops: int = 0
    rearms: int = 0


class Gamepad:
    """A gamepad, opened at the first read and reopened after it was unplugged.

    Args:
        layout: Codes; None uses the usual ones of the interface.
        mono_ns: Clock that paces opening [ns].
        ioctl: Replacement of the system call for emulated devices.
    """

    def __init__(
        self,
        path: Path,
        mono_ns: Callable[[], int],
        layout: GamepadLayout | None = None,
        ioctl: Callable[..., Any] = fcntl.ioctl,
    ) -> None:
        self.path = path
        self._js = path.name.startswith("js") or os.path.basename(os.path.realpath(path)).startswith("js")
        self._layout = layout or (JS_LAYOUT if self._js else EVENT_LAYOUT)
        self._mono_ns, self._ioctl = mono_ns, ioctl
        self._fd: int | None = None
        self._retry_ns: int | None = None
        self._trouble = "not opened yet"
        self._ranges: dict[int, tuple[int, int]] = {}
        self._rest = b""
        self._state = _State()

    def read(self, timeout_s: float = 0.05) -> Hands:
        """Wait for events for at most a timeout [s], and return the input."""
        if self._fd is None:
            self._open()
        if self._fd is None:
            select.select([], [], [], timeout_s)
            return self._hands()
        try:
            if select.select([self._fd], [], [], timeout_s)[0]:
                self._take(os.read(self._fd, 64 * _EVENT.size))
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EINTR):
                self._lose(f"{self.path} is gone: {error.strerror}")
        return self._hands()

    def close(self) -> None:
        """Close the device."""
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.close(self._fd)
        self._fd = None

    def _open(self) -> None:
        now_ns = self._mono_ns()
        if self._retry_ns is not None and now_ns < self._retry_ns:
            return
        self._retry_ns = now_ns + _RETRY_NS
        try:
            self._fd = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            self._rest, self._state.held, self._state.axes = b"", set(), {}
            if not self._js:
                self._ranges = {
                    axis: self._range(axis) for axis in (self._layout.throttle, self._layout.steering)
                }
                self._ask()
        except OSError as error:
            cure = (
                "; add yourself to the group input" if error.errno == errno.EACCES else "; is it plugged in?"
            )
            self._lose(f"cannot use {self.path} as a gamepad: {error.strerror}{cure}")

    def _lose(self, trouble: str) -> None:
        self.close()
        self._trouble = trouble
        self._state.held, self._state.axes = set(), {}

    def _range(self, axis: int) -> tuple[int, int]:
        buffer = bytearray(_ABSINFO.size)
        self._ioctl(self._fd, _evioc_gabs(axis), buffer)
        _, low, high, *_ = _ABSINFO.unpack(buffer)
        if low >= high:
            raise HardwareError(
                f"expected axis {axis} of {self.path} to have a range, got {low}..{high}; give its layout"
            )
        return low, high

    def _ask(self) -> None:
        """Buttons that are held now, read from the kernel: events do not show earlier presses, or lost events.

        A stop that was pressed in between counts as pressed now.
        """
        keys, before, stop = bytearray(_KEY_BYTES), self._state.held, self._layout.stop
        self._ioctl(self._fd, _EVIOCGKEY, keys)
        held = {code for code in range(8 * _KEY_BYTES) if keys[code // 8] >> (code % 8) & 1}
        self._state.stops += stop in held and stop not in before
        self._state.held = held
        for axis in self._ranges:
            buffer = bytearray(_ABSINFO.size)
            self._ioctl(self._fd, _evioc_gabs(axis), buffer)
            self._axis(axis, _ABSINFO.unpack(buffer)[0])

    def _take(self, data: bytes) -> None:
        if not data:
            self._lose(f"{self.path} is gone: end of file")
            return
        event = _JS_EVENT if self._js else _EVENT
        data = self._rest + data
        whole = len(data) // event.size * event.size
        self._rest = data[whole:]
        for fields in event.iter_unpack(data[:whole]):
            if self._js:
                _, value, kind, number = fields
                if kind & ~_JS_INIT == _JS_BUTTON:
                    self._button(number, value != 0, counts=not kind & _JS_INIT)
                elif kind & ~_JS_INIT == _JS_AXIS:
                    self._state.axes[number] = value / 32767.0
                continue
            _, _, kind, code, value = fields
            if kind == _KEY and value != 2:  # 2 is a repeat
                self._button(code, value != 0)
            elif kind == _ABS:
                self._axis(code, value)
            elif kind == _SYN and code == _SYN_DROPPED:
                self._ask()

    def _button(self, code: int, pressed: bool, counts: bool = True) -> None:
        if pressed and counts and code not in self._state.held:
            self._state.stops += code == self._layout.stop
            self._state.rearms += code == self._layout.rearm
        (self._state.held.add if pressed else self._state.held.discard)(code)

    def _axis(self, code: int, value: int) -> None:
        if code in self._ranges:
            low, high = self._ranges[code]
            self._state.axes[code] = 2.0 * (value - low) / (high - low) - 1.0

    def _hands(self) -> Hands:
        state, layout = self._state, self._layout
        nothing = Hands(stops=state.stops, rearms=state.rearms, connected=False, text=self._trouble)
        if self._fd is None:
            return nothing
        return replace(
            nothing,
            human=layout.human in state.held,
            autonomy=layout.autonomy in state.held,
            throttle=_beyond(-state.axes.get(layout.throttle, 0.0)),
            steering=_beyond(-state.axes.get(layout.steering, 0.0)),
            connected=True,
            text=str(self.path),
        )


def _beyond(value: float) -> float:
    """Value without its dead zone, -1..1."""
    beyond = max(0.0, min(1.0, (abs(value) - _DEAD_ZONE) / (1.0 - _DEAD_ZONE)))
    return beyond if value > 0.0 else -beyond
