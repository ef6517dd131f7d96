"""The one type of a recorded drive: images, steering with its unit, and poses where there are any."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import Rgb
from advnerf_core.data.logs.choice import LogChoice, LogError, Side

Labels = Literal["expert", "recorded"]
FASTEST_HZ = 1000.0  # no camera is faster; such times have another unit
LIKELY_HZ = 130.0  # few cameras of cars are faster: such times are more often those of a conversion
NO_COMMAND = "no command"
NOWHERE = (math.nan, math.nan, math.nan)
# Of front wheels: at this angle and above, a value is in degrees, or in another unit.
_STEEPEST_RAD = 1.0


@dataclass(frozen=True)
class SteeringUnit:
    """How recorded steering is converted to the angle of the front wheels.

    Attributes:
        name: Topic, column or feature.
        full_rad: Wheel angle at a value of 1 [rad]; None if the format does not say.
        positive: Side to which positive values steer; None if the format does not say.
        offset_rad: Added to the converted angle, left positive [rad].
    """

    name: str
    full_rad: float | None = None
    positive: Side | None = None
    offset_rad: float = 0.0

    def chosen(self, choice: LogChoice) -> SteeringUnit:
        """This unit with the answers of the user."""
        return replace(
            self,
            full_rad=choice.steering_full_rad or self.full_rad,
            positive=choice.steering_positive or self.positive,
            offset_rad=choice.steering_offset_rad or 0.0,
        )

    @property
    def unknown(self) -> str:
        """Options that the user must still give; empty if the unit is known."""
        needed = ["--steering-full-rad"] if self.full_rad is None else []
        return " and ".join([*needed, *(["--steering-positive"] if self.positive is None else [])])

    def __str__(self) -> str:
        if self.full_rad == 1.0 and self.positive:
            return f"{self.name} [rad], {self.positive} positive"
        full = "an unknown wheel angle" if self.full_rad is None else f"{self.full_rad:.3g} rad"
        return f"{self.name}, 1 is {full} to the {self.positive or 'left or right'}"

    def wheel_rad(self, value: float, place: str) -> float:
        """Wheel angle, left positive [rad]; NaN for NaN.

        Raises:
            LogError: The unit is not known, or the angle is no wheel angle.
        """
        if self.full_rad is None or self.positive is None:
            raise LogError(
                f"{place}: expected the unit of {self.name}, its format does not state it; give {self.unknown} "
                "(the wheel angle at a value of 1, and the side of positive values)"
            )
        angle_rad = value * self.full_rad * (1.0 if self.positive == "left" else -1.0) + self.offset_rad
        if abs(angle_rad) >= _STEEPEST_RAD:
            is_degrees = self.full_rad == 1.0 and abs(math.radians(value)) < _STEEPEST_RAD
            raise LogError(
                f"{place}: expected a steering angle below {_STEEPEST_RAD:g} rad, got {value:g} times {self.full_rad:g}; "
                + (
                    "these look like degrees: give --steering-full-rad 0.01745"
                    if is_degrees
                    else "give the wheel angle at a value of 1 with --steering-full-rad"
                )
            )
        return angle_rad


@dataclass(frozen=True, eq=False)
class LogFrame:
    """One image with what was recorded for it.

    Attributes:
        image: ``[H, W, 3]`` uint8 RGB.
        stamp_ns: Capture time [ns]; the number of the frame in a log without times.
        steering: Steering in the log's unit; NaN if nothing was recorded.
        place: File and line, or file and number, for messages.
        speed_mps: Commanded speed [m/s], or NaN.
        state: x [m], y [m], yaw [rad] of the rear axle; NaN if not measured.
        unusable: Why the frame must not be learned from, such as ``not armed``; empty if it may.
        disturbed: Whether the recorded steering is not what the driver wanted.
        after_gap: Whether frames before it are left out, such as records that were deleted.
    """

    image: Rgb
    stamp_ns: int
    steering: float
    place: str
    speed_mps: float = math.nan
    state: tuple[float, float, float] = NOWHERE
    unusable: str = ""
    disturbed: bool = False
    after_gap: bool = False


@dataclass(frozen=True, eq=False)
class DriveLog:
    """A recorded drive. Images are read when they are asked for.

    Attributes:
        path: The file or folder.
        format: Name of the format.
        files: Files that stand for the content: if their sizes or times change, it counts as another log.
        images: The chosen camera, column, topic or feature.
        cameras: All images that could be chosen.
        controls: All numbers that could be chosen as steering.
        unit: Unit of the steering; None for a log without controls.
        count: Number of images.
        rate_hz: Images per second while recording; NaN in a log without times, and 0 if they go back or repeat.
        poses: Number of measured poses.
        steering: Reads the steering values ``[K]`` in the log's unit.
        frames: Reads the frames in order.
        labels: Steering that a policy learns from this format unless the user asks otherwise: the recorded steering, or the expert's.
        left_out: Number of records that the log itself marks as unusable, by reason.
        attached: Reads attached files by name, such as ``camera.yaml``.
        unchecked: Why damage may go unnoticed; empty if checksums cover the log.
        notes: What its user should know, such as files beside it that are not read.
        without_controls: What a log of this format has and needs, if there are no controls.
    """

    path: Path
    format: str
    files: tuple[Path, ...]
    images: str
    cameras: tuple[str, ...]
    controls: tuple[str, ...]
    unit: SteeringUnit | None
    count: int
    rate_hz: float
    poses: int
    steering: Callable[[], NDArray[np.float64]]
    frames: Callable[[], Iterator[LogFrame]]
    labels: Labels = "recorded"
    left_out: Mapping[str, int] = field(default_factory=dict)
    attached: Callable[[], Mapping[str, bytes]] = dict
    unchecked: str = ""
    notes: tuple[str, ...] = ()
    without_controls: str = "the log has no numbers"

    @property
    def steering_advice(self) -> str:
        """What to do about a log in which no steering was found."""
        return (
            f"name it with --steering: {', '.join(self.controls)}" if self.controls else self.without_controls
        )

    @property
    def rate_in_words(self) -> str:
        """The rate with its unit, or what is wrong with the times."""
        if math.isnan(self.rate_hz):
            return "no times"
        if not self.rate_hz:
            return "times that go back or repeat"
        digits = ",.0f" if self.rate_hz >= 1000.0 else ".3g"
        return f"{self.rate_hz:{digits}} Hz" + (
            ": times in another unit" if self.rate_hz > FASTEST_HZ else ""
        )

    @property
    def times_problem(self) -> str:
        """Why the times are hardly those of a drive; empty if they may be."""
        if not LIKELY_HZ < self.rate_hz <= FASTEST_HZ:
            return ""
        return (
            f"images {1e3 / self.rate_hz:.2g} ms apart ({self.rate_in_words}): times that look like those of a conversion, not of a drive; "
            "policy log export takes the true rate with --rate"
        )

    def first_image(self) -> Rgb:
        """The first image.

        Raises:
            LogError: The log has no image, or the first cannot be read.
        """
        for frame in self.frames():
            return frame.image
        raise LogError(f"expected images in {self.path}, got none; record more")


def too_few_frames(log: DriveLog, least: int, got: int, left_out: Mapping[str, int]) -> LogError:
    """The error about a log with too few usable frames.

    Args:
        left_out: Numbers of other images, by reason.
    """
    why = ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count)
    advice = "record more"
    if left_out.get(NO_COMMAND, 0) > got:
        times_differ = np.isfinite(log.steering()).sum() > got
        advice = (
            "their times and those of the steering differ: record again with one clock"
            if times_differ
            else "record the steering too, as a number for each image"
        )
    return LogError(
        f"expected at least {least} usable frames in {log.path}, got {got} ({why or 'no other images'}); {advice}"
    )


def refuse_repeated_images(images: Iterable[tuple[str, Path]]) -> None:
    """Refuse a log with an image twice: one of the two has the steering of another, and one would be learned where the other is held out.

    Args:
        images: Place for messages and image file of each frame.
    """
    first: dict[Path, str] = {}
    for place, file in images:
        if (earlier := first.setdefault(file, place)) != place:
            raise LogError(
                f"{place}: expected an image that nothing else has, got {file}, which {earlier} has; remove one of them"
            )


def median_rate_hz(times_s: Sequence[float]) -> float:
    """Images per second without the pauses between drives; NaN without times, and 0 if they go back or repeat."""
    if len(times_s) < 2 or not np.isfinite(times_s).all():
        return math.nan
    interval_s = float(np.median(np.diff(times_s)))
    return 1.0 / interval_s if interval_s > 0.0 else 0.0


def chosen_name(wanted: str | None, known: Sequence[str], what: str, path: Path) -> str:
    """The name that the user chose, or else the first.

    Raises:
        LogError: The log has no such name.
    """
    if wanted is None and known:
        return known[0]
    if not known:
        raise LogError(f"expected {what} in {path}, it has none; give another log")
    if wanted is None or wanted not in known:
        raise LogError(f"expected {what} {wanted} in {path}, it has {', '.join(known)}; choose one of these")
    return wanted
