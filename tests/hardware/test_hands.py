"""Gamepads by the bytes of the kernel's structures through FIFOs, keyboards through a pty."""

import os
import pty
import struct
import termios

import pytest

from hardware.errors import HardwareError
from hardware.operator.gamepad import Gamepad
from hardware.operator.keyboard import Keyboard

pytestmark = pytest.mark.live

KEY, ABS, SYN = 1, 3, 0


class Device:
    """An event device: a FIFO for its events, and answers to its ioctls by the kernel's numbers."""

    def __init__(self, folder, name="event7"):
        self.path = folder / name
        os.mkfifo(self.path)
        self.keys, self.now_ns = set(), 0
        self.values = {1: 0, 3: 0}
        self.pad = Gamepad(self.path, lambda: self.now_ns, ioctl=self.ioctl)
        self.pad.read(0.0)
        self.fd = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)

    def ioctl(self, fd, request, buffer):
        if request == 0x80604518:  # EVIOCGKEY(96)
            for code in self.keys:
                buffer[code // 8] |= 1 << (code % 8)
        else:
            axis = (request & 0xFF) - 0x40
            assert request == 0x80184540 + axis  # EVIOCGABS(axis)
            buffer[:] = struct.pack("6i", self.values[axis], -32768, 32767, 16, 128, 0)

    def send(self, *events):
        os.write(self.fd, b"".join(struct.pack("llHHi", 1, 2, *event) for event in events))
        return self.pad.read(0.0)


@pytest.fixture
def device(tmp_path):
    device = Device(tmp_path)
    yield device
    device.pad.close()


def test_buttons_count_as_held_whatever_else_is_pressed(device):
    assert not device.pad.read(0.0).human
    assert device.send((KEY, 0x136, 1), (SYN, 0, 0)).human
    both = device.send((KEY, 0x130, 1), (KEY, 0x137, 1))
    assert both.human
    assert both.autonomy
    after = device.send((KEY, 0x136, 0))
    assert (after.human, after.autonomy) == (False, True)


def test_axes_are_left_and_forward_positive_with_a_dead_zone(device):
    hands = device.send((ABS, 1, -32768), (ABS, 3, 32767))
    assert (hands.throttle, hands.steering) == (pytest.approx(1.0), pytest.approx(-1.0))
    hands = device.send((ABS, 1, 800), (ABS, 3, -16384))
    assert hands.throttle == 0.0
    assert hands.steering == pytest.approx((0.5 - 0.05) / 0.95, abs=1e-3)


def test_stop_and_rearm_are_counted_once_per_press(device):
    assert device.send((KEY, 0x131, 1), (KEY, 0x131, 2), (KEY, 0x131, 2)).stops == 1
    hands = device.send((KEY, 0x131, 0), (KEY, 0x131, 1), (KEY, 0x13B, 1))
    assert (hands.stops, hands.rearms) == (2, 1)


def test_a_release_among_dropped_events_is_asked_for(device):
    device.send((KEY, 0x137, 1))
    device.keys = set()
    assert not device.send((SYN, 3, 0)).autonomy
    device.keys = {0x136}
    assert device.send((SYN, 3, 0)).human


def test_a_stop_among_dropped_events_is_a_stop(device):
    device.send((KEY, 0x137, 1))
    device.keys = {0x137, 0x131}
    assert device.send((SYN, 3, 0)).stops == 1
    assert device.send((SYN, 3, 0)).stops == 1
    device.keys = {0x137}
    assert device.send((SYN, 3, 0)).stops == 1
    device.keys = {0x137, 0x131}
    assert device.send((SYN, 3, 0)).stops == 2


def test_events_cut_in_two_are_put_together(device):
    whole = struct.pack("llHHi", 1, 2, KEY, 0x137, 1)
    os.write(device.fd, whole[:10])
    assert not device.pad.read(0.0).autonomy
    os.write(device.fd, whole[10:])
    assert device.pad.read(0.0).autonomy


def test_unplugging_lets_go_and_plugging_in_again_is_found(device):
    device.send((KEY, 0x137, 1))
    os.close(device.fd)
    hands = device.pad.read(0.0)
    assert not hands.connected
    assert not hands.autonomy
    assert "gone" in hands.text
    device.path.unlink()
    device.now_ns += 600_000_000
    assert "plugged in" in device.pad.read(0.0).text
    os.mkfifo(device.path)
    device.now_ns += 600_000_000
    assert device.pad.read(0.0).connected
    device.fd = os.open(device.path, os.O_WRONLY)
    assert device.send((KEY, 0x136, 1)).human


def test_the_older_joystick_interface(tmp_path):
    os.mkfifo(tmp_path / "js0")
    pad = Gamepad(tmp_path / "js0", lambda: 0)
    pad.read(0.0)
    fd = os.open(tmp_path / "js0", os.O_WRONLY)
    # The state at opening comes as events with the flag 0x80: held counts, pressed does not.
    for event in ((1, 1, 0x81, 1), (1, 1, 0x81, 5), (2, -32767, 2, 1), (3, 16384, 2, 3)):
        os.write(fd, struct.pack("IhBB", *event))
    hands = pad.read(0.0)
    assert (hands.human, hands.autonomy, hands.stops) == (False, True, 0)
    assert hands.throttle == pytest.approx(1.0)
    assert hands.steering == pytest.approx(-(0.5 - 0.05) / 0.95, abs=1e-3)
    pad.close()
    os.close(fd)


class Terminal:
    def __init__(self):
        self.master, self.slave = pty.openpty()
        self.before = termios.tcgetattr(self.slave)
        self.ms = 1000
        self.keyboard = Keyboard(self.slave, lambda: self.ms * 1_000_000)

    def type(self, keys, after_ms=30):
        self.ms += after_ms
        os.write(self.master, keys.encode())
        return self.keyboard.read(0.5)

    def wait(self, ms):
        self.ms += ms
        return self.keyboard.read(0.0)


@pytest.fixture
def terminal():
    terminal = Terminal()
    yield terminal
    terminal.keyboard.close()
    os.close(terminal.slave)
    os.close(terminal.master)


def test_a_tap_never_drives_and_holding_does(terminal):
    assert not terminal.type("w").human
    assert not terminal.wait(300).human
    assert not terminal.type("w", 500).human  # the first repeat comes after the terminal's delay
    assert not terminal.type("w").human
    held = terminal.type("w")
    assert (held.human, held.throttle, held.steering) == (True, 1.0, 0.0)
    assert terminal.wait(100).human
    assert not terminal.wait(60).human


@pytest.mark.parametrize("burst", ["w", "wwwwwwww"])
def test_a_key_that_is_still_held_after_a_pause_of_the_terminal_must_be_let_go(terminal, burst):
    """As of a process that was stopped, or of ssh: the car would move again although nobody has pressed anything."""
    for _ in range(4):
        held = terminal.type("w")
    assert held.human
    assert not terminal.type(burst, 1500).human
    for _ in range(30):
        assert not terminal.type("w").human
    assert not terminal.type("w", 800).human  # the next pause changes nothing
    for _ in range(10):
        assert not terminal.type("w").human
    assert not terminal.type("w", 400).human  # let go and pressed again,
    assert not terminal.type("w", 250).human  # which repeats after the terminal's delay
    terminal.type("w")
    assert terminal.type("w").human


def test_another_key_must_be_held_itself(terminal):
    for _ in range(4):
        held = terminal.type("o")
    assert held.autonomy
    assert not terminal.type("a").human
    terminal.type("a")
    left = terminal.type("a")
    assert (left.human, left.autonomy, left.steering) == (True, False, 1.0)


def test_keys_pasted_at_once_hold_nothing(terminal):
    hands = terminal.type("wwwwwwwwwwww wr")
    assert (hands.human, hands.stops, hands.rearms) == (False, 1, 1)


@pytest.mark.parametrize(
    "sent",
    [
        b"\x1b[D",
        b"\x1b[A",
        b"\x1b[C",
        b"\x1bOD",
        b"\x1bOS",
        b"\x1b[1;5D",
        b"\x1b[15~",
        b"\x1bd",
        b"\x1bO\x1b[D",
    ],
)
def test_arrows_function_keys_and_alt_never_drive(terminal, sent):
    """The sequence of the left arrow ends with a D, which is no key that was pressed."""
    for _ in range(4):
        hands = terminal.type(sent.decode())
        assert (hands.human, hands.autonomy, hands.rearms) == (False, False, 0)
    # It also ends what was held.
    for _ in range(4):
        held = terminal.type("w")
    assert held.human
    assert not terminal.type(sent.decode()).human


def test_a_sequence_cut_in_two_is_one_and_a_stop_is_never_part_of_one(terminal):
    for _ in range(4):
        assert not terminal.type("\x1b[").human
        assert not terminal.type("D").human
    assert terminal.type("\x1b").stops == 0
    assert terminal.type(" ").stops == 1  # Esc and then space, which look like Alt and space
    assert terminal.type("\x1b ").stops == 2
    for _ in range(3):
        held = terminal.type("w")
    assert held.human


def test_the_terminal_is_given_back_and_no_terminal_is_refused(terminal, tmp_path):
    assert not termios.tcgetattr(terminal.slave)[3] & termios.ICANON
    terminal.keyboard.close()
    assert termios.tcgetattr(terminal.slave) == terminal.before
    with open(tmp_path / "file", "w") as file, pytest.raises(HardwareError, match="expected a terminal"):
        Keyboard(file.fileno(), lambda: 0)
