"""Predicted and measured excess of attacks, and scores of predicted bands. No prediction used a drive with its attack."""

# ruff: noqa: RUF001 (typography for readers: dashes)

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from advnerf_core.report.conditions import order_of, style_of
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.text_table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
LEVEL = 0.8


@dataclass(frozen=True)
class Score:
    """Comparison of one set's bands with its measured drives.

    Attributes:
        held: Number of drives within their bands.
        score: Mean interval score, in the unit of the bands; smaller is better.
    """

    held: int
    drives: int
    score: float


def interval_score(low: ArrayLike, high: ArrayLike, measured: ArrayLike) -> Floats:
    """Interval score of each measured value (Gneiting and Raftery 2007, equation 43): width, and 2 / alpha times how far the value is outside."""
    lows, highs, values = (np.asarray(each, np.float64) for each in (low, high, measured))
    outside = np.maximum(lows - values, 0.0) + np.maximum(values - highs, 0.0)
    return np.asarray((highs - lows) + 2.0 / (1.0 - LEVEL) * outside)


def score_bands(bands: Floats, measured: Floats) -> Score:
    """Score bands ``[..., 2]`` of drives ``[...]``, both in one unit."""
    low, high = bands[..., 0], bands[..., 1]
    held = int(((low <= measured) & (measured <= high)).sum())
    return Score(held, measured.size, float(interval_score(low, high, measured).mean()))


@dataclass(frozen=True)
class Predicted:
    """Prediction and measurement of one attack. Lengths are excess |CTE| per tick over the plain object.

    Attributes:
        expected_m: Predicted excess of a deployed drive [m].
        low_m: Lower end of its 80 % band [m].
        high_m: Upper end [m].
        retained: Share of the effect on single views that survives in real pictures.
        surrogate_m: Mean excess in the surrogate from the same starts [m]: the expectation without a prediction.
        drives_m: Excess of each deployed drive [m].
    """

    name: str
    method: str
    expected_m: float
    low_m: float
    high_m: float
    retained: float
    surrogate_m: float
    drives_m: tuple[float, ...]

    @property
    def measured_m(self) -> float:
        """Mean of the deployed drives [m]."""
        return float(np.mean(self.drives_m))


def prediction_table(pairs: Sequence[Predicted]) -> Table:
    """Expected and measured, one line per attack."""
    cells = tuple(
        (
            pair.name,
            f"{pair.expected_m:.3f}",
            f"{pair.low_m:.3f} – {pair.high_m:.3f}",
            f"{pair.measured_m:.3f}",
            f"{pair.surrogate_m:.3f}",
            f"{100 * pair.retained:.0f} %",
        )
        for pair in pairs
    )
    columns = (
        "attack",
        "expected excess [m per tick]",
        "80 % of draws",
        "deployed",
        "learned scene",
        "effect retained",
    )
    title = "Transfer, predicted without any drive with the attack"
    return Table(title, columns, cells, (False, *[True] * 5))


def skill_text(pairs: Sequence[Predicted]) -> str:
    """One sentence on the accuracy of the predictions."""
    if not pairs:
        return "No attack was both predicted and deployed."
    scores = [score_bands(np.array([[p.low_m, p.high_m]]), np.array(p.drives_m)) for p in pairs]
    held, drives = sum(score.held for score in scores), sum(score.drives for score in scores)
    score_m = sum(score.score * score.drives for score in scores) / drives
    off_m, plain_m = (
        float(
            np.median([abs(expected - pair.measured_m) for expected, pair in zip(each, pairs, strict=True)])
        )
        for each in ([pair.expected_m for pair in pairs], [pair.surrogate_m for pair in pairs])
    )
    return (
        f"{len(pairs)} attacks predicted and deployed: {held} of {drives} drives are within their 80 % bands, and the mean interval score is "
        f"{score_m:.3f} m per tick. The expected excess is off by {off_m:.3f} m in the median; the drives in the learned scene taken for the "
        f"prediction would be off by {plain_m:.3f} m."
    )


def prediction_plot(pairs: Sequence[Predicted]) -> Figure:
    """Measured over expected excess; on the diagonal the prediction was right."""
    from advnerf_core.report.plots import new_axes  # matplotlib

    values = [value for pair in pairs for value in (pair.low_m, pair.high_m, pair.measured_m)]
    margin = 0.05 * (max(values) - min(values)) + 0.01
    ends = (min(values) - margin, max(values) + margin)
    with new_axes(5.4, 4.4) as ax:
        ax.plot(ends, ends, color=LIGHT["muted"], lw=1.0, ls="--", zorder=1)
        for method in sorted({pair.method for pair in pairs}, key=order_of):
            style, chosen = style_of(method), [pair for pair in pairs if pair.method == method]
            expected = np.array([pair.expected_m for pair in chosen])
            bars = np.abs(np.array([[pair.low_m, pair.high_m] for pair in chosen]).T - expected)
            drawn = {"marker": style.marker, "ls": "none", "ms": 6, "lw": 1.2, "color": style.light}
            ax.errorbar(expected, [pair.measured_m for pair in chosen], xerr=bars, label=style.title, **drawn)
        ax.set(xlim=ends, ylim=ends)
        ax.set(xlabel="expected excess [m per tick]", ylabel="deployed excess [m per tick]")
        ax.legend(loc="upper left")
        return ax.figure


def prediction_section(pairs: Sequence[Predicted]) -> Markup:
    """Sentence, plot and table for the page."""
    parts = [Markup("<p>{}</p>").format(skill_text(pairs))]
    if pairs:
        from advnerf_core.report.plots import svg  # matplotlib

        picture = svg(prediction_plot(pairs), "Deployed over expected excess")
        parts += [
            Markup('<figure class="single" style="max-width: 560px">{}</figure>').format(picture),
            prediction_table(pairs).html(),
        ]
    return Markup("").join(parts)
