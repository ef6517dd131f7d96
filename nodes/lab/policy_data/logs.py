"""Opens a recorded drive of any format, and says which format it is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from advnerf_core.data.logs.choice import LogChoice, LogError, LogRequest
from advnerf_core.data.logs.csv_log import UDACITY_FILE, read_csv_log
from advnerf_core.data.logs.donkey import MANIFEST, META, read_tub
from advnerf_core.data.logs.drive_log import DriveLog, Labels
from advnerf_core.data.logs.lerobot import INFO, read_lerobot
from nodes.bags.parts import holds_bag, is_bag_file
from nodes.lab.policy_data.bag_log import OWN_IMAGES, read_bag_log

_FORMATS = (
    "a bag (.mcap, .db3, .bag, or its folder), a Donkeycar tub, a CSV file, a folder with Udacity's driving_log.csv, "
    "or a LeRobot data set"
)
_COMMA = (
    "rlog",
    "rlog.bz2",
    "rlog.zst",
    "raw_log.bz2",
    "video.hevc",
    "fcamera.hevc",
    "processed_log",
    "global_pose",
)


@dataclass(frozen=True, eq=False)
class OpenLog:
    """A log that a user named.

    Attributes:
        name: The path as written.
    """

    name: str
    choice: LogChoice
    log: DriveLog
    labels: Labels


def open_logs(
    requests: Iterable[LogRequest], common: LogChoice, labels: Labels | None = None
) -> list[OpenLog]:
    """Describe the logs that a user named.

    Args:
        labels: Source of the labels; None leaves it to the format.

    Raises:
        AdvnerfError: The format of one is unknown, one is damaged, or two are one log with the same settings.
    """
    opened = dict[tuple[tuple[Path, ...], LogChoice], OpenLog]()
    for request in requests:
        choice = request.choice(common)
        log = open_log(request.path, choice)
        # Under other settings it is another log: that of another camera, for example.
        key = tuple(file.resolve() for file in log.files), choice
        if key in opened:
            raise LogError(
                f"expected every log once, as its frames are learned from or held out, got {opened[key].name} and {request}, which are the same; "
                "remove one of them"
            )
        opened[key] = OpenLog(str(request), choice, log, labels or log.labels)
    return list(opened.values())


def open_log(path: Path, choice: LogChoice | None = None) -> DriveLog:
    """Describe a recorded drive.

    Args:
        choice: Answers of the user; None leaves everything to the format.

    Raises:
        AdvnerfError: The format is unknown, or the log is damaged.
    """
    choice = choice or LogChoice()
    if choice.split is not None and not (path / INFO).is_file():
        raise LogError(f"split: expected a LeRobot data set, got {path}; leave it out")
    log = _read(path, choice)
    if log.times_problem:
        log = replace(log, notes=(*log.notes, log.times_problem))
    if choice.images != log.images and len(log.cameras) > 1 and log.images not in OWN_IMAGES:
        note = f"images of {log.images}, the first of {', '.join(log.cameras)}; --images chooses others"
        return replace(log, notes=(*log.notes, note))
    return log


def _read(path: Path, choice: LogChoice) -> DriveLog:
    if path.suffix.lower() == ".csv":
        return read_csv_log(path, choice)
    if is_bag_file(path):
        return read_bag_log(path, choice)
    if path.is_dir():
        if (path / INFO).is_file():
            return read_lerobot(path, choice)
        if (path / MANIFEST).is_file() or (path / META).is_file() or any(path.glob("record_*.json")):
            return read_tub(path, choice)
        if (path / UDACITY_FILE).is_file():
            return read_csv_log(path / UDACITY_FILE, choice)
        if holds_bag(path):
            return read_bag_log(path, choice)
    raise LogError(_unknown(path))


def _unknown(path: Path) -> str:
    if path.name in _COMMA or any((path / name).exists() for name in _COMMA):
        return (
            f"{path} is a segment of comma.ai's logs, for which no maintained reader is known; "
            "convert it to a LeRobot data set (with lerobot), or to images and a CSV file"
        )
    inside = ", ".join(sorted(each.name for each in path.iterdir())[:5]) if path.is_dir() else "one file"
    return f"expected {_FORMATS}, got {path} ({inside or 'empty'}); name the folder of one log"
