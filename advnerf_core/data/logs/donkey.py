"""Reads tubs of Donkeycar: version 2 (``manifest.json``, catalogs of JSON lines) and version 1 (one JSON file per record).

``user/angle`` is -1 at full left and 1 at full right (``donkeycar/parts/actuator.py``, PWMSteering). Which wheel angle that is depends
on the car. Donkeycar 5 writes version 2 with ``parts/tub_v2.py``; version 1 is its ``parts/datastore.py``.
"""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.data.logs.drive_log import (
    DriveLog,
    LogFrame,
    SteeringUnit,
    chosen_name,
    median_rate_hz,
    refuse_repeated_images,
)
from advnerf_core.documents import raise_problems, read_json, read_json_lines

MANIFEST = "manifest.json"
META = "meta.json"
_STEERING, _MODE = "user/angle", "user/mode"
_RECORD = re.compile(r"record_(\d+)\.json")
_NS_PER_MS = 1_000_000
_LATEST_MS = 9e12  # in nanoseconds it has 64 bits
_WIDEST = 2.0  # full steering is 1, which a scaled joystick may exceed; degrees and pulses are far above
_DELETED, _PILOT = "deleted", "not driven by the user"


class _Record(NamedTuple):
    place: str
    values: dict[str, Any]
    folder: Path
    time_ms: float
    number: int | None


def read_tub(path: Path, choice: LogChoice) -> DriveLog:
    """Describe a tub.

    Raises:
        ConfigError: A record is no JSON, or lacks a value.
        LogError: The tub has no images, or not those that were chosen.
    """
    version = 2 if (path / MANIFEST).is_file() else 1
    found, left_out = _version_2(path) if version == 2 else _version_1(path)
    records, files = found
    if not records and left_out:
        raise LogError(
            f"expected records in {path} that are not deleted, got {sum(left_out.values())} deleted ones; restore some in Donkeycar"
        )
    cameras = tuple(
        sorted({key for each in records for key in each.values if key.startswith("cam/")}, key=_camera_order)
    )
    images = chosen_name(choice.images, cameras, "images", path)
    driven = [each for each in records if each.values.get(_MODE, "user") == "user"]
    controls = tuple(
        sorted(
            {
                key
                for each in (driven or records)
                for key, value in each.values.items()
                if _is_control(key, value)
            }
        )
    )
    name = _STEERING if choice.steering is None else chosen_name(choice.steering, controls, "steering", path)
    left_out |= {_PILOT: len(records) - len(driven)} if len(driven) < len(records) else {}
    values = _values(driven, name, images)
    refuse_repeated_images((each.place, each.folder / each.values[images]) for each in driven)
    times_s = [1e-3 * each.time_ms for each in driven]

    def frames() -> Iterator[LogFrame]:
        last: int | None = None
        for number, (each, value) in enumerate(zip(driven, values, strict=True)):
            stamp_ns = number if math.isnan(each.time_ms) else round(each.time_ms * _NS_PER_MS)
            try:
                rgb, _ = read_stored(each.folder / each.values[images])
            except DatasetError as error:
                raise LogError(f"{each.place}: {error}, or delete the record") from error
            skipped = last is not None and each.number is not None and each.number != last + 1
            last = each.number
            yield LogFrame(rgb, stamp_ns, float(value), each.place, after_gap=skipped)

    return DriveLog(
        path,
        f"Donkeycar tub, version {version}",
        (*files, *(each.folder / str(each.values[images]) for each in driven)),
        images,
        cameras,
        controls,
        SteeringUnit(name, None, "right").chosen(choice) if np.isfinite(values).any() else None,
        len(driven),
        median_rate_hz(times_s),
        0,
        lambda: values,
        frames,
        left_out=left_out,
    )


def _version_2(path: Path) -> tuple[tuple[list[_Record], tuple[Path, ...]], dict[str, int]]:
    manifest = path / MANIFEST
    lines = read_json_lines(manifest)
    state = lines[-1][1] if len(lines) > 1 else None
    if not isinstance(state, dict) or not isinstance(state.get("paths"), list):
        raise LogError(
            f"{manifest}: expected the catalogs ('paths') in its last line, got none; copy the tub again, "
            "or repair it with Donkeycar"
        )
    deleted = _deleted(f"{manifest}: deleted_indexes", state.get("deleted_indexes", []))
    names = [str(name) for name in state["paths"]]
    if repeated := sorted(name for name, count in Counter(names).items() if count > 1):
        raise LogError(
            f"{manifest}: paths: expected each catalog once, got {', '.join(repeated)} again; remove it"
        )
    catalogs = [path / name for name in names]
    counts: Counter[str] = Counter()
    records = []
    first: dict[int, str] = {}
    for place, values in (row for catalog in catalogs for row in read_json_lines(catalog)):
        values = _object(place, values)
        index = values.get("_index")
        if index in deleted:
            counts[_DELETED] += 1
            continue
        if deleted and type(index) is not int:
            raise LogError(
                f"{place}: _index: expected a number, as records are deleted by theirs, got {index!r:.40}; correct it"
            )
        if isinstance(index, int) and (earlier := first.setdefault(index, place)) != place:
            raise LogError(
                f"{place}: _index: expected one that no record has, got {index}, which {earlier} has; images are named after it, so that this one's "
                "was written over that one's: delete the earlier record"
            )
        number = index if type(index) is int else None
        time_ms = _time_ms(values.get("_timestamp_ms"))
        records.append(_Record(place, values, path / "images", time_ms, number))
    return (records, (manifest, *catalogs)), dict(counts)


def _version_1(path: Path) -> tuple[tuple[list[_Record], tuple[Path, ...]], dict[str, int]]:
    numbered = sorted(
        (int(match[1]), file) for file in path.iterdir() if (match := _RECORD.fullmatch(file.name))
    )
    exclude = path / "exclude.json"
    excluded = _deleted(str(exclude), read_json(exclude)) if exclude.is_file() else set()
    kept = [(number, file) for number, file in numbered if number not in excluded]
    records = [
        _Record(str(file), values, path, _time_ms(values.get("milliseconds")), number)
        for number, file in kept
        for values in [_object(str(file), read_json(file))]
    ]
    files = tuple(file for _, file in numbered)
    return (records, files), ({_DELETED: len(files) - len(kept)} if len(kept) < len(files) else {})


def _deleted(place: str, found: Any) -> set[int]:
    """Numbers of records that were deleted: one that is misread would bring its record back."""
    if not isinstance(found, list) or not all(type(each) is int for each in found):
        raise LogError(
            f"{place}: expected the numbers of deleted records, such as [4, 5], got {found!r:.60}; correct it"
        )
    return set(found)


def _object(place: str, values: Any) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise LogError(f"{place}: expected a record with keys and values, got {values!r:.40}")
    return values


def _values(records: list[_Record], name: str, images: str) -> NDArray[np.float64]:
    """Steering of each record; NaN in a tub without any."""
    values, problems = [], []
    is_recorded = name != _STEERING or any(name in each.values for each in records)
    for each in records:
        value = each.values.get(name)
        number = float(value) if _is_number(value) else None
        values.append(math.nan if number is None else number)
        if is_recorded and number is None:
            problems.append(f"{each.place}: {name}: expected a number, got {value!r:.40}; delete the record")
        elif number is not None and name == _STEERING and abs(number) > _WIDEST:
            problems.append(f"{each.place}: {name}: expected -1 to 1, got {number:g}; delete the record")
        if not isinstance(each.values.get(images), str):
            problems.append(f"{each.place}: expected the image {images}, got none; delete the record")
    raise_problems(problems)
    return np.array(values, np.float64)


def _is_control(key: str, value: Any) -> bool:
    return "/" in key and _is_number(value)


def _is_number(value: Any) -> TypeGuard[float]:
    """Whether a value is a number that a float can hold: JSON's integers have no end."""
    return isinstance(value, float) or (type(value) is int and abs(value) <= sys.float_info.max)


def _time_ms(value: Any) -> float:
    """A time [ms]; NaN without one, or for a number that is no time."""
    return float(value) if _is_number(value) and abs(value) < _LATEST_MS else math.nan


def _camera_order(name: str) -> tuple[bool, str]:
    return name != "cam/image_array", name
