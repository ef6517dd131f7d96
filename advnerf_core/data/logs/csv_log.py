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
from advnerf_core.data.logs.drive_log import DriveLog, LogFrame, SteeringUnit, refuse_repeated_images
from advnerf_core.documents import is_real, raise_problems
from advnerf_core.errors import ConfigError

UDACITY_FILE = "driving_log.csv"
_UDACITY = ("center", "left", "right", "steering", "throttle", "brake", "speed")
_CAMERAS = _UDACITY[:3]
_FULL_RAD = math.radians(25.0)
# Such as t, time_ms, Time [s], datetime, stamp, header.timestamp_ns; but not exposure_time, which is a duration.
_TIMES = re.compile(
    r"(t|(date)?time|(.*[^a-z])?(time[_ ]?)?stamp)([_ ]?[mun]?s)?\s*([\[(].*)?", re.IGNORECASE
)


def read_csv_log(path: Path, choice: LogChoice) -> DriveLog:
    """Describe a CSV file.

    Args:
        path: The file. Its image paths may be relative to it; of absolute ones that do not exist, the end is looked for beside it.
        choice: Answers of the user: its columns, and the unit of the steering.

    Raises:
        ConfigError: A row cannot be read; all problems are one error.
        LogError: Times go back, or an image is missing or there twice.
    """
    first = read_csv(path, bare=_UDACITY)[:1]
    is_udacity = any(set(_UDACITY[:4]) <= set(row.values) for row in first)
    images = choice.images or ("center" if is_udacity else "image")
    name = choice.steering or "steering"
    rows = read_csv(
        path, (images, name), _UDACITY, "name yours with --images and --steering, or correct the header"
    )
    if is_udacity and images in ("left", "right") and choice.steering_offset_rad is None:
        raise LogError(
            f"{path}: the recorded steering belongs to the center camera; for images={images} give what its driver would "
            "steer in addition with steering-offset-rad (left positive), or use images=center"
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
    files = [_image_file(row, path.parent, images) for row in rows]
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
        _CAMERAS if is_udacity else (images,),
        tuple(name for name in (rows[0].values if rows else ()) if name not in (*_CAMERAS, images)),
        unit,
        len(rows),
        0.0 if _times_repeat(rows) else math.nan,
        0,
        lambda: np.array(values, np.float64),
        frames,
    )


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
