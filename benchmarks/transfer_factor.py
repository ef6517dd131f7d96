"""Predicts deployed excess from the surrogate's: one unknown factor for each set, estimated from earlier sets.

Drive by drive, deployed = a x surrogate with one factor a for a set of results (correlations of 0.92 to 1.00), so a set
is one observation of a, regardless of its number of drives. The model is

    log a ~ N(mu, tau^2),    deployed_ij = a surrogate_ij + m r_ij,

with mu and tau of all sets, m the set's mean |surrogate| excess, and residuals r distributed as in the earlier sets.
With a normal-inverse-gamma prior on (mu, tau^2), log a of the next set has a Student t distribution (Gelman et al.,
Bayesian Data Analysis, 3.3). The prior is weak: "as in the surrogate" counts like one set, and so do a spread by a
factor of 1.5 and residuals of 10 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtri, stdtrit

from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.evidence.rows import Key

Floats = NDArray[np.float64]
PRIOR_SPREAD, PRIOR_RESIDUAL = float(np.log(1.5)), 0.1
# An attack with no effect in the deployment, or a negative one, has no logarithm.
_LEAST_FACTOR = 0.01
_NODES = (np.arange(99) + 0.5) / 99


@dataclass(frozen=True)
class Transfer:
    """The attacks of one method of a set under one condition. Lengths in half lanes per tick.

    Attributes:
        name: Name of the set.
        cells: Names of the cells, one for each search.
        surrogate: Excess of each drive in the surrogate ``[searches, starts]``.
        deployed: The same of the deployed drives, from the same starts.
    """

    name: str
    cells: tuple[str, ...]
    surrogate: Floats
    deployed: Floats

    @property
    def scale(self) -> float:
        """Mean |excess| in the surrogate, known before any deployment."""
        return float(np.abs(self.surrogate).mean())

    @property
    def factor(self) -> float:
        """The measured factor: least squares of deployed = a x surrogate."""
        return _factor(self.surrogate, self.deployed)

    @property
    def factors(self) -> list[float]:
        """The measured factor of each search."""
        return [_factor(*pair) for pair in zip(self.surrogate, self.deployed, strict=True)]

    def residuals(self, factor: float) -> Floats:
        """Deployed minus factor x surrogate, over the scale ``[searches * starts]``."""
        return np.asarray((self.deployed - factor * self.surrogate).ravel() / self.scale)


@dataclass(frozen=True)
class FactorBelief:
    """The factor of the next set, predicted from earlier sets: log a is Student t.

    Attributes:
        location: Location of log a.
        scale: Scale of log a.
        freedom: Degrees of freedom.
        residuals: Equally likely residuals of a drive, over the mean |excess| in the surrogate ``[nodes]``.
    """

    location: float
    scale: float
    freedom: float
    residuals: Floats

    def factor_quantiles(self, shares: Floats) -> Floats:
        """Quantiles of the factor."""
        return np.asarray(np.exp(self.location + self.scale * stdtrit(self.freedom, shares)))

    def bands(self, surrogate: Floats, scale: float, level: float) -> Floats:
        """Bands ``[..., 2]`` of deployed drives whose excess in the surrogate is ``[...]``."""
        factors = self.factor_quantiles(_NODES)
        drives = np.asarray(surrogate, np.float64).ravel()
        spread = scale * self.residuals
        ends = [0.5 * (1.0 - level), 0.5 * (1.0 + level)]
        found = [np.quantile(np.add.outer(factors * drive, spread), ends) for drive in drives]
        return np.array(found).reshape(*np.shape(surrogate), 2)


def belief(earlier: Sequence[Transfer]) -> FactorBelief:
    """The factor of the next set, predicted from earlier sets, if any."""
    logs = np.log([max(each.factor, _LEAST_FACTOR) for each in earlier])
    count, mean = len(logs), float(logs.mean()) if len(logs) else 0.0
    square = PRIOR_SPREAD**2 + float(((logs - mean) ** 2).sum()) + count / (count + 1.0) * mean**2
    variance = square / (count + 1.0) * (count + 2.0) / (count + 1.0)
    residuals = [PRIOR_RESIDUAL * ndtri(_NODES)]
    residuals += [np.quantile(each.residuals(each.factor), _NODES) for each in earlier]
    return FactorBelief(
        count * mean / (count + 1.0), float(np.sqrt(variance)), count + 1.0, np.concatenate(residuals)
    )


def rival_bands(earlier: Sequence[Transfer], surrogate: Floats, level: float) -> Floats:
    """Bands ``[..., 2]`` of the rival: the surrogate's excess times the ratios deployed / surrogate of earlier sets' drives.

    Of the simple rivals (residuals about the median factor or ratios, drives pooled or sets weighted equally), it scores best on
    the published sets.

    Raises:
        ValueError: No earlier set is given.
    """
    if not earlier:
        raise ValueError("expected at least one earlier set, got none; the rival knows nothing else")
    ratios = np.concatenate([(each.deployed / each.surrogate).ravel() for each in earlier])
    ends = np.quantile(ratios, [0.5 * (1.0 - level), 0.5 * (1.0 + level)])
    return np.sort(np.multiply.outer(surrogate, ends), axis=-1)


def transfer_of(evidence: Evidence, baseline: bool = False) -> Transfer | None:
    """The attacks of a set's last primary test that was run, or its strongest baseline's; None without one.

    With contrasts, all values are the world's own under the last condition.
    """
    for test in reversed(evidence.registration.primary):
        found = [
            made
            for method in (test.against if baseline else (test.method,))
            if (made := _transfer(evidence, (test.scenario, test.victim, method))) is not None
        ]
        if found:
            return max(found, key=lambda each: float(each.surrogate.mean()))
    return None


def earlier_than(evidence: Evidence, others: Sequence[Evidence]) -> list[Evidence]:
    """Sets that were registered before this one, and whose last cell was finished before its first one, oldest first."""
    first = min(cell.date for cell in evidence.cells.values())
    found = [
        other
        for other in others
        if other.registration.date < evidence.registration.date
        and max(cell.date for cell in other.cells.values()) < first
    ]
    return sorted(found, key=lambda other: other.registration.date)


def registered_bands(
    found: Transfer, predictions: Mapping[str, Mapping[str, Any]], half_lane_m: float
) -> Floats | None:
    """Bands ``[searches, starts, 2]`` that were registered before the drives, one for all drives of a search.

    Args:
        found: The drives of the set.
        predictions: By name of the cell, with ``excess_low_m`` and ``excess_high_m``; see `TransferPrediction.record`.
        half_lane_m: Length of half a lane [m].

    Returns:
        The bands; None if a search was not predicted.
    """
    if not all(name in predictions for name in found.cells):
        return None
    ends = [
        [predictions[name][f"excess_{end}_m"] / half_lane_m for end in ("low", "high")]
        for name in found.cells
    ]
    return np.repeat(np.array(ends)[:, None, :], found.surrogate.shape[1], axis=1)


def binomial_interval(held: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share by Clopper and Pearson (1934): ``held`` of ``count`` independent observations."""
    if not 0 <= held <= count or count < 1:
        raise ValueError(f"expected some of at least one observation, got {held} of {count}")
    tail = 0.5 * (1.0 - level)
    low = 0.0 if held == 0 else float(betaincinv(held, count - held + 1, tail))
    high = 1.0 if held == count else float(betaincinv(held + 1, count - held, 1.0 - tail))
    return low, high


def _transfer(evidence: Evidence, key: Key) -> Transfer | None:
    cells = [cell for cell in evidence.searches(key) if cell.kept.get("deployed")]
    if not cells:
        return None
    half_lane_m = evidence.scenario_of(cells[0]).off_track_m
    learned, deployed = (
        [
            [drive.excess_cte_m_per_tick / half_lane_m for drive in evidence.outcomes(cell, domain)]
            for cell in cells
        ]
        for domain in ("surrogate", "deployed")
    )
    starts = min(len(each) for each in (*learned, *deployed))
    return Transfer(
        evidence.registration.name,
        tuple(cell.name for cell in cells),
        np.array([each[:starts] for each in learned]),
        np.array([each[:starts] for each in deployed]),
    )


def _factor(surrogate: Floats, deployed: Floats) -> float:
    return float((surrogate * deployed).sum() / (surrogate**2).sum())
