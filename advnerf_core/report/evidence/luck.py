"""Searches that are strong in the surrogate, and the surviving share of their effect in the deployment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.report.conditions import style_of

Search = Mapping[str, float]  # `SearchMeans` as JSON data


@dataclass(frozen=True)
class Luck:
    """The baseline's searches against the method's. A share is deployed over surrogate excess.

    Attributes:
        method_shares: Surviving share of each search of the method.
        baseline_shares: Surviving share of each search of the baseline.
        lucky: Searches of the baseline that are stronger in the surrogate than every search of the method, strongest first.
        other_side: Whether all of these push the car to the other side than every search of the method does.
        difference_without_m: The method's mean excess in the surrogate minus the other baseline searches' [m]; None without any.
    """

    method_shares: tuple[float, ...]
    baseline_shares: tuple[float, ...]
    lucky: tuple[Search, ...]
    other_side: bool
    difference_without_m: float | None

    @property
    def lucky_shares(self) -> tuple[float, ...]:
        """Surviving shares of the lucky searches."""
        return tuple(_share(each) for each in self.lucky)


def luck_of(test: Mapping[str, Any]) -> Luck:
    """Compare the searches of a published primary test (`TestResult` as JSON data)."""
    ours, theirs = (test["searches"][name] for name in (test["test"]["method"], test["baseline"]))
    mine = [each["surrogate_m"] for each in ours]
    lucky = [each for each in theirs if each["surrogate_m"] > max(mine)]
    rest = [each["surrogate_m"] for each in theirs if each not in lucky]
    sides = [{bool(each["shift_m"] > 0.0) for each in searches} for searches in (ours, lucky)]
    return Luck(
        method_shares=tuple(_share(each) for each in ours),
        baseline_shares=tuple(_share(each) for each in theirs),
        lucky=tuple(sorted(lucky, key=lambda each: -each["surrogate_m"])),
        other_side=len(sides[0]) == len(sides[1]) == 1 and sides[0] != sides[1],
        difference_without_m=float(np.mean(mine) - np.mean(rest)) if rest else None,
    )


def luck_sentences(test: Mapping[str, Any]) -> str:
    """Explains why a method is no better than the baseline in the surrogate; empty if it is better, or no test is claimed."""
    if test["p_surrogate"] is None or test["p_surrogate"] <= 0.05:
        return ""
    found = luck_of(test)
    ours, theirs = (style_of(name).title for name in (test["test"]["method"], test["baseline"]))
    text = f"Where it searches, the {ours} attack is not shown to be better than {theirs}."
    if not found.lucky:
        return text
    one = len(found.lucky) == 1
    strength = " and ".join(f"{each['surrogate_m']:.3f}" for each in found.lucky)
    left = " and ".join(f"{100 * share:.0f}" for share in found.lucky_shares)
    text += (
        f" Of the {len(found.baseline_shares)} searches of {theirs}, {len(found.lucky)} {'is' if one else 'are'} stronger in the learned scene than "
        f"every {ours} search ({strength} m per tick). Deployed, {left} % of that is left; of the {ours} searches "
        f"{100 * min(found.method_shares):.0f} to {100 * max(found.method_shares):.0f} %. No search has these starts: "
        f"{'this texture works' if one else 'these textures work'} in the learned scene alone."
    )
    if found.other_side:
        text += f" {'It pushes' if one else 'They push'} the car to the other side of the path than every {ours} search does."
    if found.difference_without_m is None:
        return text
    return (
        text
        + f" Without {'it' if one else 'them'}, the difference where they search would be {found.difference_without_m:+.3f} m per tick."
    )


def _share(search: Search) -> float:
    return search["deployed_m"] / search["surrogate_m"]
