"""Checks that a camera keeps its contract (`hardware.cameras.interface`), with one finding for each part of it."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.cameras.interface import Camera, Frame
from hardware.cameras.steady import SteadyCamera
from hardware.errors import DeviceBusy, DeviceNotFound, LinkLost
from nodes.runtime.findings import CheckFinding, MetButLook, NotMet, form_of, look
from nodes.runtime.inbox import Inbox, ReaderThread

_FRAMES = 4
# Devices need some seconds for their first frame.
_FRAME_S = 10.0
_READ_S = 0.2
_POLLS = 50
# Each read with a short timeout must return within this time even on a busy computer, and the shortest of several much sooner.
_LATE_S = 2.0
_TRIES, _SHORT_S, _SHORTEST_S = 5, 0.03, 0.3
# Frames that wait during a pause of at most so long, and most that may come at once: the newest, and those that arrive meanwhile.
_WAITING, _PAUSE_S, _AT_ONCE = 8, 3.0, 2.5
# A part opens a device several times, and waits for a few frames of it.
_MOST_S = 120.0
_OLDEST_NS, _CLOCKS_NS = 1_000_000_000, 20_000_000
_DROPPED_NS = 200_000_000  # default of the camera node's max_age_s
COLOURS = ("red", "green", "blue")
Read = Callable[[float], Frame | None]


def _nothing() -> None:
    """Default of `produce`: a real device exposes frames by itself."""


@dataclass(frozen=True)
class CameraBench:
    """A closed camera under test. Every check opens it and leaves it closed.

    Attributes:
        produce: Makes an emulated device expose a frame.
        shows: Colour of the object before the camera, from `COLOURS`; empty if unknown.
        seen: Frames that the checks took; the last one is for a person to inspect.
    """

    camera: Camera
    produce: Callable[[], None] = _nothing
    shows: str = ""
    seen: list[Frame] = field(default_factory=list)

    @contextmanager
    def opened(self) -> Iterator[Camera]:
        """The camera, open."""
        try:
            self.camera.open()
            yield self.camera
        finally:
            self.camera.close()

    def frame(self, read: Read | None = None) -> Frame:
        """The next frame.

        Args:
            read: Read function; the camera's own `read` if None.

        Raises:
            NotMet: No frame comes.
        """
        deadline = time.monotonic() + _FRAME_S
        while time.monotonic() < deadline:
            self.produce()
            if (found := (read or self.camera.read)(_READ_S)) is not None:
                if not isinstance(found, Frame):
                    raise NotMet(
                        f"expected read() to return a hardware.cameras.interface.Frame or None, got {form_of(found)}"
                    )
                self.seen[:] = [found]
                return found
        raise NotMet(f"expected a frame within {_FRAME_S:g} s, got none; return the newest frame from read()")


Check = Callable[[CameraBench], str]


def closed_is_an_error(bench: CameraBench) -> str:
    """Reading a camera that is not open raises `LinkLost`; closing is harmless at any time."""
    bench.camera.close()
    _refuses_to_read(bench.camera, "before open()")
    with bench.opened():
        bench.frame()
    bench.camera.close()
    _refuses_to_read(bench.camera, "after close()")
    return "read() raises LinkLost before open() and after close(); close() may be called again"


def _refuses_to_read(camera: Camera, when: str) -> None:
    try:
        found = camera.read(0.01)
    except LinkLost:
        return
    except Exception as error:  # a plug-in may raise anything
        raise NotMet(
            f"expected read() {when} to raise hardware.errors.LinkLost, got {type(error).__name__}: {error}"
        ) from None
    raise NotMet(
        f"expected read() {when} to raise hardware.errors.LinkLost, got {'None' if found is None else 'a frame'}"
    )


def frames_have_their_form(bench: CameraBench) -> str:
    """Images are ``[H, W, 3]`` uint8, contiguous, read-only and not written into again, and all of one size; a sensor's differ."""
    frames: list[Frame] = []
    copies: list[NDArray[Any]] = []
    with bench.opened():
        for _ in range(_FRAMES):
            frames.append(bench.frame())
            copies.append(np.array(frames[-1].rgb))
    for frame in frames:
        rgb = frame.rgb
        formed = isinstance(rgb, np.ndarray) and rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype == np.uint8
        if not formed or not rgb.size:
            raise NotMet(f"expected rgb [H, W, 3] uint8, got {form_of(rgb)}; convert the image")
        if not rgb.flags.c_contiguous:
            raise NotMet("expected contiguous pixels, got a view; use numpy.ascontiguousarray")
        if rgb.flags.writeable:
            raise NotMet("expected read-only pixels; set rgb.flags.writeable = False")
    if any(not np.array_equal(frame.rgb, copy) for frame, copy in zip(frames, copies, strict=True)):
        raise NotMet(
            "expected pixels that stay, got a frame that a later read() has written into: each node would see half of two pictures; return a copy"
        )
    sizes = {frame.rgb.shape for frame in frames}
    if len(sizes) > 1:
        raise NotMet(f"expected images of one size, got {sorted(sizes)}")
    height, width, _ = frames[0].rgb.shape
    found = f"{width} x {height}, uint8 RGB, read-only"
    if all(np.array_equal(frames[0].rgb, frame.rgb) for frame in frames) and not frames[0].simulated:
        raise MetButLook(
            f"{found}; {_FRAMES} identical pictures: a sensor's noise makes them differ, so the camera node withholds repeated ones (repeats: 0 ends that)"
        )
    return found


def stamps_rise(bench: CameraBench) -> str:
    """Both stamps rise, are of the same instant, and lie within the last second; frame numbers rise."""
    with bench.opened():
        frames = [bench.frame() for _ in range(_FRAMES)]
    real_ns, mono_ns = time.time_ns(), time.monotonic_ns()
    for frame in frames:
        for name in ("stamp_mono_ns", "stamp_realtime_ns", "sequence"):
            if not isinstance(value := getattr(frame, name), int | np.integer):
                raise NotMet(
                    f"expected a whole number for {name}, got {value!r}; use time.time_ns and time.monotonic_ns"
                )
    for before, after in itertools.pairwise(frames):
        for name in ("stamp_mono_ns", "stamp_realtime_ns", "sequence"):
            if not getattr(after, name) > getattr(before, name):
                raise NotMet(
                    f"expected {name} to rise, got {getattr(before, name)}, then {getattr(after, name)}"
                )
    for frame in frames:
        apart_ns = (frame.stamp_realtime_ns - frame.stamp_mono_ns) - (real_ns - mono_ns)
        if abs(apart_ns) > _CLOCKS_NS:
            raise NotMet(
                f"expected both stamps to be of one instant, got {apart_ns / 1e9:.3f} s between them; take"
                " stamp_realtime_ns from time.time_ns and stamp_mono_ns from time.monotonic_ns"
            )
    age_ns = mono_ns - frames[-1].stamp_mono_ns
    if not 0 <= age_ns < _OLDEST_NS:
        raise NotMet(f"expected a stamp of the last second, got one {age_ns / 1e9:.3f} s ago")
    rate_hz = (_FRAMES - 1) * 1e9 / (frames[-1].stamp_mono_ns - frames[0].stamp_mono_ns)
    found = f"rise on both clocks; age {age_ns / 1e6:.1f} ms, {rate_hz:.1f} Hz over {_FRAMES} frames"
    if age_ns > _DROPPED_NS:
        raise MetButLook(
            f"{found}; the camera node drops frames older than its max_age_s, {_DROPPED_NS / 1e9:g} s if it is not set"
        )
    return found


def opens_twice(bench: CameraBench) -> str:
    """`open` on an open camera, and after `close`, starts again; stamps keep rising and no file stays open."""
    with bench.opened():
        stamps = [bench.frame().stamp_mono_ns]
        bench.camera.open()
        stamps.append(bench.frame().stamp_mono_ns)
    time.sleep(0.05)
    files = _open_files()
    with bench.opened():
        stamps.append(bench.frame().stamp_mono_ns)
    if stamps != sorted(set(stamps)):
        raise NotMet(f"expected stamps that rise over every open(), got {stamps} ns")
    deadline = time.monotonic() + _LATE_S
    # A server may take a moment to notice that its client has left.
    while (left := _open_files() - files) > 0:
        if time.monotonic() > deadline:
            raise NotMet(f"expected close() to close every file and socket, got {left} left open")
        time.sleep(0.01)
    return "opens again while it is open and after close(); nothing stays open"


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def gives_up_in_time(bench: CameraBench) -> str:
    """`read` returns soon after its timeout, also when there is no frame."""
    taken_s = []
    with bench.opened():
        bench.frame()
        for _ in range(_TRIES):
            began = time.monotonic()
            bench.camera.read(_SHORT_S)
            taken_s.append(time.monotonic() - began)
    # A busy computer delays some reads, not the shortest of them.
    for found_s, most_s in ((max(taken_s), _LATE_S), (min(taken_s), _SHORTEST_S)):
        if found_s > most_s:
            raise NotMet(
                f"expected read({_SHORT_S:g}) to return within its timeout, got {found_s:.2g} s; wait no longer than timeout_s"
            )
    return f"read() of at most {1e3 * _SHORT_S:.0f} ms took {1e3 * max(taken_s):.0f} ms"


def newest_comes_first(bench: CameraBench) -> str:
    """After a pause `read` returns the newest frame, and none of those before it: in a queue, each frame is older than the car believes."""
    with bench.opened():
        stamps_ns = [bench.frame().stamp_mono_ns for _ in range(_FRAMES)]
        period_s = (stamps_ns[-1] - stamps_ns[0]) / 1e9 / (_FRAMES - 1)
        for _ in range(_WAITING):
            bench.produce()
            time.sleep(min(period_s, _PAUSE_S / _WAITING))
        began, got = time.monotonic(), 0
        while got < _POLLS and bench.camera.read(0.0) is not None:
            got += 1
        came = (time.monotonic() - began) / max(period_s, 1e-6)
    if got > came + _AT_ONCE:
        raise NotMet(
            f"expected the newest frame after a pause, got {got} frames at once: read() hands out a queue; read the device until it is empty, and return "
            "the last one"
        )
    return f"{_WAITING} frames later, one is new"


class _Clock:
    """A clock that tests move by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def stall_is_noticed(bench: CameraBench) -> str:
    """A device without a new frame gives None, so that the camera node notices a stall and opens the device again."""
    clock = _Clock()
    camera = SteadyCamera(bench.camera, stall_s=1.0, now_s=clock, sleep=clock.sleep)
    try:
        camera.read(0.0)  # opens it
        bench.frame(camera.read)
        for _ in range(_POLLS):
            clock.now_s += 1.1
            if camera.read(0.0) is None:
                break
        else:
            raise NotMet(
                f"expected read(0) to return None while there is no new frame, got a frame {_POLLS} times in a row"
            )
        if not camera.counters()["camera_stalls"]:
            raise NotMet(f"expected a stall to be noticed, got {camera.error or 'no error'}")
        clock.sleep(1.0)
        camera.read(0.0)  # opens it again
        bench.frame(camera.read)
        if camera.error or not camera.counters()["camera_reopened"]:
            raise NotMet(f"expected the device to be opened again after a stall, got {camera.error!r}")
    finally:
        camera.close()
    return "noticed after the time in stall_s; the device was opened again"


def one_thread_reads(bench: CameraBench) -> str:
    """A thread other than the one that made the camera opens it and reads it, as in the camera node."""
    inbox: Inbox[Frame] = Inbox(capacity=2)
    camera = SteadyCamera(bench.camera)
    reader = ReaderThread(lambda: camera.read(0.02), inbox, "camera")
    reader.start()
    got: list[Frame] = []
    deadline = time.monotonic() + 2.0 * _FRAME_S
    try:
        while len(got) < _FRAMES and time.monotonic() < deadline:
            if camera.is_open:
                bench.produce()
            got += inbox.take()
            time.sleep(0.005)
    finally:
        reader.stop()
        camera.close()
        inbox.close()
    stamps = [frame.stamp_mono_ns for frame in got]
    if len(got) < _FRAMES or stamps != sorted(set(stamps)):
        raise NotMet(
            f"expected {_FRAMES} frames in order, got {len(got)}: {camera.error or 'no error'}; a thread of its own reads the camera"
        )
    return f"{len(got)} frames in order"


def counters_are_numbers(bench: CameraBench) -> str:
    """`counters` are numbers by name, and intrinsics, if any, match the delivered images."""
    with bench.opened() as camera:
        frame = bench.frame()
        counters, pinhole = camera.counters(), camera.pinhole
    wrong = [
        name
        for name, value in counters.items()
        if not isinstance(name, str) or isinstance(value, bool) or not isinstance(value, int | float)
    ]
    if wrong:
        raise NotMet(f"expected counters that are numbers, got {wrong[0]!r}: {counters[wrong[0]]!r:.60}")
    if pinhole is not None and (pinhole.height, pinhole.width) != frame.rgb.shape[:2]:
        raise NotMet(
            f"expected intrinsics of the delivered images, got those of {pinhole.width} x {pinhole.height}"
        )
    return f"{', '.join(counters) or 'no counters'}; {'no ' if pinhole is None else ''}factory intrinsics"


def colours_are_in_order(bench: CameraBench) -> str:
    """The first channel is red."""
    if not bench.shows:
        return "not checked: hold something red before the camera, and say --shows red"
    with bench.opened():
        rgb = bench.frame().rgb
    means = rgb.reshape(-1, 3).mean(axis=0)
    if COLOURS[int(means.argmax())] != bench.shows:
        raise NotMet(
            f"expected most of {bench.shows} before it, got means of red {means[0]:.0f}, green {means[1]:.0f}, blue"
            f" {means[2]:.0f}; OpenCV's images are BGR"
        )
    return f"{bench.shows} is {bench.shows}"


CHECKS: dict[str, Check] = {
    "frames": frames_have_their_form,
    "stamps": stamps_rise,
    "colours": colours_are_in_order,
    "closed": closed_is_an_error,
    "reopening": opens_twice,
    "timeout": gives_up_in_time,
    "newest": newest_comes_first,
    "stall": stall_is_noticed,
    "thread": one_thread_reads,
    "counters": counters_are_numbers,
}
"""Parts of the contract, in the order of the report."""


def check_camera(bench: CameraBench, most_s: float = _MOST_S) -> list[CheckFinding]:
    """A finding for each part of the contract; the first one alone if there are no frames of the right form.

    Args:
        most_s: A part that takes longer has a call that does not return, and ends the report.

    Raises:
        DeviceNotFound: The device does not exist.
        DeviceBusy: Another program has it.
    """
    findings: list[CheckFinding] = []
    for name, check in CHECKS.items():
        returned: list[CheckFinding | Exception] = []
        # A thread of its own, which does not keep the program from ending.
        thread = threading.Thread(target=_look_into, args=(returned, name, check, bench), daemon=True)
        thread.start()
        thread.join(most_s)
        if not returned:
            text = f"expected each call to return, but this part has not ended after {most_s:g} s; make read(timeout_s) return None after its time-out, and open() and close() return"
            return [*findings, CheckFinding(name, "not met", text)]
        if isinstance(returned[0], Exception):
            raise returned[0]
        findings.append(returned[0])
        if not findings[0].met:
            break
    return findings


def _look_into(returned: list[CheckFinding | Exception], name: str, check: Check, bench: CameraBench) -> None:
    try:
        returned.append(look(name, check, bench, (DeviceNotFound, DeviceBusy)))
    except Exception as error:  # for the thread that waits
        returned.append(error)
