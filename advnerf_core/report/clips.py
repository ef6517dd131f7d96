"""First-person clips: one or several drives side by side, captioned, small enough to embed in a page, as H.264 in MP4."""

from __future__ import annotations

import base64
import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont  # comes with matplotlib

from advnerf_core.data.video import read_video
from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import Film
from advnerf_core.report.palette import DARK

MAX_BYTES = 1_500_000
_QUALITIES = (24, 28, 32, 36, 40, 44)  # constant rate factors: larger is smaller and worse
_TITLE_PX, _STATUS_PX, _GAP_PX, _MIN_WIDTH_PX = 22, 22, 6, 320

Frames = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ClipTrack:
    """One drive in a clip.

    Attributes:
        title: Caption, such as "deployed, gradient".
        condition: Condition of the object, by its name in `conditions`; selects the colour.
        frames: First-person images, ``[N]`` of uint8 RGB ``[height, width, 3]``, one per control tick.
        cte_m: Signed cross-track error at the frames, ``[N]`` [m].
        attack_id: Short hash of the attack file; "" for none.
        note: Shown after the last frame, such as "stopped by the fence".
    """

    title: str
    condition: str
    frames: Sequence[Frames] | Frames
    cte_m: ArrayLike
    attack_id: str = ""
    note: str = "ended"

    def __post_init__(self) -> None:
        if len(self.frames) == 0 or len(self.frames) != len(np.asarray(self.cte_m)):
            raise ValueError(
                f"expected one cross-track error per frame of {self.title!r}, "
                f"got {len(self.frames)} frames and {np.asarray(self.cte_m).shape} errors"
            )


def write_clip(
    path: Path,
    tracks: Sequence[ClipTrack],
    rate_hz: float = 10.0,
    off_track_m: float = 0.4,
) -> Path:
    """Write drives side by side as one video, atomically, as fine as the size limit allows.

    Args:
        path: Output file, ``.mp4``.
        tracks: The drives, left to right, of one frame size; a shorter one holds its last frame.
        rate_hz: Frames per second.
        off_track_m: ``|CTE|`` above this is shown as off-track [m].
    """
    if not tracks:
        raise ValueError("expected at least one drive for a clip, got none")
    with _in_place_of(path) as temporary:
        for quality in _QUALITIES:
            frames = compose(tracks, rate_hz, off_track_m)
            _encode(temporary, rate_hz, frames, {"crf": str(quality), "preset": "slow", "tune": "animation"})
            size = temporary.stat().st_size
            if size <= MAX_BYTES:
                return path
        raise ValueError(
            f"expected clip {path.name} under {MAX_BYTES} bytes, got {size} at the coarsest setting: film fewer frames"
        )


def write_film(path: Path, tracks: Sequence[ClipTrack], rate_hz: float, off_track_m: float) -> Film:
    """Write drives side by side as `write_clip` does, the attacked one last."""
    file = write_clip(path, tracks, rate_hz, off_track_m)
    moment = int(np.abs(np.asarray(tracks[-1].cte_m)).argmax())
    return Film(file, tuple(each.title for each in tracks), moment)


def write_video(path: Path, frames: Iterable[Frames], rate_hz: float = 10.0) -> Path:
    """Write images ``[H, W, 3]`` of uint8 RGB as an H.264 video in MP4. The file appears when it is complete."""
    with _in_place_of(path) as temporary:
        _encode(temporary, rate_hz, frames, {})
    return path


@contextmanager
def _in_place_of(path: Path) -> Iterator[Path]:
    """A file to write, which then takes the place of a film; not after an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def compose(tracks: Sequence[ClipTrack], rate_hz: float = 10.0, off_track_m: float = 0.4) -> Iterator[Frames]:
    """Frames of the side-by-side video with their caption strips, ``[height, width, 3]``, both sides even."""
    steps = max(len(t.frames) for t in tracks)
    for step in range(steps):
        panels = [_panel(t, step, rate_hz, off_track_m) for t in tracks]
        heights = {p.shape[0] for p in panels}
        if len(heights) > 1:
            raise ValueError(f"expected drives of one frame size side by side, got heights {sorted(heights)}")
        gap = np.full((panels[0].shape[0], _GAP_PX, 3), ImageColor.getrgb(DARK["paper"]), np.uint8)
        row = np.concatenate([part for p in panels for part in (gap, p)][1:], axis=1)
        # 4:2:0 video has even sides.
        yield np.pad(row, ((0, row.shape[0] % 2), (0, row.shape[1] % 2), (0, 0)), mode="edge")


def read_clip(path: Path) -> Frames:
    """Decode a whole clip to RGB, ``[N, height, width, 3]``."""
    return np.stack([frame for *_, frame in read_video(path)])


def film_uri(file: Path) -> str:
    """A film, which `write_clip` wrote, as a data URI."""
    return _data_uri("video/mp4", file.read_bytes())


def image_uri(image: Frames, quality: int | None = None) -> str:
    """An RGB image as a data URI: PNG, or JPEG of the given quality."""
    kind, options = ("png", []) if quality is None else ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, quality])
    _, encoded = cv2.imencode(
        f".{kind}", cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), options
    )
    return _data_uri(f"image/{kind}", encoded.tobytes())


def _data_uri(media_type: str, data: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


def frame_of(path: Path, number: int) -> Frames:
    """One frame ``[height, width, 3]`` of a clip, by its number; the last one of a shorter clip."""
    ((*_, frame),) = deque(islice(read_video(path), number + 1), maxlen=1)
    return frame


def _encode(path: Path, rate_hz: float, frames: Iterable[Frames], options: dict[str, str]) -> None:
    """Encode images; of an odd size without their last row or column, as 4:2:0 video has even sides."""
    # With the index in front a page can play the clip while it loads.
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream(
                    "libx264", rate=Fraction(rate_hz).limit_denominator(1000), options=options
                )
                stream.height, stream.width = (side - side % 2 for side in frame.shape[:2])
                stream.pix_fmt = "yuv420p"
            even = np.ascontiguousarray(frame[: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        container.mux(stream.encode(None))


def _panel(track: ClipTrack, step: int, rate_hz: float, off_track_m: float) -> Frames:
    index = min(step, len(track.frames) - 1)
    image = np.asarray(track.frames[index], dtype=np.uint8)
    scale = max(
        1, -(-_MIN_WIDTH_PX // image.shape[1])
    )  # the policy's 200-pixel views are doubled to hold the caption
    image = np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)
    height, width = image.shape[:2]
    canvas = Image.new("RGB", (width, _TITLE_PX + height + _STATUS_PX), DARK["paper"])
    # Captions go on top: a player puts its controls over the bottom.
    canvas.paste(Image.fromarray(image), (0, _TITLE_PX + _STATUS_PX))
    cte = float(np.asarray(track.cte_m)[index])
    _draw_title(canvas, track)
    _draw_status(canvas, index / rate_hz, cte, off_track_m, track.note if step > index else "")
    return np.asarray(canvas)


def _draw_title(canvas: Image.Image, track: ClipTrack) -> None:
    draw = ImageDraw.Draw(canvas)
    draw.rectangle((0, 0, 4, _TITLE_PX - 3), fill=style_of(track.condition).dark)
    draw.text((11, _TITLE_PX / 2 - 1), track.title, fill=DARK["ink"], font=_font(13, bold=True), anchor="lm")
    if track.attack_id:
        draw.text(
            (canvas.width - 2, _TITLE_PX / 2 - 1),
            track.attack_id,
            fill=DARK["muted"],
            font=_font(11),
            anchor="rm",
        )


def _draw_status(canvas: Image.Image, time_s: float, cte_m: float, off_track_m: float, note: str) -> None:
    """Draws time, cross-track error as a number and as a needle over the track's width, and the text OFF TRACK."""
    draw = ImageDraw.Draw(canvas)
    middle = _TITLE_PX + _STATUS_PX / 2 - 2
    draw.text((2, middle), f"{time_s:4.1f} s", fill=DARK["ink"], font=_font(12), anchor="lm")
    draw.text((62, middle), f"CTE {cte_m:+.2f} m", fill=DARK["ink"], font=_font(12), anchor="lm")
    off = abs(cte_m) > off_track_m
    # The needle moves like the car on the screen: left of the path is left.
    left, right = 160, 236
    centre, metre = (left + right) / 2, (right - left) / 4 / off_track_m
    draw.rectangle((left, middle - 4, right, middle + 4), fill=DARK["grid"])
    draw.rectangle(
        (centre - off_track_m * metre, middle - 4, centre + off_track_m * metre, middle + 4),
        fill=DARK["tape"],
    )
    at = float(np.clip(centre - cte_m * metre, left + 1, right - 1))
    draw.rectangle((at - 1.5, middle - 7, at + 1.5, middle + 7), fill=DARK["ink"])
    text = " · ".join([*(["OFF TRACK"] if off else []), *([note] if note else [])])
    draw.text(
        (canvas.width - 2, middle),
        text,
        fill=DARK["gradient" if off else "muted"],
        font=_font(12, bold=off),
        anchor="rm",
    )


@cache
def _font(size_px: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size_px)
