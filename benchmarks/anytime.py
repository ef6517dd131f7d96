"""Does the test that may stop at any time keep its level, and what would it have saved? ``python -m benchmarks.anytime``."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.anytime import e_value
from advnerf_core.report.evidence.exact import permutation_test
from benchmarks.coverage import ALPHA, percent
from benchmarks.results import REPOSITORY, record_row

Floats = NDArray[np.float64]
COMMAND = "python -m benchmarks.anytime"
PAIRS = 12


def record_anytime(replications: int, rng: np.random.Generator) -> None:
    """False positives of the anytime-valid test, stopped wherever it would reject; and how often it finds what is there."""
    shape = replications, PAIRS
    draws: dict[str, Callable[[], Floats]] = {
        "normal": lambda: rng.standard_normal(shape),
        "lognormal": lambda: np.exp(rng.standard_normal(shape)),
        "Cauchy": lambda: rng.standard_cauchy(shape),
        "three values": lambda: rng.integers(0, 3, shape).astype(np.float64),
    }
    for name, draw in draws.items():
        wrong = percent(_largest_e_values(draw(), draw())[:, -1] >= 1.0 / ALPHA)
        record_row(
            f"anytime-valid test at 5 %, equal methods, {name}: false positives",
            wrong,
            "%",
            "<= 5 %",
            wrong <= 5.0,
            COMMAND,
            f"{replications} replications; it stops at whichever of {PAIRS} pairs of searches would reject",
        )
    few = min(replications, 10_000)
    ours, theirs = rng.standard_normal((few, PAIRS)) + 2.0, rng.standard_normal((few, PAIRS))
    decided = _largest_e_values(ours, theirs) >= 1.0 / ALPHA
    exact = percent(np.array([permutation_test(a[:6], b[:6]).p for a, b in zip(ours[:2000], theirs, strict=False)], np.float64) <= ALPHA)  # fmt: skip
    shares = ", ".join(
        f"{percent(decided[:, number - 1]):.0f} % by pair {number}" for number in (4, 6, 8, 12)
    )
    record_row(
        "anytime-valid test at 5 %, normal methods two standard deviations apart: found within six pairs",
        percent(decided[:, 5]),
        "%",
        "-",
        None,
        COMMAND,
        f"{few} replications; {shares}; the exact test of six pairs finds {exact:.0f} %",
    )


def _largest_e_values(ours: Floats, theirs: Floats) -> Floats:
    """Largest e-value so far after each pair ``[replications, pairs]``."""
    after = [e_value(ours[:, :pairs], theirs[:, :pairs]) for pairs in range(1, ours.shape[1] + 1)]
    return np.maximum.accumulate(np.stack(after, axis=1), axis=1)


def record_saved() -> None:
    """Searches that the anytime-valid test would have saved on the published sets."""
    groups: dict[str, tuple[list[str], int, int]] = {}
    for file in sorted((REPOSITORY / "docs" / "results").glob("*/set/set.json")):
        for test in read_json(file)["primary"]:
            # Conditions, and sets, that drive the same searches go on until all are decided.
            same = str([[each["surrogate_m"] for each in searches] for searches in test["searches"].values()])
            names, needed, pairs = groups.get(same, ([], 0, 0))
            found = test["anytime"]
            needed, pairs = max(needed, found["pairs"] or found["of_pairs"]), max(pairs, found["of_pairs"])
            groups[same] = ([*names, file.parents[1].name], needed, pairs)
    saved = sum(2 * (pairs - needed) for _, needed, pairs in groups.values())
    texts = [
        f"{' and '.join(dict.fromkeys(names))} {needed} of {pairs}"
        for names, needed, pairs in groups.values()
    ]
    record_row(
        "anytime-valid test on the published sets: searches that it would have saved",
        saved,
        f"of {sum(2 * pairs for _, _, pairs in groups.values())}",
        "-",
        None,
        COMMAND,
        f"pairs of searches until all conditions are decided at 5 %: {'; '.join(texts)}; fewer than four pairs can never decide",
    )


def main() -> None:
    """Simulate, read the published sets, and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=50_000, help="experiments of each distribution")
    record_anytime(parser.parse_args().replications, np.random.default_rng(2))
    record_saved()


if __name__ == "__main__":
    main()
