"""Camera in the loop: shows each colour on a screen, waits until the camera sees it, and stores the images."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import write_image
from advnerf_core.files import write_atomically
from calibration.schema import CalibrationError
from hardware.screen.display import Display
from nodes.lab.wizards.bags import IMAGES
from nodes.runtime.bus import Bus
from nodes.runtime.messages import stamp_ns
from nodes.runtime.pictures import rgb_image

Rgb = NDArray[np.uint8]
# Frames to skip, because their exposure may have started before the flip or during it.
SETTLE_FRAMES, AVERAGE_FRAMES = 3, 8
_LONGEST_WAIT_S = 5.0


def show_and_watch(
    display: Display,
    frames: Iterator[tuple[int, Rgb]],
    colours: Sequence[Sequence[int]],
    folder: Path,
    report: Callable[[float, str], None] | None = None,
    now_ns: Callable[[], int] = time.time_ns,
) -> Path:
    """Record a folder for `nodes.lab.wizards.bags.read_shown`.

    Args:
        frames: Endless stream of stamps [ns since 1970] and RGB images ``[H, W, 3]``.
        colours: Colours to show, 0..255.
        folder: New or empty folder.

    Raises:
        CalibrationError: The folder already has a session.
    """
    table = folder / "shown.csv"
    if table.exists():
        raise CalibrationError(
            f"expected a new folder, but {folder} already has a session; choose another, or remove --screen to use it"
        )
    width, height = display.size_px
    lines = ["file,red,green,blue"]
    for index, colour in enumerate(colours):
        if report is not None:
            report(index / len(colours), f"colour {index + 1} of {len(colours)}")
        display.show(np.full((height, width, 3), colour, np.uint8))
        for number, picture in enumerate(_after(frames, now_ns(), display)):
            name = f"seen/{index:03d}_{number}.png"
            write_image(folder / name, picture)
            lines.append(",".join([name, *(str(int(value)) for value in colour)]))
    # Written last, so that a stopped session has no table and can be restarted.
    write_atomically(table, "\n".join(lines) + "\n")
    return folder


def live_frames(run_dir: Path) -> Iterator[tuple[int, Rgb]]:
    """Yield the frames of the running launch as they arrive."""
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
                    f"expected frames on {IMAGES}, got none for {_LONGEST_WAIT_S:g} s; is the camera node running?"
                )


def _after(frames: Iterator[tuple[int, Rgb]], shown_ns: int, display: Display) -> Iterator[Rgb]:
    """Yield the frames to store for one colour."""
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
    raise CalibrationError("expected more frames, but the camera stopped; start again")
