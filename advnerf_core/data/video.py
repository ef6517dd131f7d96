"""Videos: frames in order, upright, with their times; and selected frames on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import Rgb, write_image
from advnerf_core.data.keyframes import BLUR_LIMIT, MAX_WAIT_S, WINDOW, Candidate, KeyframeSelector
from advnerf_core.documents import read_json
from advnerf_core.files import write_json

T = TypeVar("T")

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
_RECORD = "keyframes.json"
_SQUARE = 1e-3


def read_video(path: Path) -> Iterator[tuple[int, float, float, Rgb]]:
    """Frames of a video: number, time [s], elapsed share of the video (0..1), image ``[H, W, 3]`` uint8, upright, of square
    pixels.

    Raises:
        DatasetError: The file is not a video, or not one frame of it can be read. A damaged end only ends the video early.
    """
    import av

    number = 0
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            if not container.streams.video:
                raise DatasetError(f"expected a video, got {path} without a picture; give another file")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            length_s = float(container.duration / av.time_base) if container.duration else 0.0
            for frame in container.decode(stream):
                time_s = float(frame.time) if frame.time is not None else float(number)
                share = min(max(time_s / length_s, 0.0), 1.0) if length_s > 0.0 else 0.0
                # Phones store the sensor's picture and a rotation for display.
                turns = round(getattr(frame, "rotation", 0) / 90.0) % 4
                rgb = np.ascontiguousarray(np.rot90(_square_pixels(frame, stream), turns))
                yield number, time_s, share, rgb
                number += 1
    except (av.error.FFmpegError, OSError) as error:
        if number == 0:
            raise DatasetError(
                f"expected a video that can be decoded, got {path}: {getattr(error, 'strerror', None) or error}; "
                "copy it again, or convert it to MP4 (H.264)"
            ) from error
    if number == 0:
        raise DatasetError(f"expected a video with frames, got {path} without any; copy it again")


def _square_pixels(frame: Any, stream: Any) -> Rgb:
    """A frame's image with pixels as wide as high: some cameras store fewer columns than they show (1440 x 1080, anamorphic)."""
    rgb: Rgb = frame.to_ndarray(format="rgb24")
    aspect = float(stream.codec_context.sample_aspect_ratio or stream.sample_aspect_ratio or 1.0)
    if aspect <= 0.0 or abs(aspect - 1.0) < _SQUARE:
        return rgb
    height, width = rgb.shape[:2]
    size = (round(width * aspect), height) if aspect > 1.0 else (width, round(height / aspect))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def keep_keyframes(
    path: Path, folder: Path, movement: float, most: int, report: Callable[[float, str], None]
) -> list[Path]:
    """Write the selected frames of a video as JPEG files; finished files of an earlier run are reused.

    Args:
        folder: Folder of the files, which are named by their number in the video.
        movement: See `KeyframeSelector`.
        most: Largest number of frames, evenly thinned out.
        report: Progress callback, called with the finished share and the number of frames as text.

    Returns:
        The files, ordered by time.
    """
    key = _key(path, movement, most)
    if (done := _finished(folder, key)) is not None:
        return done
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.jpg"):  # from another choice, or an interrupted run
        old.unlink()
    selector, kept = KeyframeSelector(movement), []
    for number, time_s, share, rgb in read_video(path):
        if (chosen := selector.offer(number, time_s, rgb)) is not None:
            kept.append(_write(folder, chosen))
        report(share, f"{path.name}: {len(kept)} of {number + 1} frames kept")
    if (chosen := selector.last()) is not None:
        kept.append(_write(folder, chosen))
    rows = thinned(kept, most)
    for row in kept:
        if row not in rows:
            (folder / row["file"]).unlink()
    write_json(folder / _RECORD, {"key": key, "frames": rows})
    return [folder / row["file"] for row in rows]


def _write(folder: Path, frame: Candidate) -> dict[str, Any]:
    name = f"{frame.number:06d}.jpg"
    write_image(folder / name, frame.rgb)
    return {"file": name, "time_s": round(frame.time_s, 4), "sharpness": round(frame.sharpness, 2)}


def thinned(rows: list[T], most: int) -> list[T]:
    """At most so many of the rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return [rows[i] for i in np.linspace(0, len(rows) - 1, most).round().astype(int)]


def _key(path: Path, movement: float, most: int) -> str:
    # The content of a video is too long to read twice; its size and modification time replace it.
    try:
        state = path.stat()
    except OSError as error:
        raise DatasetError(f"expected a video at {path}, got: {error.strerror}") from error
    facts = {
        "file": str(path.resolve()),
        "bytes": state.st_size,
        "time": state.st_mtime_ns,
        "most": most,
        "movement": movement,
        "window": WINDOW,
        "blur_limit": BLUR_LIMIT,
        "max_wait_s": MAX_WAIT_S,
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _finished(folder: Path, key: str) -> list[Path] | None:
    try:
        record = read_json(folder / _RECORD)
        files = [folder / row["file"] for row in record["frames"]]
        return files if record["key"] == key and all(file.exists() for file in files) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
