"""Reads CSV files with one row per image: Udacity's simulator's as downloaded, and any other with a header.

Udacity's simulator writes ``driving_log.csv`` without a header; the published data set has one. Its paths are those of the computer
that recorded them. Steering is -1 to 1 for 25 degrees, and positive to the right.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path, PureWindowsPath

import numpy as np

from advnerf_core.csv_rows import CsvRow, read_csv
from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.data.logs.drive_log import (
    DriveLog,
    LogFrame,
    SteeringUnit,
    chosen_name,
    refuse_repeated_images,
)
from advnerf_core.documents import is_real, raise_problems
from advnerf_core.errors import ConfigError

UDACITY_FILE = "driving_log.csv"
_UDACITY = ("center", "left", "right", "steering", "throttle", "brake", "speed")
_CAMERAS = _UDACITY[:3]
_CENTER = "center"
_CAMERA_COLUMN = "frame_id"  # as in the data of Udacity's challenge
_MOST_CAMERAS = 8  # more names are those of frames
_FULL_RAD = math.radians(25.0)
# Such as t, time_ms, Time [s], datetime, stamp, header.timestamp_ns; but not exposure_time, which is a duration.
_TIMES = re.compile(
    r"(t|(date)?time|(.*[^a-z])?(time[_ ]?)?stamp)([_ ]?[mun]?s)?\s*([\[(].*)?", re.IGNORECASE
)


def read_csv_log(path: Path, choice: LogChoice) -> DriveLog:
    """Describe a CSV file.

    Args:
        path: The file. Its image paths may be relative to it; of absolute ones that do not exist, the end is looked for beside it.
        choice: Answers of the user: its columns, and the unit of the steering. Of rows of several cameras, images is ``COLUMN:CAMERA``;
            else the center one is taken, or the first.

    Raises:
        ConfigError: A row cannot be read; all problems are one error.
        LogError: Times go back, an image is missing or there twice, or the chosen camera is not there or beside the center.
    """
    first = read_csv(path, bare=_UDACITY)[:1]
    is_udacity = any(set(_UDACITY[:4]) <= set(row.values) for row in first)
    column = choice.images or ("center" if is_udacity else "image")
    if any(column not in row.values for row in first):
        column = column.partition(":")[0]
    name = choice.steering or "steering"
    rows = read_csv(
        path, (column, name), _UDACITY, "name yours with --images and --steering, or correct the header"
    )
    of_rows = [] if is_udacity else _cameras_of(rows, column)
    images = column
    cameras: tuple[str, ...] = _CAMERAS if is_udacity else (column,)
    if of_rows or choice.images not in (None, column):
        cameras = tuple(sorted(set(of_rows), key=lambda each: (_CENTER not in each, each))) or (column,)
        wanted = None if choice.images == column else choice.images
        images = chosen_name(wanted, cameras, "images", path)
        rows = [row for row, camera in zip(rows, of_rows, strict=True) if camera == images]
    if images in cameras[1:] and _CENTER in cameras[0] and choice.steering_offset_rad is None:
        raise LogError(
            f"{path}: the recorded steering belongs to the center camera; for images={images} give what its driver would "
            f"steer in addition with steering-offset-rad (left positive), or use images={cameras[0]}"
        )
    unit = SteeringUnit(name, _FULL_RAD, "right") if is_udacity else SteeringUnit(name)
    unit = unit.chosen(choice)
    values, problems, steep = [], [], []
    for row in rows:
        try:
            values.append(row.number(name))
            if not unit.unknown:
                unit.wheel_rad(values[-1], row.place)
        except ConfigError as error:
            problems.append(str(error))
        except LogError as error:
            steep.append(str(error))
    raise_problems([*problems, *steep[:1]])  # one setting is the cure of all steep angles
    files = [_image_file(row, path.parent, column) for row in rows]
    refuse_repeated_images(zip((row.place for row in rows), files, strict=True))

    def frames() -> Iterator[LogFrame]:
        for number, (row, file, value) in enumerate(zip(rows, files, values, strict=True)):
            try:
                rgb, _ = read_stored(file)
            except DatasetError as error:
                raise LogError(f"{row.place}: {error}, or remove the row") from error
            yield LogFrame(rgb, number, value, row.place)

    return DriveLog(
        path,
        "CSV file of Udacity's simulator" if is_udacity else "CSV file",
        (path, *files),
        images,
        cameras,
        tuple(name for name in (rows[0].values if rows else ()) if name not in (*_CAMERAS, column)),
        unit,
        len(rows),
        0.0 if _times_repeat(rows) else math.nan,
        0,
        lambda: np.array(values, np.float64),
        frames,
    )


def _cameras_of(rows: Sequence[CsvRow], column: str) -> list[str]:
    """Camera of each row, as ``COLUMN:CAMERA``, by its ``frame_id`` or else by the folder of its image; none for rows of one camera."""
    if rows and _CAMERA_COLUMN in rows[0].values:
        names = [row.values[_CAMERA_COLUMN].strip() for row in rows]
    else:
        names = [PureWindowsPath(row.values[column].strip()).parent.name.lower() for row in rows]
        if not {_CENTER} < set(names) <= set(_CAMERAS):
            return []
    several = 1 < len(set(names)) <= min(_MOST_CAMERAS, len(rows) // 2)
    return [f"{column}:{name}" for name in names] if several else []


def _times_repeat(rows: Sequence[CsvRow]) -> bool:
    """Whether a column with times has some twice, as of a slow clock. Their unit is not known, so that they give no rate.

    Raises:
        LogError: Times go back: blocks of rows that are held out would have neighbours among the others.
    """
    repeat = False
    for name in (each for each in (rows[0].values if rows else ()) if _TIMES.fullmatch(each)):
        for (before, earlier), (after, later) in pairwise((row, _time(row.values[name])) for row in rows):
            if later < earlier:
                raise LogError(
                    f"{after.place}: {name}: expected times that go forward, got {after.values[name]!r:.40} after {before.values[name]!r:.40}; "
                    "sort the rows, give each drive a file of its own, or rename the column if it has no times"
                )
            repeat |= later == earlier
    return repeat


def _time(text: str) -> float:
    """A number, a date and time, or a time of day; NaN for anything else."""
    text = text.strip()
    if is_real(text):
        return float(text)
    text = text.replace("Z", "+00:00")
    for dated in (text, f"2000-01-01T{text}"):
        try:
            return datetime.fromisoformat(dated).timestamp()
        except (ValueError, OverflowError, OSError):
            continue
    return math.nan


def _image_file(row: CsvRow, folder: Path, column: str) -> Path:
    """The image of a row. A path of another computer is looked for by its last two parts, then by its name in ``IMG``."""
    text = row.values[column].strip()
    parts = PureWindowsPath(text).parts
    for candidate in (folder / text, folder.joinpath(*parts[-2:]), folder.joinpath("IMG", *parts[-1:])):
        if text and candidate.is_file():
            return candidate
    raise LogError(
        f"{row.place}: {column}: expected an image, found no file {text!r:.100} and none of its name in {folder}"
    )
