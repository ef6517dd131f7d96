"""Does the learned scene predict what happens? ``python -m benchmarks.transfer_correlation``.

One point is one search of one set: its mean excess in the learned scene, against that of the same attack deployed, both in half
lanes per tick. All registered searches of all complete sets count, those of random textures too, and none else; a search that several
conditions of a set drove counts once, under the last one. Pooled over sets a correlation may be that of the sets' means; within sets
each set has a mean of its own (a fixed effect), and ranks are taken inside each set. Searches of a set are not independent, nor are
sets that share searches, so that lower bounds come from groups of such sets, drawn again. With so few groups they are rough.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import rankdata

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.page import groups_of_searches
from advnerf_core.report.evidence.results import Evidence, mean_excess_m
from advnerf_core.report.evidence.verifying.layout import SET, complete_sets
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import new_axes
from advnerf_core.report.reference import DOMAINS
from benchmarks.predictions import PUBLISHED, evidence_of
from benchmarks.results import LedgerRow

COMMAND = "python -m benchmarks.transfer_correlation"
# Meshes are searched over the world's own pictures: no learned scene predicts anything.
_OVER_THE_WORLD = ("mesh_texture", "mesh_shape")
PICTURE = "transfer_correlation.png"
_DRAWS, _SEED, _LOWEST = 1000, 0, 0.05
_LEAST = {"Pearson": 0.8, "Spearman": 0.7}
_COLOURS = ("#1b6ca8", "#c2410c", "#15803d", "#7e22ce", "#b45309", "#0f766e", "#be123c", "#4d4d4d")
_MARKERS = "os^Dv<>"
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SetPoints:
    """The searches of one set.

    Attributes:
        name: Name of the set.
        group: Number of the group of sets that share searches.
        xy: Mean excess of each search in the learned scene and deployed ``[searches, 2]`` [half lanes per tick].
    """

    name: str
    group: int
    xy: Floats

    @cached_property
    def ranks(self) -> Floats:
        """Ranks of the searches within the set, as shares of their number."""
        return _ranks(self.xy) / len(self.xy)


def points_of(evidence: Evidence, group: int) -> SetPoints:
    """The registered searches of a set in a learned scene, each once."""
    found: dict[tuple[str, str, int, str], list[float]] = {}
    for registered in evidence.registration.cells:
        cell = evidence.cells.get(registered.name)
        if cell is None or cell.method in CONTROLS or not evidence.is_registered(cell):
            continue
        if evidence.scenario_of(cell).space.get("kind") in _OVER_THE_WORLD:
            continue
        if all(evidence.outcomes(cell, domain) for domain in DOMAINS):
            half_lane_m = evidence.scenario_of(cell).off_track_m
            means = [mean_excess_m(evidence, cell, domain) / half_lane_m for domain in DOMAINS]
            found[cell.victim, cell.method, cell.seed, cell.attack_id or cell.name] = means
    return SetPoints(evidence.registration.name, group, np.array([*found.values()]).reshape(-1, 2))


def correlation(sets: Sequence[SetPoints], within: bool, of_ranks: bool) -> float:
    """Correlation over all searches: Pearson's, or Spearman's; within sets, values or ranks are those above the set's mean."""
    if within:
        both = np.concatenate([_centred(each.ranks if of_ranks else each.xy) for each in sets])
    else:
        both = np.concatenate([each.xy for each in sets])
        both = _ranks(both) if of_ranks else both
    return float(np.corrcoef(both.T)[0, 1])


def line(sets: Sequence[SetPoints], within: bool) -> tuple[float, float]:
    """Slope and intercept of deployed on learned [half lanes per tick]; within sets the intercept is that of the mean set."""
    both = np.concatenate([each.xy for each in sets])
    centred = np.concatenate([_centred(each.xy) for each in sets]) if within else _centred(both)
    slope = float((centred[:, 0] * centred[:, 1]).sum() / (centred[:, 0] ** 2).sum())
    middle = np.mean([each.xy.mean(axis=0) for each in sets], axis=0) if within else both.mean(axis=0)
    return slope, float(middle[1] - slope * middle[0])


def lower_bound(sets: Sequence[SetPoints], within: bool, of_ranks: bool) -> float:
    """One-sided 95 % percentile bound of a correlation: whole groups of sets are drawn again, with replacement."""
    groups = [
        [each for each in sets if each.group == group] for group in sorted({each.group for each in sets})
    ]
    rng, found = np.random.default_rng(_SEED), []
    for _ in range(_DRAWS):
        drawn = [each for number in rng.integers(len(groups), size=len(groups)) for each in groups[number]]
        found.append(correlation(drawn, within, of_ranks))
    return float(np.quantile(found, _LOWEST))


def ledger_rows() -> list[LedgerRow]:
    """The rows, from the complete published sets."""
    sets = _complete()
    count, groups = sum(len(each.xy) for each in sets), len({each.group for each in sets})
    alone = ", ".join(
        f"{each.name} {correlation([each], True, False):.2f} of {len(each.xy)}" for each in sets
    )
    made = []
    for within in (False, True):
        slope, intercept = line(sets, within)
        for name, least in _LEAST.items():
            value = correlation(sets, within, name == "Spearman")
            bound = lower_bound(sets, within, name == "Spearman")
            which = "within sets" if within else "pooled"
            note = (
                f"{count} searches of {len(sets)} sets in {groups} groups without common searches; the target is for the estimate, its lower bound is "
                f"{bound:.2f} (one-sided 95 %, groups drawn again); deployed = {slope:.2f} x learned {intercept:+.3f} half lanes per tick; Pearson's of "
                f"each set: {alone}"
            )
            made.append(
                LedgerRow(
                    f"excess of a search in the learned scene against deployed, {which}: {name}'s correlation",
                    round(value, 3),
                    "",
                    f">= {least:g}" if within else "",
                    value >= least if within else None,
                    COMMAND,
                    note,
                )
            )
    return made


def picture() -> Figure:
    """All points, by set."""
    sets = _complete()
    with new_axes(7.5, 5.0) as ax:
        ends = np.array([min(each.xy.min() for each in sets), max(each.xy.max() for each in sets)])
        ax.plot(ends, ends, color=LIGHT["muted"], lw=1.0, zorder=1, label="as in the learned scene")
        for number, each in enumerate(sets):
            colour, marker = _COLOURS[number % len(_COLOURS)], _MARKERS[number % len(_MARKERS)]
            ax.plot(*each.xy.T, marker, ms=5, mfc="none", color=colour, label=each.name.replace("_", " "))
        ax.set(xlabel="in the learned scene [half lanes per tick]", ylabel="deployed [half lanes per tick]")
        ax.figure.legend(loc="outside right upper", fontsize=8)
    figure: Figure = ax.figure
    return figure


def main() -> None:
    """Compute, record and draw."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for row in ledger_rows():
        row.record()
        print(f"{row.line}: {row.value}; {row.note}")
    picture().savefig(PUBLISHED / PICTURE, dpi=110)


def _complete() -> list[SetPoints]:
    """The sets of which all cells are published, with their searches."""
    data = {name: read_json(PUBLISHED / name / SET) for name in complete_sets(PUBLISHED)}
    group_of = {name: number for number, group in enumerate(groups_of_searches(data)) for name in group}
    found = [points_of(evidence_of(name), group_of[name]) for name in data]
    return [each for each in found if len(each.xy) > 1]


def _ranks(xy: Floats) -> Floats:
    return np.stack([rankdata(column) for column in xy.T], axis=1)


def _centred(xy: Floats) -> Floats:
    return xy - xy.mean(axis=0)


if __name__ == "__main__":
    main()
