"""The README's film from a finished run: ``python -m benchmarks.film runs/demo docs/demo.webp``."""

from __future__ import annotations

import argparse
from pathlib import Path

import av
from PIL import Image

from advnerf_core.files import write_atomically
from advnerf_core.report.clips import webp

WIDTH_PX, QUALITY = 780, 60


def frames_of(film: Path, width_px: int) -> tuple[list[Image.Image], float]:
    """Frames of a film, scaled to a width [px], and how long each is shown [ms]."""
    with av.open(str(film)) as container:
        stream = container.streams.video[0]
        rate_hz = float(stream.average_rate or 10)
        pictures = [frame.to_image() for frame in container.decode(stream)]
    size = (width_px, round(pictures[0].height * width_px / pictures[0].width))
    return [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures], 1000.0 / rate_hz


def main() -> None:
    """Write the report's film of a run as an animated picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    frames, shown_ms = frames_of(next((arguments.run_folder / "report").glob("*.mp4")), WIDTH_PX)
    data = webp(frames, shown_ms, QUALITY)
    write_atomically(arguments.picture, data)
    print(f"wrote {arguments.picture}: {len(frames)} frames, {len(data) / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
