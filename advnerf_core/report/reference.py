"""What a table is held against: totals of a publication, and limits. Both are data that a campaign file or an experiment file names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel

Domain = Literal["surrogate", "deployed"]
Measure = Literal["ratio", "spread", "off_track", "off_track_share"]
LiveMeasure = Literal[
    "ratio",
    "mean_abs_cte_m",
    "off_track",
    "off_track_share",
    "laps",
    "laps_mean_abs_cte_m",
    "laps_off_track",
    "latency_p99_ms",
    "missed_ticks",
    "psnr_full_db",
    "psnr_policy_db",
    "steering_difference_rad",
    "memory_ratio",
    "wall_min",
]
_OF_DRIVES = ("ratio", "mean_abs_cte_m", "off_track", "off_track_share")
# Mean, and standard deviation where there is one.
Total = Annotated[tuple[float, ...], Field(min_length=1, max_length=2)]


class Limit(StrictModel):
    """What one line of a table must show.

    Attributes:
        method: Which method's line.
        domain: Where.
        victim: Whose line.
        of: ``ratio`` to no attack, ``spread`` (standard deviation over mean), ``off_track`` drives, or their share.
        at_least: Smallest value.
        at_most: Largest value.
        above: Another method, whose value must be exceeded.
        said: The limit in words; empty for the plain number.
    """

    method: str = Field(min_length=1)
    domain: Domain = "deployed"
    victim: str = "hardened"
    of: Measure = "ratio"
    at_least: float | None = None
    at_most: float | None = None
    above: str = ""
    said: str = ""

    @model_validator(mode="after")
    def _one_limit(self) -> Limit:
        given = (self.at_least is not None) + (self.at_most is not None) + bool(self.above)
        if given != 1:
            raise ValueError(f"expected one of at_least, at_most and above, got {given}")
        return self


class LiveLimit(StrictModel):
    """What a live experiment must show.

    Attributes:
        what: What is measured, in words.
        of: The measure. ``memory_ratio`` is the peak memory of the adjoint over 400 ticks against that over 50.
        method: Which method's drives, of a measure of drives.
        domain: Where, of a measure of drives.
        at_least: Smallest value.
        at_most: Largest value.
        setting: ``small`` or ``full`` if it is a limit of one of them alone.
        paper: What the paper has there, in words.
        headline: What the page's head calls it; empty leaves it out there.
    """

    what: str = Field(min_length=1)
    of: LiveMeasure
    method: str = ""
    domain: Domain = "deployed"
    at_least: float | None = None
    at_most: float | None = None
    setting: Literal["", "small", "full"] = ""
    paper: str = ""
    headline: str = ""

    @model_validator(mode="after")
    def _one_limit(self) -> LiveLimit:
        if (self.at_least is None) == (self.at_most is None):
            raise ValueError("expected one of at_least and at_most")
        if bool(self.method) != (self.of in _OF_DRIVES):
            raise ValueError(f"expected a method with {', '.join(_OF_DRIVES)}, and with nothing else")
        return self


class Reference(StrictModel):
    """What tables and reports are held against.

    Attributes:
        paper: Totals of a publication by scenario, domain and method, in its own units.
        targets: Limits by scenario.
        live: Limits of one live experiment.
    """

    paper: Mapping[str, Mapping[Domain, Mapping[str, Total]]] = Field(default_factory=dict)
    targets: Mapping[str, tuple[Limit, ...]] = Field(default_factory=dict)
    live: tuple[LiveLimit, ...] = ()

    def total(self, scenario: str, domain: Domain, method: str) -> tuple[float | None, float | None]:
        """Mean and standard deviation of the publication; None where it has none."""
        found = self.paper.get(scenario, {}).get(domain, {}).get(method)
        if found is None:
            return None, None
        return found[0], found[1] if len(found) > 1 else None
