"""The camera in the loop: show each colour on a screen, wait until the camera sees it, keep what it saw."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from calibration.schema import CalibrationError
from hardware.screen.display import Display
from nodes.lab.wizards.bags import IMAGES
from nodes.runtime.bus import Bus
from nodes.runtime.messages import stamp_ns
from nodes.runtime.pictures import rgb_image

Rgb = NDArray[np.uint8]
# Frames whose exposure may have begun before the flip, or that show it half-way.
SETTLE_FRAMES, AVERAGE_FRAMES = 3, 8
_LONGEST_WAIT_S = 5.0


def show_and_watch(
    display: Display, frames: Iterator[tuple[int, Rgb]], colours: Sequence[Sequence[int]], folder: Path,
    report: Callable[[float, str], None] | None = None, now_ns: Callable[[], int] = time.time_ns,
) -> Path:  # fmt: skip
    """Fill a folder for `nodes.lab.wizards.bags.read_shown`.

    Args:
        display: The screen.
        frames: Stamp [ns since 1970] and picture ``[H, W, 3]`` RGB, as they come, without end.
        colours: What to show, 0..255.
        folder: New or empty folder.
        report: Told of the progress.
        now_ns: Real time [ns].

    Raises:
        CalibrationError: The folder holds another session.
    """
    table = folder / "shown.csv"
    if table.exists():
        raise CalibrationError(
            f"expected a new folder, {folder} holds a session already; choose another, or leave --screen out to use it"
        )
    width, height = display.size_px
    lines = ["file,red,green,blue"]
    for index, colour in enumerate(colours):
        if report is not None:
            report(index / len(colours), f"colour {index + 1} of {len(colours)}")
        display.show(np.full((height, width, 3), colour, np.uint8))
        for number, picture in enumerate(_after(frames, now_ns(), display)):
            name = f"seen/{index:03d}_{number}.png"
            write_atomically(folder / name, cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes())
            lines.append(",".join([name, *(str(int(value)) for value in colour)]))
    # Last: a session that was stopped has no table and can be begun again.
    write_atomically(table, "\n".join(lines) + "\n")
    return folder


def live_frames(run_dir: Path) -> Iterator[tuple[int, Rgb]]:
    """Frames of the running launch as they come."""
    with Bus(run_dir) as bus:
        bus.subscribe(IMAGES)
        heard = time.monotonic()
        while True:
            bus.wait(0.1)
            for received in bus.receive():
                heard = time.monotonic()
                message = received.message()
                yield stamp_ns(message), rgb_image(message, IMAGES)
            if time.monotonic() - heard > _LONGEST_WAIT_S:
                raise CalibrationError(
                    f"expected frames on {IMAGES}, heard none for {_LONGEST_WAIT_S:g} s; is the camera node running?"
                )


def _after(frames: Iterator[tuple[int, Rgb]], shown_ns: int, display: Display) -> Iterator[Rgb]:
    """The frames to keep of one colour."""
    taken = 0
    for stamp, picture in frames:
        display.keep_alive()
        if stamp <= shown_ns:
            continue
        taken += 1
        if taken > SETTLE_FRAMES:
            yield picture
        if taken == SETTLE_FRAMES + AVERAGE_FRAMES:
            return
    raise CalibrationError("expected frames without end, the camera stopped; begin again")
