"""Writes a log as a LeRobot data set of version 3, which ``lerobot`` loads: one table, one video, and the calibration files beside them."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import Rgb
from advnerf_core.data.logs.choice import LogError
from advnerf_core.data.logs.drive_log import FASTEST_HZ, NO_COMMAND, DriveLog, LogFrame, too_few_frames
from advnerf_core.data.logs.lerobot import (
    ATTACHED,
    DISTURBED,
    INFO,
    ROBOT,
    SPEED_NAME,
    STAMP,
    STATE_NAMES,
    STEERING_NAME,
)
from advnerf_core.files import write_json

CAMERA = "observation.images.camera"
_VERSION = "v3.0"
_TASK = "drive"
_README = "README.md"
_FILE = "chunk-000/file-000"
_GAP_FRAMES = 3.0  # a longer pause between two images starts another episode, as does a step back
_RATE_TOLERANCE = 0.2
_KEYFRAME_EVERY = "10"  # training reads frames in any order
_LEAST_IMAGES = 4
_STATISTICS_OF = 200

Report = Callable[[int], None]


@dataclass(frozen=True)
class Exported:
    """What was written: numbers of frames and episodes, the frames per second, and the images left out."""

    frames: int
    episodes: int
    rate_hz: int
    left_out: int


@dataclass(frozen=True)
class _Row:
    """The numbers of a frame."""

    episode: int
    number: int
    stamp_ns: int
    action: tuple[float, float]
    state: tuple[float, float, float]
    disturbed: bool


def write_lerobot(
    log: DriveLog, folder: Path, rate_hz: int | None = None, report: Report = lambda count: None
) -> Exported:
    """Write the usable frames of a log. Each is one frame of the video, whatever the time to the next.

    Args:
        log: The log; the unit of its steering must be known.
        folder: New folder of the data set.
        rate_hz: Images per second, about the log's if it has likely times; None for the log's.
        report: Called with the number of frames written.

    Raises:
        LogError: The folder exists, or the log has too few frames, no steering, no times, or times of another rate.
    """
    if folder.exists():
        raise LogError(f"{folder} exists; remove it or choose another folder with --output")
    if log.unit is None:
        raise LogError(f"expected steering in {log.path}, found none; {log.steering_advice}")
    rate_hz = _rate_of(log, rate_hz)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        done = _write(log, partial, rate_hz, report)
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return done


def _rate_of(log: DriveLog, asked_hz: int | None) -> int:
    """Images per second. Each image is one frame of the video, so that another rate than the log's would change the speed of the drive."""
    is_known = 0.5 <= log.rate_hz <= FASTEST_HZ
    if asked_hz is None and not is_known:
        raise LogError(
            f"expected times of the images of 0.5 to {FASTEST_HZ:g} Hz in {log.path}, got {log.rate_in_words}; give the images per second with --rate"
        )
    rate_hz = max(round(log.rate_hz), 1) if asked_hz is None else asked_hz
    if (
        is_known
        and not log.times_problem
        and abs(rate_hz - log.rate_hz) > max(1.0, _RATE_TOLERANCE * log.rate_hz)
    ):
        raise LogError(
            f"--rate: expected about {log.rate_hz:.3g}, the images per second of {log.path}, got {rate_hz}; leave it out: no images are left out "
            "or repeated"
        )
    if rate_hz > FASTEST_HZ:
        raise LogError(f"--rate: expected 1 to {FASTEST_HZ:g} images per second, got {rate_hz}; correct it")
    return rate_hz


def _write(log: DriveLog, folder: Path, rate_hz: int, report: Report) -> Exported:
    rows: list[_Row] = []
    shapes: list[tuple[int, ...]] = []
    sample: list[Rgb] = []
    left_out = Counter(log.left_out)
    every = max(log.count // _STATISTICS_OF, 1)
    (folder / "meta").mkdir(parents=True)
    video = folder / f"videos/{CAMERA}/{_FILE}.mp4"
    video.parent.mkdir(parents=True)

    def images() -> Iterator[Rgb]:
        for row, frame in _usable(log, rate_hz, left_out):
            if shapes and frame.image.shape != shapes[0]:
                raise LogError(
                    f"{frame.place}: expected images of one size, got {frame.image.shape[:2]} after {shapes[0][:2]}"
                )
            shapes[:] = [frame.image.shape]
            if len(rows) % every == 0:
                sample.append(frame.image[::4, ::4])
            rows.append(row)
            report(len(rows))
            yield frame.image

    _encode(video, images(), rate_hz)
    if len(rows) < _LEAST_IMAGES:
        raise too_few_frames(log, _LEAST_IMAGES, len(rows), left_out)
    columns = _columns(rows, rate_hz)
    _write_table(folder / f"data/{_FILE}.parquet", columns)
    episodes = _write_episodes(folder, rows, rate_hz)
    _write_tasks(folder / "meta/tasks.parquet")
    write_json(folder / INFO, _info(columns, len(rows), episodes, rate_hz, shapes[0]))
    statistics = {name: _summary(values.astype(np.float64)) for name, values in columns.items()}
    write_json(folder / "meta/stats.json", {**statistics, CAMERA: _image_statistics(sample)})
    _attach(folder / ATTACHED, log.attached())
    (folder / _README).write_text(_about(log, len(rows), left_out), encoding="utf-8")
    return Exported(len(rows), episodes, rate_hz, log.count - len(rows))


def _usable(log: DriveLog, rate_hz: int, left_out: Counter[str]) -> Iterator[tuple[_Row, LogFrame]]:
    """Frames with steering. A pause, times that go back, or frames left out in between, start another episode.

    Args:
        left_out: Numbers of other frames by reason; updated.
    """
    assert log.unit is not None
    episode = number = -1
    last_ns: float = -math.inf
    timed = log.rate_hz > 0.0
    skipped = True
    for frame in log.frames():
        if frame.unusable or math.isnan(frame.steering):
            left_out[frame.unusable or NO_COMMAND] += 1
            skipped = True
            continue
        paused = timed and abs(frame.stamp_ns - last_ns) > _GAP_FRAMES * 1e9 / rate_hz
        if skipped or paused or frame.after_gap:
            episode, number, skipped = episode + 1, -1, False
        number, last_ns = number + 1, frame.stamp_ns
        action = (log.unit.wheel_rad(frame.steering, frame.place), frame.speed_mps)
        yield _Row(episode, number, frame.stamp_ns, action, frame.state, frame.disturbed), frame


def _encode(file: Path, images: Iterator[Rgb], rate_hz: int) -> None:
    import av

    # Without loss, and as RGB: policies that learned from YUV at a constant rate factor of 5 steer 5 % worse, from 4:2:0 7 %.
    codec, kind, lossless = (
        ("libx264rgb", "rgb24", {"qp": "0"})
        if "libx264rgb" in av.codecs_available
        else ("libvpx-vp9", "gbrp", {"lossless": "1"})
    )
    with av.open(str(file), "w") as container:
        stream: Any = None
        for rgb in images:
            if stream is None:
                stream = container.add_stream(codec, rate=rate_hz, options={**lossless, "g": _KEYFRAME_EVERY})
                stream.height, stream.width = rgb.shape[:2]
                stream.pix_fmt = kind
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24"))
            )
        if stream is not None:
            container.mux(stream.encode(None))


def _columns(rows: Sequence[_Row], rate_hz: int) -> dict[str, NDArray[Any]]:
    """Columns of the table by feature, ``[N, K]``; the state only of a log with poses, the speed only if it is known."""
    numbers = np.array([row.number for row in rows], np.int64)[:, None]
    action = np.array([row.action for row in rows], np.float32)
    state = np.array([row.state for row in rows], np.float32)
    columns: dict[str, NDArray[Any]] = {"action": action if np.isfinite(action).all() else action[:, :1]}
    if np.isfinite(state).any():
        columns["observation.state"] = state
    return columns | {
        STAMP: np.array([row.stamp_ns for row in rows], np.int64)[:, None],
        DISTURBED: np.array([row.disturbed for row in rows], np.int64)[:, None],
        "timestamp": (numbers / rate_hz).astype(np.float32),
        "frame_index": numbers,
        "episode_index": np.array([row.episode for row in rows], np.int64)[:, None],
        "index": np.arange(len(rows), dtype=np.int64)[:, None],
        "task_index": np.zeros((len(rows), 1), np.int64),
    }


def _write_table(file: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    def array(values: NDArray[Any]) -> Any:
        flat = pa.array(values.reshape(-1))
        return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])

    file.parent.mkdir(parents=True)
    pq.write_table(pa.table({name: array(values) for name, values in columns.items()}), file)


def _write_episodes(folder: Path, rows: Sequence[_Row], rate_hz: int) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    starts = [index for index, row in enumerate(rows) if row.number == 0]
    ends = [*starts[1:], len(rows)]
    zeros = [0] * len(starts)
    video = f"videos/{CAMERA}"
    table = {
        "episode_index": list(range(len(starts))),
        "tasks": [[_TASK]] * len(starts),
        "length": [end - start for start, end in zip(starts, ends, strict=True)],
        "data/chunk_index": zeros,
        "data/file_index": zeros,
        "dataset_from_index": starts,
        "dataset_to_index": ends,
        f"{video}/chunk_index": zeros,
        f"{video}/file_index": zeros,
        f"{video}/from_timestamp": [start / rate_hz for start in starts],
        f"{video}/to_timestamp": [end / rate_hz for end in ends],
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
    }
    file = folder / f"meta/episodes/{_FILE}.parquet"
    file.parent.mkdir(parents=True)
    pq.write_table(pa.table(table), file)
    return len(starts)


def _write_tasks(file: Path) -> None:
    """One task. ``lerobot`` reads it with pandas, and expects the text as the index."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    index = "__index_level_0__"
    described = [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": None,
            "field_name": index,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ]
    about = {"index_columns": [index], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: pa.array([_TASK])})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), file)


def _info(
    columns: Mapping[str, NDArray[Any]], frames: int, episodes: int, rate_hz: int, shape: tuple[int, ...]
) -> dict[str, Any]:
    names = {"action": [STEERING_NAME, SPEED_NAME], "observation.state": list(STATE_NAMES)}
    features: dict[str, Any] = {
        CAMERA: {"dtype": "video", "shape": list(shape), "names": ["height", "width", "channels"]}
    }
    for name, values in columns.items():
        width = values.shape[1]
        features[name] = {
            "dtype": str(values.dtype),
            "shape": [width],
            "names": names[name][:width] if name in names else None,
        }
    return {
        "codebase_version": _VERSION,
        "robot_type": ROBOT,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate_hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


def _image_statistics(sample: Sequence[Rgb]) -> dict[str, Any]:
    """Statistics of the colours, 0 to 1, as ``[3, 1, 1]``."""
    found = _summary(np.concatenate([rgb.reshape(-1, 3) for rgb in sample]) / 255.0)
    shaped = {name: [[[value]] for value in values] for name, values in found.items() if name != "count"}
    return {**shaped, "count": [len(sample)]}


def _summary(values: NDArray[np.float64]) -> dict[str, list[Any]]:
    numbers = {
        name: getattr(np, f"nan{name}")(values, axis=0).tolist() for name in ("min", "max", "mean", "std")
    }
    return {**numbers, "count": [len(values)]}


def _about(log: DriveLog, frames: int, left_out: Mapping[str, int]) -> str:
    """What a reader of the data set should know: where it comes from, what is left out, and the notes about the log."""
    said = [f"left out: {count} {why}" for why, count in left_out.items() if count]
    said += [*log.notes, *([f"unchecked: {log.unchecked}"] if log.unchecked else [])]
    first = f"{frames} images of {log.images} in {log.path.name}, a {log.format}; exported by advnerf.\n"
    return "\n".join([first, *(f"- {each}" for each in said), ""])


def _attach(folder: Path, files: Mapping[str, bytes]) -> None:
    """Copy attached files with plain names, so that a foreign bag cannot write outside the folder."""
    for name, content in files.items():
        if Path(name).name == name:
            folder.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
