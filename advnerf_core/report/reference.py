"""The limits that a report is compared with, as data that an experiment file names."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel

Domain = Literal["surrogate", "deployed"]
DOMAINS: tuple[Domain, ...] = get_args(Domain)
# Measures of drives, which a limit names a method for.
DriveMeasure = Literal["excess_m", "ratio", "mean_abs_cte_m", "off_track", "off_track_share"]
LiveMeasure = Literal[
    "laps",
    "laps_mean_abs_cte_m",
    "laps_off_track",
    "latency_p99_ms",
    "missed_ticks",
    "psnr_full_db",
    "psnr_policy_db",
    "steering_difference_rad",
]


class Limit(StrictModel):
    """The limit of one measure.

    Attributes:
        of: The measure. ``excess_m`` is the excess |CTE| per tick over the plain object, ``ratio`` the total CTE over that past the plain
            object (publications in other units give this), ``mean_abs_cte_m`` per tick.
        what: Title of the measure; empty to derive it from the keys.
        scenario: Scenario of the drives; empty for the first one.
        victim: Victim of the drives.
        method: Method of the drives.
        domain: Domain of the drives.
        at_least: Smallest value.
        at_most: Largest value.
        above: Another method, whose value must be exceeded.
        paper: The publication's value, as text.
    """

    of: DriveMeasure | LiveMeasure = "ratio"
    what: str = ""
    scenario: str = ""
    victim: str = "hardened"
    method: str = ""
    domain: Domain = "deployed"
    at_least: float | None = None
    at_most: float | None = None
    above: str = ""
    paper: str = ""

    @property
    def of_drives(self) -> bool:
        """Whether it is a measure of one method's drives."""
        return self.of in get_args(DriveMeasure)

    @model_validator(mode="after")
    def _one_limit(self) -> Limit:
        given = (self.at_least is not None) + (self.at_most is not None) + bool(self.above)
        if given != 1:
            raise ValueError(f"expected one of at_least, at_most and above, got {given}")
        if self.of_drives != bool(self.method) or (self.above and not self.method):
            raise ValueError(
                f"expected a method with {', '.join(get_args(DriveMeasure))}, and with nothing else, got {self.of} of "
                f"{self.method or 'no method'}"
            )
        return self


class Reference(StrictModel):
    """A file of limits, in the order of the page."""

    targets: tuple[Limit, ...] = Field(default=())
