"""The README's film from a finished run: ``python -m benchmarks.film runs/demo docs/demo.webp``.

With moments, a still picture: a row for each moment, a column for each film of some cells, as in
``python -m benchmarks.film runs/junction_demo docs/intersection_attack.webp --cells "straight_hardened_*_0" --at 1.0 2.5``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
from PIL import Image

from advnerf_core.files import write_atomically
from advnerf_core.report.clips import webp

WIDTH_PX, QUALITY = 780, 40
_EVERY = 2  # frames, at ten a second
# Methods in the order of their columns; others come between.
_ORDER = ("none", "random", "gradient")


def _column(film: Path) -> float:
    method = next((part for part in film.parent.name.split("_") if part in _ORDER), "")
    return _ORDER.index(method) if method else 1.5


def frames_of(film: Path, width_px: int) -> tuple[list[Image.Image], float]:
    """Frames of a film, scaled to a width [px], and how long each is shown [ms]."""
    with av.open(str(film)) as container:
        stream = container.streams.video[0]
        rate_hz = float(stream.average_rate or 10)
        pictures = [frame.to_image() for frame in container.decode(stream)]
    size = (width_px, round(pictures[0].height * width_px / pictures[0].width))
    return [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures], 1000.0 / rate_hz


def stills(films: list[Path], moments_s: list[float], width_px: int) -> Image.Image:
    """A row for each moment [s], a column for each film, ``width_px`` wide in all."""
    columns = [frames_of(film, width_px // len(films)) for film in films]
    width, height = columns[0][0][0].size
    picture = Image.new("RGB", (width * len(films), height * len(moments_s)))
    for row, moment_s in enumerate(moments_s):
        for column, (frames, shown_ms) in enumerate(columns):
            frame = frames[min(round(1000.0 * moment_s / shown_ms), len(frames) - 1)]
            picture.paste(frame, (column * width, row * height))
    return picture


def main() -> None:
    """Write the report's film of a run as an animated picture, or moments of some cells' films as a still one."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--cells", default="*", help="pattern of the cells of a still picture")
    parser.add_argument("--at", type=float, nargs="*", default=[], help="moments of a still picture [s]")
    arguments = parser.parse_args()
    if arguments.at:
        films = sorted((arguments.run_folder / "cells").glob(f"{arguments.cells}/clip.mp4"), key=_column)
        picture = stills(films, arguments.at, WIDTH_PX)
        picture.save(arguments.picture, quality=QUALITY)
        print(f"wrote {arguments.picture}: {arguments.picture.stat().st_size / 1024:.0f} KiB")
        return
    frames, shown_ms = frames_of(next((arguments.run_folder / "report").glob("*.mp4")), WIDTH_PX)
    frames, shown_ms = frames[::_EVERY], _EVERY * shown_ms
    data = webp(frames, shown_ms, QUALITY)
    write_atomically(arguments.picture, data)
    print(f"wrote {arguments.picture}: {len(frames)} frames, {len(data) / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
