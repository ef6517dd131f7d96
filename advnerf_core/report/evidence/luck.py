"""Searches that are strong where they search: what is left of each where it is deployed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.report.conditions import style_of

Pair = Sequence[float]  # mean excess of a search in the surrogate, and deployed [m per tick]


@dataclass(frozen=True)
class Luck:
    """The baseline's searches against the method's. Shares are deployed over surrogate excess.

    Attributes:
        method_shares: Share that is left of each search of the method.
        baseline_shares: The same of each search of the baseline.
        lucky: Searches of the baseline that are stronger in the surrogate than every search of the method, strongest first.
        difference_without_m: The method's mean excess in the surrogate minus that of the other baseline searches [m]; None without any.
    """

    method_shares: tuple[float, ...]
    baseline_shares: tuple[float, ...]
    lucky: tuple[Pair, ...]
    difference_without_m: float | None

    @property
    def lucky_shares(self) -> tuple[float, ...]:
        """What is left of the lucky searches."""
        return tuple(deployed / searched for searched, deployed in self.lucky)


def luck_of(test: Mapping[str, Any]) -> Luck:
    """Compare the searches of a published primary test (`TestResult` as JSON data)."""
    ours, theirs = (test["searches_m"][name] for name in (test["test"]["method"], test["baseline"]))
    strongest = max(searched for searched, _ in ours)
    rest = [searched for searched, _ in theirs if searched <= strongest]
    return Luck(
        *(tuple(deployed / searched for searched, deployed in pairs) for pairs in (ours, theirs)),
        lucky=tuple(sorted((pair for pair in theirs if pair[0] > strongest), reverse=True)),
        difference_without_m=float(np.mean([pair[0] for pair in ours]) - np.mean(rest)) if rest else None,
    )


def luck_sentences(test: Mapping[str, Any], alpha: float = 0.05) -> str:
    """Why a method is no better than the baseline where it searches; empty where it is better, or no test is claimed."""
    if test["p_surrogate"] is None or test["p_surrogate"] <= alpha:
        return ""
    found = luck_of(test)
    ours, theirs = (style_of(name).title for name in (test["test"]["method"], test["baseline"]))
    text = f"Where it searches, the {ours} attack is not shown to be better than {theirs}."
    if not found.lucky:
        return text
    count = len(found.lucky)
    strength = " and ".join(f"{searched:.3f}" for searched, _ in found.lucky)
    left = " and ".join(f"{100 * share:.0f}" for share in found.lucky_shares)
    text += (
        f" Of the {len(found.baseline_shares)} searches of {theirs}, {count} {'is' if count == 1 else 'are'} stronger in the learned scene than "
        f"every {ours} search ({strength} m per tick). Deployed, {left} % of that is left; of the {ours} searches "
        f"{100 * min(found.method_shares):.0f} to {100 * max(found.method_shares):.0f} %. Excess is measured from starts that no search has, so "
        f"{'this texture moves' if count == 1 else 'these textures move'} the policy in the learned scene, and not where it is deployed."
    )
    if found.difference_without_m is None:
        return text
    return (
        text
        + f" Without {'it' if count == 1 else 'them'}, the difference where they search would be {found.difference_without_m:+.3f} m per tick."
    )
