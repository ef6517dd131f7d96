"""What a user says about a log that its format leaves open."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from advnerf_core.errors import AdvnerfError

Side = Literal["left", "right"]
_SETTING = re.compile(r"(?<=.),(?=\s*[a-z_-]+\s*=)")


class LogError(AdvnerfError, ValueError):
    """A log of a drive cannot be used; the message names the file and, where there is one, the line."""


@dataclass(frozen=True)
class LogChoice:
    """Answers about one log; None leaves an answer to its format.

    Attributes:
        images: Topic, column, feature or camera with the images.
        steering: Topic, column or feature with the steering.
        steering_full_rad: Wheel angle at a recorded steering of 1 [rad], without sign.
        steering_positive: Side to which positive values steer.
        steering_offset_rad: Added to the steering, left positive [rad]: for a camera that looks at the lane from one side.
        split: Split of a LeRobot data set, or ``all``; None for ``train`` where there are several.
    """

    images: str | None = None
    steering: str | None = None
    steering_full_rad: float | None = None
    steering_positive: Side | None = None
    steering_offset_rad: float | None = None
    split: str | None = None

    def __post_init__(self) -> None:
        full_rad, positive = self.steering_full_rad, self.steering_positive
        if full_rad is not None and not 0.0 < full_rad < 1e3:
            raise LogError(
                f"steering-full-rad: expected a positive wheel angle [rad], got {full_rad:g}; "
                "give the side with steering-positive"
            )
        offset_rad = self.steering_offset_rad
        if offset_rad is not None and not abs(offset_rad) < 0.5 * math.pi:
            raise LogError(
                f"steering-offset-rad: expected an angle of less than 1.5708 rad, not degrees, got {offset_rad:g}; correct it"
            )
        if positive is not None and positive not in get_args(Side):
            raise LogError(f"steering-positive: expected left or right, got {positive!r}")

    def with_settings(self, text: str) -> LogChoice:
        """A copy with settings such as ``images=left,steering-full-rad=0.3``."""
        found: dict[str, str | float] = {}
        for part in text.split(","):
            name, _, value = part.partition("=")
            key = name.strip().replace("-", "_")
            if key not in self.__dataclass_fields__:
                known = ", ".join(field.replace("_", "-") for field in self.__dataclass_fields__)
                raise LogError(f"expected settings of a log among {known}, got {part!r}")
            if key in found:
                raise LogError(f"{name.strip()} is given twice, {found[key]} and {value}; remove one of them")
            found[key] = _number(name, value) if key.endswith("_rad") else value
        return replace(self, **found)  # type: ignore[arg-type]


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise LogError(f"{name}: expected a number, got {text!r}") from None


@dataclass(frozen=True)
class LogRequest:
    """A log that a user named: ``PATH``, or ``PATH,setting=value,...`` with answers about this log only."""

    path: Path
    settings: str = ""

    @classmethod
    def parsed(cls, text: str) -> LogRequest:
        """Read an argument of the command line.

        Raises:
            LogError: The path does not exist, or a setting is unknown.
        """
        ends = [len(text), *(found.start() for found in reversed(list(_SETTING.finditer(text))))]
        # A comma may be part of a name: the longest path that exists counts.
        end = next((each for each in ends if Path(text[:each]).exists()), ends[-1])
        request = cls(Path(text[:end]), text[end + 1 :])
        if not request.path.exists():
            raise LogError(f"expected a log at {request.path}, found none; correct the path")
        request.choice(LogChoice())
        return request

    def choice(self, common: LogChoice) -> LogChoice:
        """The answers about all logs, with those about this one."""
        return common.with_settings(self.settings) if self.settings else common

    def __str__(self) -> str:
        return f"{self.path},{self.settings}" if self.settings else str(self.path)
