"""How good predictions of transfer were: predicted against measured ratios of attacks. No prediction has seen a drive with its attack."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from advnerf_core.report.conditions import order_of, style_of
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# An attack that makes the car stray by this ratio counts as one that works.
WORKS_FROM = 1.5


@dataclass(frozen=True)
class Predicted:
    """One attack: what was expected of it, and what it did.

    Attributes:
        name: Name of the cell.
        method: Which search found it.
        ratio: Expected ratio to no attack.
        low: 10 % quantile of the prediction.
        high: 90 % quantile.
        measured: Deployed ratio to no attack.
        retained: Share of the effect on single views that survives in real pictures.
        total_m: Expected total CTE [m].
        measured_m: Deployed total CTE, mean over its drives [m].
        surrogate: Ratio to no attack of the drives in the surrogate from the same starts: what one would expect without predicting.
        surrogate_m: Their total CTE, mean over drives [m].
    """

    name: str
    method: str
    ratio: float
    low: float
    high: float
    measured: float
    retained: float
    total_m: float
    measured_m: float
    surrogate: float
    surrogate_m: float

    @property
    def unpredicted(self) -> Predicted:
        """The same attack with what the surrogate says in place of the prediction, to hold the prediction against."""
        return replace(self, ratio=self.surrogate, total_m=self.surrogate_m)

    def record(self) -> dict[str, Any]:
        """JSON-ready values."""
        return asdict(self)


@dataclass(frozen=True)
class Skill:
    """How good predictions were.

    Attributes:
        count: How many there were.
        factor: Median factor between expected and measured ratio, at least 1; None without any.
        factor_total: The same of the total CTE.
        rank_correlation: Spearman's, of the ratios; None of fewer than three or where all are equal.
        right: How many were rightly said to work, or not to (ratio of `WORKS_FROM`).
    """

    count: int
    factor: float | None
    factor_total: float | None
    rank_correlation: float | None
    right: int


def skill_of(pairs: Sequence[Predicted]) -> Skill:
    """Sum predictions up."""
    from scipy.stats import spearmanr  # half a second, and most tables have no predictions

    if not pairs:
        return Skill(0, None, None, None, 0)
    ratios, measured = (np.array([getattr(pair, name) for pair in pairs]) for name in ("ratio", "measured"))
    totals, measured_m = (
        np.array([getattr(pair, name) for pair in pairs]) for name in ("total_m", "measured_m")
    )
    ranked = len(pairs) >= 3 and np.ptp(ratios) > 0.0 and np.ptp(measured) > 0.0
    return Skill(
        len(pairs),
        _median_factor(ratios, measured),
        _median_factor(totals, measured_m),
        float(spearmanr(ratios, measured).statistic) if ranked else None,
        int(np.sum((ratios >= WORKS_FROM) == (measured >= WORKS_FROM))),
    )


def _median_factor(expected: Any, measured: Any) -> float:
    # Neither is ever exactly zero on a drive; a floor keeps a perfect drive from counting as infinitely wrong.
    logs = np.abs(np.log(np.maximum(expected, 1e-9) / np.maximum(measured, 1e-9)))
    return float(np.exp(np.median(logs)))


def prediction_table(pairs: Sequence[Predicted]) -> Table:
    """Expected and measured, one line per attack."""
    cells = tuple(
        (
            pair.name,
            f"{pair.ratio:.2f}",
            f"{pair.low:.2f} – {pair.high:.2f}",
            f"{pair.measured:.2f}",
            f"{pair.total_m:.2f}",
            f"{pair.measured_m:.2f}",
            f"{100 * pair.retained:.0f} %",
        )
        for pair in pairs
    )
    columns = (
        "attack",
        "expected ×",
        "80 % of draws",
        "measured ×",
        "expected [m]",
        "measured [m]",
        "effect retained",
    )
    return Table(
        "Transfer, predicted without any drive with the attack", columns, cells, (False, *[True] * 6)
    )


def skill_text(pairs: Sequence[Predicted]) -> str:
    """One sentence on how good the predictions were."""
    skill = skill_of(pairs)
    if skill.factor is None or skill.factor_total is None:
        return "No attack was both predicted and deployed."
    plain = skill_of([pair.unpredicted for pair in pairs])
    rank, plain_rank = (
        "" if each.rank_correlation is None else f", rank correlation {each.rank_correlation:.2f}"
        for each in (skill, plain)
    )
    return (
        f"{skill.count} attacks predicted and deployed: the ratio is off by a factor of {skill.factor:.2f} in the median, the total CTE by "
        f"{skill.factor_total:.2f}{rank}; {skill.right} of {skill.count} rightly said to work (at least {WORKS_FROM:g} × no attack) or not. "
        f"The drives in the learned scene taken for the prediction would be off by {plain.factor:.2f} and {plain.factor_total:.2f}{plain_rank}, "
        f"{plain.right} of {plain.count} right."
    )


def prediction_plot(pairs: Sequence[Predicted]) -> Figure:
    """Measured over expected ratio, both logarithmic; on the diagonal the prediction was right."""
    from advnerf_core.report.plots import new_axes  # matplotlib

    with new_axes(5.4, 4.4) as ax:
        values = [value for pair in pairs for value in (pair.ratio, pair.measured)]
        low, high = min([0.5, *values]) / 1.3, max([4.0, *values]) * 1.3
        ax.plot([low, high], [low, high], color=LIGHT["muted"], lw=1.0, ls="--", zorder=1)
        for method in sorted({pair.method for pair in pairs}, key=order_of):
            style = style_of(method)
            chosen = [pair for pair in pairs if pair.method == method]
            expected = np.array([pair.ratio for pair in chosen])
            bars = np.abs(np.array([[pair.low, pair.high] for pair in chosen]).T - expected)
            ax.errorbar(
                expected,
                [pair.measured for pair in chosen],
                xerr=bars,
                marker=style.marker,
                ls="none",
                ms=6,
                lw=1.2,
                color=style.light,
                label=style.title,
            )
        ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
        ax.set(xlabel="expected ratio to no attack", ylabel="measured ratio to no attack")
        ax.legend(loc="upper left")
        return ax.figure


def prediction_section(pairs: Sequence[Predicted]) -> Markup:
    """Sentence, plot and table for the page."""
    from advnerf_core.report.plots import svg  # matplotlib

    parts = [Markup("<p>{}</p>").format(skill_text(pairs))]
    if pairs:
        picture = Markup(
            svg(prediction_plot(pairs), "Measured over expected ratio to no attack")
        )  # our own SVG, its texts escaped
        parts += [
            Markup('<figure class="single" style="max-width: 560px">{}</figure>').format(picture),
            prediction_table(pairs).html(),
        ]
    return Markup("").join(parts)
