"""Do 95 % intervals cover the true effect in 95 % of experiments? Simulated drives with a known effect.

Each replication is one experiment: searches, all driven from the same starts, with random effects of search, start and drive.
The skewed designs are lognormal, or off-track-like: the car leaves the track (+2 m) where a latent sum of the effects is high.
``python -m benchmarks.coverage`` records the coverage of each design, and the error rates of the tests. Parts can be recorded alone:
``python -m benchmarks.coverage differences``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from advnerf_core.report.evidence.exact import permutation_test
from advnerf_core.report.evidence.mean_estimate import MeanEstimate, crossed, difference
from benchmarks.results import record_row

Floats = NDArray[np.float64]
SEARCHES, STARTS = 6, 20
LEVEL, ALPHA = 0.95, 0.05
LOWEST, HIGHEST = 93.0, 97.0
COMMAND = "python -m benchmarks.coverage"
PARTS = ("means", "differences", "places")
OFF_TRACK_M, WOBBLE_M = 2.0, 0.1
# Beyond this the cubic would overflow; its p-value is 0 or 1 long before.
LARGEST_T = 1e90


@dataclass(frozen=True)
class Design:
    """One population of drives.

    Attributes:
        name: What it is.
        kind: ``normal`` [m], ``lognormal`` (the deviations are of the logarithm), or ``off-track`` (of the latent sum).
        deviations: Standard deviations of the effects of search, start and drive.
        share: Share of drives off the track, of an off-track design.
        searches: Number of searches.
        starts: Number of starts.
    """

    name: str
    kind: str
    deviations: tuple[float, float, float]
    share: float = 0.0
    searches: int = SEARCHES
    starts: int = STARTS

    @property
    def line(self) -> str:
        return f"95 % interval, {self.searches} searches x {self.starts} starts, {self.name}: coverage"


DESIGNS = (
    Design("normal, equal effects", "normal", (0.3, 0.3, 0.3)),
    Design("normal, no search effect", "normal", (0.0, 0.3, 0.3)),
    Design("normal, starts dominate", "normal", (0.1, 0.3, 0.1)),
    Design("normal, searches dominate", "normal", (0.3, 0.1, 0.1)),
    Design("normal, noise only", "normal", (0.0, 0.0, 0.3)),
    Design("lognormal, equal effects", "lognormal", (0.3, 0.3, 0.3)),
    Design("lognormal, starts dominate", "lognormal", (0.2, 0.7, 0.3)),
    Design("lognormal, searches dominate", "lognormal", (0.5, 0.2, 0.3)),
    Design("lognormal, searches dominate, heavy tail", "lognormal", (1.0, 0.3, 0.3)),
    Design("30 % off track, equal effects", "off-track", (1.0, 1.0, 1.0), 0.3),
    Design("30 % off track, no search effect", "off-track", (0.0, 1.0, 1.0), 0.3),
    Design("10 % off track, noise dominates", "off-track", (0.5, 0.5, 1.0), 0.1),
    Design("20 % off track, searches dominate", "off-track", (1.0, 0.3, 0.3), 0.2),
)
# Numbers that the evidence rules use elsewhere; described, without a target.
SMALLER = (
    Design("normal, equal effects", "normal", (0.3, 0.3, 0.3), searches=3),
    Design("normal, equal effects", "normal", (0.3, 0.3, 0.3), searches=2),
    Design("normal, equal effects", "normal", (0.3, 0.3, 0.3), starts=5),
)
# Claims about kinds of places: places stand for searches, and victims for starts. They draw numbers of their own.
PLACES = (
    Design("a claim's places x victims, equal effects", "normal", (0.3, 0.3, 0.3), searches=4, starts=2),
    Design("a claim's places x victims, places dominate", "normal", (0.3, 0.1, 0.1), searches=4, starts=2),
    Design("a claim's places x victims, victims dominate", "normal", (0.1, 0.3, 0.1), searches=4, starts=2),
    Design("a claim's places x victims, victims dominate", "normal", (0.1, 0.3, 0.1), searches=4, starts=3),
)


@dataclass(frozen=True)
class TwoMethods:
    """Two methods whose searches are unrelated and whose starts are shared.

    Attributes:
        name: What it is.
        kind: ``normal`` [m], or ``lognormal`` (the deviations are of the logarithm).
        searches_vary: Standard deviations of the searches of each method.
        deviations: Standard deviations of the start, of what a start does to one method, and of the drive.
        searches: Numbers of searches of each method.
        starts: Number of starts.
    """

    name: str
    kind: str
    searches_vary: tuple[float, float]
    deviations: tuple[float, float, float]
    searches: tuple[int, int] = (SEARCHES, SEARCHES)
    starts: int = STARTS

    @property
    def line(self) -> str:
        return f"95 % interval of a difference, {self.searches[0]} and {self.searches[1]} searches x {self.starts} starts, {self.name}: coverage"


DIFFERENCES = (
    TwoMethods("normal, equal effects", "normal", (0.3, 0.3), (0.3, 0.2, 0.3)),
    TwoMethods("normal, one method varies", "normal", (0.02, 0.3), (0.3, 0.2, 0.1)),
    TwoMethods("normal, starts dominate", "normal", (0.05, 0.05), (0.3, 0.3, 0.1)),
    TwoMethods("normal, noise only", "normal", (0.0, 0.0), (0.3, 0.0, 0.3)),
    TwoMethods("normal, unequal numbers", "normal", (0.3, 0.3), (0.3, 0.2, 0.3), searches=(3, 6), starts=8),
    TwoMethods("normal, few starts", "normal", (0.02, 0.3), (0.3, 0.2, 0.1), starts=5),
    TwoMethods("lognormal, equal effects", "lognormal", (0.3, 0.3), (0.3, 0.2, 0.3)),
    TwoMethods("lognormal, one method varies", "lognormal", (0.05, 0.5), (0.3, 0.1, 0.1)),
    TwoMethods("lognormal, one method varies, heavy tail", "lognormal", (0.05, 1.0), (0.3, 0.1, 0.1)),
)


def simulate(design: Design, replications: int, rng: np.random.Generator) -> tuple[Floats, float]:
    """Excess of simulated drives ``[replications, searches, starts]`` [m], and the true mean [m]."""
    of_search, of_start, of_drive = design.deviations
    shape = replications, design.searches, design.starts
    effects = of_search * rng.standard_normal((*shape[:2], 1))
    effects = effects + of_start * rng.standard_normal((replications, 1, design.starts))
    effects += of_drive * rng.standard_normal(shape)
    total = float(np.hypot(np.hypot(of_search, of_start), of_drive))
    if design.kind == "normal":
        return 1.0 + effects, 1.0
    if design.kind == "lognormal":
        return np.exp(effects), float(np.exp(total**2 / 2))
    off = effects > total * ndtri(1.0 - design.share)
    return OFF_TRACK_M * off + WOBBLE_M * rng.standard_normal(shape), OFF_TRACK_M * design.share


def record_coverage(
    design: Design, replications: int, rng: np.random.Generator, record: Callable[..., None]
) -> None:
    """Coverage of one design, beside that of the uncorrected t interval."""
    drives, truth = simulate(design, replications, rng)
    estimate = crossed(drives)
    low, high = estimate.ends(LEVEL)
    inside = percent((low <= truth) & (truth <= high))
    half = stdtrit(estimate.degrees_of_freedom, 0.5 * (1.0 + LEVEL)) * estimate.standard_error
    plain = percent(np.abs(estimate.mean - truth) <= half)
    note = (
        f"{replications} replications; true mean of {truth:.2f} m below the interval in {percent(truth < low):.1f} %, "
        f"above it in {percent(truth > high):.1f} %; median width {np.median(high - low):.2f} m; "
        f"coverage without the correction for skewness {plain:.1f} %"
    )
    targeted = design in DESIGNS
    record(
        design.line,
        inside,
        "%",
        "93 to 97 %" if targeted else "-",
        LOWEST <= inside <= HIGHEST if targeted else None,
        COMMAND,
        note + _reason(design, inside, targeted),
    )


def _reason(design: Design, inside: float, targeted: bool) -> str:
    if not targeted or LOWEST <= inside <= HIGHEST:
        return ""
    if inside > HIGHEST:
        return "; wider than necessary, which is conservative"
    return f"; {design.searches} searches do not show how heavy the tail of their distribution is"


def simulate_two(
    design: TwoMethods, replications: int, rng: np.random.Generator
) -> tuple[Floats, Floats, float]:
    """Drives of both methods ``[replications, searches, starts]`` [m], and the true difference of their means [m]."""
    common, own, of_drive = design.deviations
    shared = common * rng.standard_normal((replications, 1, design.starts))
    drives, means = [], []
    for searches, varies in zip(design.searches, design.searches_vary, strict=True):
        shape = replications, searches, design.starts
        effects = shared + own * rng.standard_normal((replications, 1, design.starts))
        effects = (
            effects + varies * rng.standard_normal((*shape[:2], 1)) + of_drive * rng.standard_normal(shape)
        )
        skewed = design.kind == "lognormal"
        drives.append(np.exp(effects) if skewed else effects)
        variance = varies**2 + common**2 + own**2 + of_drive**2
        means.append(float(np.exp(variance / 2)) if skewed else 0.0)
    return drives[0], drives[1], means[0] - means[1]


def record_difference(
    design: TwoMethods, replications: int, rng: np.random.Generator, record: Callable[..., None]
) -> None:
    """Coverage of the interval of a difference, beside that of the one that pairs unrelated searches."""
    one, other, truth = simulate_two(design, replications, rng)
    low, high = difference(one, other).ends(LEVEL)
    inside = percent((low <= truth) & (truth <= high))
    few = min(design.searches)
    paired = crossed(one[:, :few] - other[:, :few]).ends(LEVEL)
    note = (
        f"{replications} replications; true difference of {truth:.2f} m below the interval in {percent(truth < low):.1f} %, above it in "
        f"{percent(truth > high):.1f} %; median width {np.median(high - low):.2f} m, {np.median(paired[1] - paired[0]):.2f} m with unrelated searches "
        f"paired, whose coverage is {percent((paired[0] <= truth) & (truth <= paired[1])):.1f} %"
    )
    if inside > HIGHEST:
        note += "; wider than necessary, which is conservative"
    if inside < LOWEST:
        note += f"; {few} searches do not show how heavy the tail of their distribution is"
    record(design.line, inside, "%", "93 to 97 %", LOWEST <= inside <= HIGHEST, COMMAND, note)


def record_bootstraps(replications: int, rng: np.random.Generator, record: Callable[..., None]) -> None:
    """Coverage of two percentile bootstraps on the first design, for comparison."""
    drives, truth = simulate(DESIGNS[0], replications, rng)
    draws = 999
    searches = rng.multinomial(SEARCHES, np.full(SEARCHES, 1 / SEARCHES), draws) / SEARCHES
    starts = rng.multinomial(STARTS, np.full(STARTS, 1 / STARTS), draws) / STARTS
    methods = {
        "percentile bootstrap over searches": drives.mean(axis=2) @ searches.T,
        "percentile pigeonhole bootstrap": np.einsum("dsj,dj->sd", _by_draw(drives, searches), starts),
    }
    for name, means in methods.items():
        low, high = np.quantile(means, [0.5 * (1 - LEVEL), 0.5 * (1 + LEVEL)], axis=1)
        note = f"{replications} replications of {draws} resamples; not used for results"
        line = f"{name}, 6 searches x 20 starts, {DESIGNS[0].name}: coverage"
        record(line, percent((low <= truth) & (truth <= high)), "%", "-", None, COMMAND, note)


def _by_draw(drives: Floats, weights: Floats) -> Floats:
    """Weighted means over searches ``[draws, replications, starts]`` of drives ``[replications, searches, starts]``."""
    return np.einsum("ri,sij->rsj", weights, drives, optimize=True)


def record_equivalence(replications: int, rng: np.random.Generator, record: Callable[..., None]) -> None:
    """How often the equivalence test calls a mean at the margin equivalent."""
    for design in (DESIGNS[0], DESIGNS[5], DESIGNS[9]):
        drives, truth = simulate(design, replications, rng)
        estimate: MeanEstimate = crossed(drives)
        wrong = percent(np.maximum(p_above(estimate, -truth), p_below(estimate, truth)) < ALPHA)
        line = f"equivalence test, 6 searches x 20 starts, {design.name}: false positives at the margin"
        note = (
            f"{replications} replications with the true mean at the upper margin, {truth:.2f} m, at level 5 %"
        )
        if wrong > 5.5:
            note += "; with skewed effects the upper end of the interval is too low"
        record(line, wrong, "%", "<= 5.5 %", wrong <= 5.5, COMMAND, note)


def p_above(estimate: MeanEstimate, bound: float) -> Floats:
    """One-sided p-values ``[...]``: small values say that the true mean is above ``bound``."""
    return np.asarray(stdtr(estimate.degrees_of_freedom, -_statistic(estimate, bound)))


def p_below(estimate: MeanEstimate, bound: float) -> Floats:
    """One-sided p-values ``[...]``: small values say that the true mean is below ``bound``."""
    return np.asarray(stdtr(estimate.degrees_of_freedom, _statistic(estimate, bound)))


def _statistic(estimate: MeanEstimate, bound: float) -> Floats:
    """t statistic ``[...]`` of the hypothesis that the true mean is ``bound``, transformed as Hall does: it increases with t."""
    distance = np.asarray(estimate.mean - bound)
    # Without spread, any other bound is infinitely far away.
    far = np.asarray(np.sign(distance) * LARGEST_T)
    t = np.divide(distance, estimate.standard_error, out=far, where=estimate.standard_error > 0.0)
    t, g = np.clip(t, -LARGEST_T, LARGEST_T), estimate.skewness
    return np.asarray(t + g * t**2 / 3.0 + g**2 * t**3 / 27.0 + g / 6.0)


def record_permutation(replications: int, rng: np.random.Generator, record: Callable[..., None]) -> None:
    """False positives of the permutation test at 5 %, 6 against 6 searches from shared starts."""
    setting = f"{replications} replications, 6 against 6 searches from {STARTS} shared starts"
    exact = 100.0 * 46 / 924  # the largest share of the splits within 5 %
    wrong = _false_positives(0.0, replications, rng)
    record(
        "permutation test at 5 %, equal methods: false positives",
        wrong,
        "%",
        "4.98 % +- 0.25 %",
        abs(wrong - exact) <= 0.25,
        COMMAND,
        f"{setting}; the exact rate is 46 / 924",
    )
    record(
        "permutation test at 5 %, methods that differ from start to start only: false positives",
        _false_positives(0.3, replications, rng),
        "%",
        "-",
        None,
        COMMAND,
        f"{setting}; methods differ by 0.3 m (standard deviation) at each start but not on average: the claim is about these starts",
    )


def _false_positives(spread_m: float, replications: int, rng: np.random.Generator) -> float:
    """Share [%] of tests at 5 % that reject, where two methods differ by chance from start to start, or not at all."""
    starts = 0.3 * rng.standard_normal((replications, 1, 1, STARTS))
    # Two independent effects of spread / sqrt(2) differ by spread.
    methods = spread_m / np.sqrt(2.0) * rng.standard_normal((replications, 2, 1, STARTS))
    searches = 0.3 * rng.standard_normal((replications, 2, SEARCHES, 1))
    noise = 0.3 * rng.standard_normal((replications, 2, SEARCHES, STARTS))
    means = (starts + methods + searches + noise).mean(axis=3)
    ps = [permutation_test(a, b).p for a, b in means]
    return percent(np.array(ps, dtype=np.float64) <= ALPHA)


def percent(flags: NDArray[np.bool_]) -> float:
    """Share of flags that are true [%]."""
    return 100.0 * float(np.mean(flags))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all if none is named")
    parser.add_argument("--replications", type=int, default=50_000, help="experiments of each design")
    parser.add_argument("--dry-run", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()
    began, rng = time.monotonic(), np.random.default_rng(0)

    def record(line: str, value: float, unit: str, target: str, met: bool | None, *rest: str) -> None:
        print(f"{line}: {value:.2f} {unit}, target {target}: {met}; {rest[-1]}", flush=True)
        if not arguments.dry_run:
            record_row(line, value, unit, target, met, *rest)

    count = arguments.replications
    chosen = arguments.parts or PARTS
    if unknown := sorted(set(chosen) - set(PARTS)):
        parser.error(f"expected parts of {', '.join(PARTS)}, got {', '.join(unknown)}")
    if "means" in chosen:
        for design in (*DESIGNS, *SMALLER):
            record_coverage(design, count, rng, record)
        record_bootstraps(min(count, 4_000), rng, record)
        record_equivalence(count, rng, record)
        record_permutation(count, rng, record)
    if "differences" in chosen:
        for two in DIFFERENCES:
            record_difference(two, count, np.random.default_rng(1), record)
    if "places" in chosen:
        places = np.random.default_rng(2)
        for design in PLACES:
            record_coverage(design, count, places, record)
    print(f"{time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
