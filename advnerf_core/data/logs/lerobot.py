"""Reads LeRobot data sets of versions 2 and 3: tables in Parquet, images as video or in the tables.

The format does not say what a number of ``action`` is: its name may. A name that ends in ``_rad`` is an angle in radians. Only data sets
that advnerf exported (``robot_type: advnerf``) also state the side, the poses and the disturbances.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import Rgb, decode_stored
from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.data.logs.drive_log import NOWHERE, DriveLog, LogFrame, SteeringUnit, chosen_name
from advnerf_core.data.video import read_video
from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError

INFO = "meta/info.json"
ROBOT = "advnerf"
ATTACHED = "advnerf"
STATE_NAMES = ("x_m", "y_m", "yaw_rad")
STEERING_NAME, SPEED_NAME = "steering_rad", "speed_mps"
STAMP, DISTURBED = "stamp_ns", "disturbed"
_ACTION, _STATE = "action", "observation.state"
_VERSIONS = ("v2", "v3")
_BATCH = 64
# Episodes have no times of their own: a pause between them keeps them apart.
_PAUSE_S = 10.0
_RATE_TOLERANCE = 0.1
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_LARGEST = 2**53
# Exceptions that PyArrow raises for a damaged file beside its own.
_NONSENSE = (OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError)
_ALL = "all"
_RANGE = re.compile(r"(\d{1,9}):(\d{1,9})")
_Place = tuple[Path, float]  # a video and a time in it [s]


@dataclass(frozen=True, eq=False)
class _DataSet:
    """A data set with the parts of its description that are used."""

    path: Path
    version: str
    fps: float
    features: dict[str, Any]
    info: dict[str, Any]

    @cached_property
    def tables(self) -> tuple[Path, ...]:
        return tuple(sorted((self.path / "data").glob("*/*.parquet")))

    @property
    def is_ours(self) -> bool:
        return self.info.get("robot_type") == ROBOT

    def names(self, feature: str) -> list[str]:
        """Names of a feature's numbers from the data set, or 0, 1, 2."""
        description = self.features[feature]
        names = description.get("names")
        if isinstance(names, dict):
            names = next(iter(names.values()), None)
        shape = self.shape(feature)
        size = shape[0] if len(shape) == 1 else 0
        return (
            list(map(str, names))
            if isinstance(names, list) and len(names) == size
            else [*map(str, range(size))]
        )

    def shape(self, feature: str) -> list[int]:
        """Shape of a feature's numbers in one frame."""
        shape = self.features[feature].get("shape") or [1]
        if not isinstance(shape, list) or not all(type(each) is int and each > 0 for each in shape):
            raise LogError(
                f"{self.path / INFO}: features.{feature}.shape: expected a list such as [2], got {shape!r:.60}; copy the data set again"
            )
        return shape

    def rows(self, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Columns ``[N, K]`` of all tables."""
        tables = [read_table(file, columns) for file in self.tables]
        return {
            name: np.concatenate(
                [_numbers(file, table, name) for file, table in zip(self.tables, tables, strict=True)]
            )
            for name in columns
        }


def read_lerobot(path: Path, choice: LogChoice) -> DriveLog:
    """Describe a data set.

    Args:
        choice: Answers of the user. Steering is ``FEATURE:NAME``, for example ``action:steering`` or ``action:0``.

    Raises:
        LogError: The data set is damaged, of another version, or lacks what was chosen.
    """
    data = _described(path)
    cameras = tuple(name for name, each in data.features.items() if each.get("dtype") in ("video", "image"))
    images = chosen_name(choice.images, cameras, "images", path)
    controls = tuple(
        f"{feature}:{name}"
        for feature in (_ACTION, _STATE)
        if feature in data.features
        for name in data.names(feature)
    )
    steering = _steering_name(choice.steering, controls, path)
    state = _STATE if data.is_ours and _STATE in data.features else None
    columns = ["episode_index", "timestamp"]
    columns += [name for name in (_ACTION, _STATE) if name in data.features]
    columns += [DISTURBED] if data.is_ours and DISTURBED in data.features else []
    table = data.rows(columns)
    _require_consistent(data, table)
    places = _video_places(data, images, table) if data.features[images]["dtype"] == "video" else []
    rows = _in_video_order(places) if places else list(range(len(table["timestamp"])))
    total, splits = len(rows), _splits(data)
    if choice.split is not None or len(splits) > 1:
        split = chosen_name(choice.split, (*splits, _ALL) if splits else (), "the split", path)
        rows = _rows_of_split(data, split, rows, table["episode_index"][:, 0])
    is_part = len(rows) < total
    table = {name: column[rows] for name, column in table.items()}
    count = len(rows)
    values = _values(data, table, steering) if steering else np.full(count, math.nan)
    speed = f"{_ACTION}:{SPEED_NAME}"
    speeds = _values(data, table, speed) if data.is_ours and speed in controls else np.full(count, math.nan)
    states = table[state] if state else np.full((count, 3), math.nan)
    stamps = _stamps(data, table["episode_index"][:, 0], rows)
    disturbed = table[DISTURBED][:, 0] if DISTURBED in table else np.zeros(count)

    def frames() -> Iterator[LogFrame]:
        shown = (
            _filmed_images(data, [places[row] for row in rows])
            if places
            else _stored_images(data, images, rows)
        )
        for row, rgb in enumerate(shown):
            x_m, y_m, yaw_rad = states[row] if state else NOWHERE
            yield LogFrame(
                rgb,
                int(stamps[row]),
                float(values[row]),
                f"{path}, frame {rows[row]}",
                float(speeds[row]),
                (float(x_m), float(y_m), float(yaw_rad)),
                disturbed=bool(disturbed[row]),
            )

    return DriveLog(
        path,
        f"LeRobot data set, {data.version}",
        (path / INFO, *data.tables, *sorted((path / "videos").rglob("*.mp4"))),
        images,
        cameras,
        controls,
        _unit(data, steering).chosen(choice) if steering else None,
        count,
        data.fps,
        int(np.isfinite(states).all(axis=1).sum()),
        lambda: values,
        frames,
        labels="expert" if state else "recorded",
        left_out={"of another split": total - len(rows)} if is_part else {},
        attached=lambda: {
            file.name: file.read_bytes() for file in sorted((path / ATTACHED).glob("*")) if file.is_file()
        },
        notes=(
            f"frames of the split {split}, of {', '.join(splits)}; the setting split=NAME chooses another, split={_ALL} takes all",
        )
        if is_part
        else (),
    )


def _described(path: Path) -> _DataSet:
    info = read_json(path / INFO)
    features = info.get("features") if isinstance(info, dict) else None
    version = str(info.get("codebase_version")) if isinstance(info, dict) else ""
    if not isinstance(features, dict) or not all(isinstance(each, dict) for each in features.values()):
        raise LogError(
            f"{path / INFO}: expected the description of a LeRobot data set with 'features', got none; copy it again"
        )
    if not version.startswith(_VERSIONS):
        raise LogError(
            f"{path / INFO}: expected codebase_version {' or '.join(_VERSIONS)}, got {version}; convert the data set with lerobot"
        )
    fps = info.get("fps")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < 1e4:
        raise LogError(f"{path / INFO}: fps: expected images per second, got {fps!r}")
    found = _DataSet(path, version, float(fps), features, info)
    if not found.tables:
        raise LogError(f"{path}: expected tables data/*/*.parquet, found none; copy the data set again")
    return found


def _steering_name(wanted: str | None, controls: Sequence[str], path: Path) -> str | None:
    """The number that is the steering: the chosen one, or the only action whose name has ``steer`` in it."""
    if wanted is not None:
        return chosen_name(wanted, controls, "steering", path)
    named = [each for each in controls if each.startswith(f"{_ACTION}:") and "steer" in each.lower()]
    return named[0] if len(named) == 1 else None


def _unit(data: _DataSet, steering: str) -> SteeringUnit:
    if data.is_ours and steering == f"{_ACTION}:{STEERING_NAME}":
        return SteeringUnit(steering, 1.0, "left")
    return SteeringUnit(steering, 1.0 if steering.endswith("_rad") else None)


def _values(data: _DataSet, table: dict[str, NDArray[np.float64]], control: str) -> NDArray[np.float64]:
    feature, _, name = control.partition(":")
    return table[feature][:, data.names(feature).index(name)]


def _require_consistent(data: _DataSet, table: dict[str, NDArray[np.float64]]) -> None:
    """Raise if the description and the tables contradict each other: images would be joined with the numbers of other frames."""
    times_s, episodes = table["timestamp"][:, 0], table["episode_index"][:, 0]
    total = data.info.get("total_frames")
    if isinstance(total, int) and total != len(times_s):
        raise LogError(
            f"{data.path / INFO}: expected total_frames to be the rows of data/*/*.parquet, got {total} for {len(times_s)} rows; "
            "a table is missing, damaged, or there twice: copy the data set again"
        )
    for feature in (_ACTION, _STATE):
        width = table[feature].shape[1] if feature in table else 0
        if width and math.prod(data.shape(feature)) != width:
            raise LogError(
                f"{data.path / INFO}: features.{feature}.shape: expected {width} numbers, as the tables have, got {data.shape(feature)}; "
                "correct shape and names"
            )
    steps_s = np.diff(times_s)[np.diff(episodes) == 0]
    if not (steps_s > 0.0).all():
        raise LogError(
            f"{data.path}: timestamp: expected times that go forward in each episode, got some that go back, repeat, or are none; "
            "copy the data set again"
        )
    rate_hz = 1.0 / float(np.median(steps_s)) if len(steps_s) else data.fps
    for unit, per_s in _UNITS.items():
        if _is_about(per_s * rate_hz, data.fps):
            raise LogError(
                f"{data.path}: timestamp: expected seconds, got what looks like {unit}, as fps is {data.fps:g}; divide the column by {per_s:g}"
            )
    if not _is_about(rate_hz, data.fps):
        raise LogError(
            f"{data.path / INFO}: fps: expected {rate_hz:.4g}, as the column timestamp of the tables has, got {data.fps:g}; correct it"
        )


def _is_about(rate_hz: float, expected_hz: float) -> bool:
    return abs(rate_hz / expected_hz - 1.0) <= _RATE_TOLERANCE


def _stamps(data: _DataSet, episodes: NDArray[np.float64], rows: Sequence[int]) -> NDArray[np.int64]:
    """Capture times ``[N]`` [ns]. Numbers of nanoseconds since 1970 are no ``float64``, so they are read unchanged.

    Args:
        episodes: Episode ``[N]`` of each frame.
        rows: Row ``[N]`` of the tables of each frame.
    """
    if not (data.is_ours and STAMP in data.features):
        pauses = np.cumsum(np.diff(episodes, prepend=episodes[:1]) != 0)
        return np.round(1e9 * (np.arange(len(episodes)) / data.fps + _PAUSE_S * pauses)).astype(np.int64)
    values = [value for file in data.tables for value in read_table(file, [STAMP])[STAMP].to_pylist()]
    try:
        return np.array(values, np.int64)[rows]
    except (TypeError, ValueError, OverflowError) as error:
        raise LogError(
            f"{data.path}: {STAMP}: expected times [ns], got something else; export the log again"
        ) from error


def _splits(data: _DataSet) -> tuple[str, ...]:
    """Names of the splits, ``train`` first."""
    splits = data.info.get("splits")
    return tuple(sorted(splits, key=lambda name: name != "train")) if isinstance(splits, dict) else ()


def _rows_of_split(
    data: _DataSet, split: str, rows: Sequence[int], episodes: NDArray[np.float64]
) -> list[int]:
    """Those of the rows whose episodes are in a split: what others hold out must not be learned."""
    if split == _ALL:
        return list(rows)
    said = data.info["splits"][split]
    if not (isinstance(said, str) and (found := _RANGE.fullmatch(said))):
        raise LogError(
            f"{data.path / INFO}: splits.{split}: expected episodes such as 0:50, got {said!r:.60}; correct it, or give the setting split={_ALL}"
        )
    first, end = int(found[1]), int(found[2])
    chosen = [row for row in rows if first <= episodes[row] < end]
    if not chosen:
        raise LogError(
            f"{data.path}: expected frames of the split {split}, episodes {said}, got none; give the setting split={_ALL}, or another"
        )
    return chosen


def _in_video_order(places: Sequence[_Place]) -> list[int]:
    """Numbers of the rows as their videos show them: tables may have the episodes in another order."""
    order = {file: number for number, file in enumerate(dict.fromkeys(file for file, _ in places))}
    return sorted(range(len(places)), key=lambda row: (order[places[row][0]], places[row][1]))


def _filmed_images(data: _DataSet, places: Sequence[_Place]) -> Iterator[Rgb]:
    for file, group in groupby(places, key=lambda place: place[0]):
        yield from frames_at(file, [time_s for _, time_s in group], 0.5 / data.fps)


def _stored_images(data: _DataSet, name: str, rows: Sequence[int]) -> Iterator[Rgb]:
    """Images in rows of the tables: each is the content of a file."""
    kept = set(rows)
    stored = ((file, *numbered) for file in data.tables for numbered in enumerate(_column(file, name)))
    for row, (file, number, value) in enumerate(stored):
        if row not in kept:
            continue
        content = value.get("bytes") if isinstance(value, dict) else None
        if not isinstance(content, bytes):
            raise LogError(
                f"{file}: expected the image {name} in row {number}, got none; export the data set with its images"
            )
        yield decode_stored(content, f"{file}, row {number}")


def _column(file: Path, name: str) -> Iterator[Any]:
    with _parquet(file) as opened:
        for batch in opened.iter_batches(_BATCH, columns=[name]):
            yield from batch.column(0).to_pylist()


def _video_places(data: _DataSet, name: str, table: dict[str, NDArray[np.float64]]) -> list[_Place]:
    """Video and time in it [s] of each row."""
    episodes = np.nan_to_num(table["episode_index"][:, 0], nan=-1.0).astype(int)
    times_s = table["timestamp"][:, 0]
    found = _episode_videos(data, name, sorted(set(episodes.tolist())))
    return [
        (found[episode][0], found[episode][1] + time_s)
        for episode, time_s in zip(episodes.tolist(), times_s.tolist(), strict=True)
    ]


def _episode_videos(data: _DataSet, name: str, episodes: Sequence[int]) -> dict[int, tuple[Path, float]]:
    """Video of each episode, and the time at which the episode starts in it [s]."""
    pattern = data.info.get("video_path")
    if not isinstance(pattern, str):
        raise LogError(f"{data.path / INFO}: expected video_path, got {pattern!r}; copy the data set again")
    if data.version.startswith("v2"):
        chunk = data.info.get("chunks_size")
        if not isinstance(chunk, int) or chunk < 1:
            raise LogError(f"{data.path / INFO}: chunks_size: expected a number of episodes, got {chunk!r}")
        return {
            each: (
                _filled(data, pattern, video_key=name, episode_chunk=each // chunk, episode_index=each),
                0.0,
            )
            for each in episodes
        }
    keys = [f"videos/{name}/{key}" for key in ("chunk_index", "file_index", "from_timestamp")]
    files = sorted((data.path / "meta/episodes").glob("*/*.parquet"))
    starts: dict[int, tuple[Path, float]] = {}
    for file in files:
        columns = read_table(file, ["episode_index", *keys])
        rows = zip(*(columns[key].to_pylist() for key in ("episode_index", *keys)), strict=True)
        for number, chunk_index, file_index, start_s in rows:
            if not all(
                isinstance(each, int | float) and abs(each) < _LARGEST
                for each in (number, chunk_index, file_index, start_s)
            ):
                raise LogError(
                    f"{file}: expected numbers of the episodes' videos, got something else; copy the data set again"
                )
            video = _filled(
                data, pattern, video_key=name, chunk_index=int(chunk_index), file_index=int(file_index)
            )
            starts[int(number)] = (video, float(start_s))
    if missing := [each for each in episodes if each not in starts]:
        raise LogError(
            f"{data.path / 'meta/episodes'}: expected episode {missing[0]}, found none; copy the data set again"
        )
    return starts


def _filled(data: _DataSet, pattern: str, **values: Any) -> Path:
    try:
        return data.path / pattern.format(**values)
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise LogError(
            f"{data.path / INFO}: video_path: expected {', '.join(values)} in braces, got {pattern!r}"
        ) from error


def frames_at(file: Path, times_s: Sequence[float], tolerance_s: float) -> Iterator[Rgb]:
    """Images of a video at ascending times.

    Raises:
        LogError: The video has no image at one of them, or cannot be read.
    """
    try:
        video = read_video(file)
        found_s, rgb = -math.inf, None
        for time_s in times_s:
            while found_s < time_s - tolerance_s:
                _, found_s, _, rgb = next(video, (0, math.inf, 0.0, None))
            if rgb is None or found_s > time_s + tolerance_s:
                raise LogError(
                    f"{file}: expected an image at {time_s:.3f} s, found none; the video is damaged or too short, copy it again"
                )
            yield rgb
    except DatasetError as error:
        raise LogError(str(error)) from error


def read_table(file: Path, columns: Sequence[str]) -> Any:
    """Columns of a Parquet file.

    Raises:
        LogError: The file is damaged, or lacks a column.
    """
    with _parquet(file) as opened:
        names = opened.schema_arrow.names
        if missing := [name for name in columns if name not in names]:
            raise LogError(
                f"{file}: expected the column {missing[0]}, it has {', '.join(names)}; copy the data set again"
            )
        return opened.read(columns=list(columns))


@contextmanager
def _parquet(file: Path) -> Iterator[Any]:
    """An open Parquet file; whatever its damage raises while it is read is one error."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(file) as opened:
            yield opened
    except AdvnerfError:
        raise
    except (pa.ArrowException, *_NONSENSE) as error:
        said = " ".join(str(error).split())
        raise LogError(
            f"{file}: expected a Parquet file, got a damaged one ({said:.120}); copy the data set again"
        ) from error


def _numbers(file: Path, table: Any, name: str) -> NDArray[np.float64]:
    """A column as ``[N, K]``."""
    try:
        found = np.array(table[name].to_pylist(), np.float64)
    except (ValueError, TypeError) as error:
        raise LogError(
            f"{file}: {name}: expected numbers in every row, got something else; copy the data set again"
        ) from error
    if not len(found):
        raise LogError(f"{file}: expected rows, got none; copy the data set again")
    return np.where(np.abs(found) < _LARGEST, found, math.nan).reshape(len(found), -1)
