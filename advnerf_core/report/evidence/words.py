"""Common names and sentences of the results pages: one name per concept, and claims over the control with the smaller excess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from advnerf_core.report.conditions import EMPTY, NONE, style_of
from advnerf_core.report.reference import Domain

DOMAIN_TITLES: Mapping[Domain, str] = {"surrogate": "learned scene", "deployed": "deployed"}
NOT_DRIVEN = "not driven"
_KEY = ("scenario", "victim", "method")


@dataclass(frozen=True)
class Excess:
    """Excess |CTE| per tick over one control.

    Attributes:
        mean_m: Mean over the drives [m].
        low_m: Lower end of its interval [m]; None with too few drives.
        high_m: Upper end [m].
        over: Name of the control.
    """

    mean_m: float
    low_m: float | None
    high_m: float | None
    over: str

    @property
    def is_shown(self) -> bool:
        """Whether its interval lies above zero."""
        return self.low_m is not None and self.low_m > 0.0


def excesses(row: Mapping[str, Any]) -> list[Excess]:
    """The excess of a row over the plain object, and over no object if that was driven."""
    found = [Excess(row["excess_m"], row["low_m"], row["high_m"], style_of(NONE).title)]
    if row["over_no_object_m"] is not None:
        ends = row["over_no_object_low_m"], row["over_no_object_high_m"]
        found.append(Excess(row["over_no_object_m"], *ends, style_of(EMPTY).title))
    return found


def smaller_excess(row: Mapping[str, Any]) -> Excess:
    """The excess that a claim may use: the smaller one."""
    return min(excesses(row), key=lambda excess: excess.mean_m)


def row_of(rows: Sequence[Mapping[str, Any]], test: Mapping[str, Any], domain: Domain) -> Mapping[str, Any]:
    """The row of a primary test's method in one domain, both from ``set.json``."""
    wanted = [test["test"][key] for key in _KEY]
    return next(row for row in rows if row["domain"] == domain and [row[key] for key in _KEY] == wanted)


def place_of(row: Mapping[str, Any]) -> str:
    """Name of a condition for readers."""
    name: str = row["scenario"]
    return name.replace("_", " ")


def sample_of(claim: Mapping[str, Any]) -> str:
    """What the interval of a claim is over, from ``set.json``."""
    return f"{claim['places']} places and " * (claim["places"] > 1) + f"{claim['victims']} victims"


def ends(low_m: float | None, high_m: float | None) -> str:
    """Both ends of an interval; empty without one."""
    return "" if low_m is None or high_m is None else f"{low_m:.3f} to {high_m:.3f}"


def excess_cells(row: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Cells of a table: the excess of a row over the plain object, its interval, and the same over no object."""
    plain = f"{row['excess_m']:.3f}" if row["method"] != NONE else f"(mean abs. CTE {row['excess_m']:.3f})"
    bare = "" if row["method"] == EMPTY else NOT_DRIVEN
    if row["over_no_object_m"] is not None:
        bare = f"{row['over_no_object_m']:.3f}"
    no_object_ends = ends(row["over_no_object_low_m"], row["over_no_object_high_m"])
    return plain, ends(row["low_m"], row["high_m"]), bare, no_object_ends


def collisions(counts: Mapping[str, int]) -> str:
    """Number of collisions, and obstacles: ``3 (2 board, 1 wall)``."""
    what = ", ".join(f"{count} {name}" for name, count in counts.items())
    return f"{sum(counts.values())} ({what})" if counts else "0"


def p_text(value: float) -> str:
    """A p-value in the format of the pages."""
    return f"{value:.4f}" if value >= 0.001 else f"{value:.1e}"


def claim(test: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """The statement of a primary test, in four short sentences."""
    which, row = test["test"], row_of(rows, test, "deployed")
    excess = smaller_excess(row)
    between = f" ({ends(excess.low_m, excess.high_m)} m)" if excess.low_m is not None else ""
    shown = "" if excess.is_shown else " The interval is not above zero: no effect is shown."
    hit = f"; {collisions(row['collided'])} run into something" if row["collided"] else ""
    return (
        f"**{place_of(which)}, victim {which['victim']}, deployed.** With the {style_of(which['method']).title} attack the car is {excess.mean_m:.3f} m "
        f"per tick further from its path than with {_the(excess.over)}{between}, and {row['off_track']} of {row['drives']} drives leave the track{hit}.{shown} "
        f"{_other_control(row, excess)} {_against_baseline(test)}"
    )


def _the(control: str) -> str:
    return control if control == style_of(EMPTY).title else f"the {control}"


def _other_control(row: Mapping[str, Any], used: Excess) -> str:
    others = [each for each in excesses(row) if each.over != used.over]
    if not others:
        return "Drives with no object were not made."
    return f"Over {_the(others[0].over)} the excess is {others[0].mean_m:.3f} m."


def _against_baseline(test: Mapping[str, Any]) -> str:
    only = len(test["test"]["against"]) == 1
    baseline = f"{style_of(test['baseline']).title}, {'the only baseline run' if only else 'the strongest baseline in the learned scene'}"
    between = "" if test["low_m"] is None else f" ({ends(test['low_m'], test['high_m'])} m)"
    said = f"The difference to {baseline}, is {test['difference_m']:.3f} m{between}"
    if test["p"] is None:
        return f"{said}. {test['reason']}."
    return f"{said} (p = {p_text(test['p_holm'])} after Holm's adjustment)."
