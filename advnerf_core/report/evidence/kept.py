"""Published drives: the data stored of each, from which every number can be recomputed without driving."""

from __future__ import annotations

import re
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field

from advnerf_core.driving.metrics import DriveMetrics, Horizon, drive_metrics
from advnerf_core.driving.path import Path
from advnerf_core.strict import StrictModel

Floats = NDArray[np.float64]
# Metres and radians. A total over 60 ticks then differs from the drive's own by less than a millimetre.
_DIGITS = 5


# What we write: decimals of a size that is finite. Published sets have a million such texts, and converting each takes three times as long.
_DECIMAL = r"-?[0-9]{1,9}(?:\.[0-9]{1,9})?"
_DECIMALS = re.compile(rf"{_DECIMAL}(?: {_DECIMAL})*")


def _numbers(text: str) -> str:
    if _DECIMALS.fullmatch(text) is None and not np.isfinite(np.array(text.split(), np.float64)).all():
        raise ValueError(f"expected finite numbers with spaces between them, got {text[:60]!r}")
    return text


Series = Annotated[str, AfterValidator(_numbers)]


class KeptDrive(StrictModel):
    """One drive at its control ticks.

    Attributes:
        x_m: ``T + 1`` positions, from the start [m], as numbers with spaces between them.
        y_m: The same for y [m].
        yaw_rad: The same for yaw [rad].
        command: Commands of the policy at ``T`` ticks [rad, or rad/s]; empty for a live drive, whose bag has them.
        driven_ticks: Ticks until the car stopped; its last |CTE| counts for the rest.
        collided: Whether the car ran into something.
        collided_with: Name of the obstacle; empty if the world named none.
    """

    x_m: Series
    y_m: Series
    yaw_rad: Series
    command: Series = ""
    driven_ticks: Annotated[int, Field(ge=0)]
    collided: bool = False
    collided_with: str = ""

    @classmethod
    def of(
        cls,
        states: ArrayLike,
        driven_ticks: int,
        command: ArrayLike = (),
        collided: bool = False,
        collided_with: str = "",
    ) -> KeptDrive:
        """Convert a drive of states ``[T + 1, >= 3]``."""
        columns = [_text(column) for column in np.asarray(states, np.float64)[:, :3].T]
        return cls(
            x_m=columns[0],
            y_m=columns[1],
            yaw_rad=columns[2],
            command=_text(command),
            driven_ticks=driven_ticks,
            collided=collided,
            collided_with=collided_with,
        )

    def poses(self) -> Floats:
        """Poses ``[T + 1, 3]``: x [m], y [m], yaw [rad].

        Raises:
            ValueError: The columns differ in length.
        """
        columns = [np.array(text.split(), np.float64) for text in (self.x_m, self.y_m, self.yaw_rad)]
        if len({len(column) for column in columns}) != 1:
            raise ValueError(
                f"expected x_m, y_m and yaw_rad of one length, got {[len(column) for column in columns]} numbers"
            )
        return np.stack(columns, axis=1)

    @property
    def obstacle(self) -> str | None:
        """Name of the obstacle that the car hit; None without a collision."""
        return (self.collided_with or "obstacle") if self.collided else None

    def metrics(self, path: Path, horizon: Horizon) -> DriveMetrics:
        """Metrics of the drive along a path."""
        return drive_metrics(path, self.poses(), horizon, self.driven_ticks)


def kept_drives(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Drives of one part of a cell (``states``, ``driven_ticks``, ``commands``, ``blocked_tick`` and ``collided_with``) as JSON data."""
    nothing = [None] * len(found["states"])
    driven = (found["states"], found["driven_ticks"], found["commands"])
    hits = (found.get(key, nothing) for key in ("blocked_tick", "collided_with"))
    return [
        KeptDrive.of(states, ticks, commands, tick is not None, hit or "").model_dump()
        for states, ticks, commands, tick, hit in zip(*driven, *hits, strict=True)
    ]


def _text(values: ArrayLike) -> str:
    rounded = np.round(np.asarray(values, np.float64), _DIGITS) + 0.0  # no -0
    return " ".join(f"{value:g}" if value == 0 else repr(float(value)) for value in rounded)
