"""What is left of an attack where everything is the world's own? ``python -m benchmarks.gap SET...``.

Reads published gap sets (`launch/gap_*.experiment.yaml`): the difference between the gradient and the random family that is strongest in the
surrogate, past a panel that the world's own renderer shows, driven by the world's own car; and how much of the surrogate's excess is left,
of the gradient's searches and of random ones that are strong in the surrogate. Of a set that claims something about a kind of place: how many more
drives leave the lane past the gradient's panels, over places and victims.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.luck import luck_of
from advnerf_core.report.evidence.registration import read_registration
from benchmarks.results import REPOSITORY, LedgerRow

PUBLISHED = REPOSITORY / "docs" / "results"
_LEAST = 0.25
# Smallest difference of the shares of drives off the lane, and its smallest lower bound [percentage points].
_POINTS, _LOW_POINTS = 50.0, 30.0
# The target is for worlds that this project did not write.
_FOREIGN = ("gap_metadrive", "gap_metadrive_unseen", "gap_duckietown", "gap_duckietown_robust")


def main() -> None:
    """Record the rows of each set, and over all that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", help="names of published gap sets")
    names = parser.parse_args().sets
    for each in [*names, *([" ".join(names)] if len(names) > 1 else [])]:
        for row in ledger_rows(each):
            row.record()
            print(f"{row.line}: {row.value} {row.unit}; {row.note}")


def ledger_rows(names: str) -> list[LedgerRow]:
    """The rows of one set, from its published numbers; of several names with spaces between them those over all of these sets."""
    tests = [(name, _published(name)) for name in names.split()]
    if len(tests) > 1:
        return all_luck_rows([(name, data["primary"][-1]) for name, data in tests])
    ((name, data),) = tests
    if claims := data.get("claims"):
        return [row for claim in claims for row in place_rows(name, claim)]
    test = data["primary"][-1]
    registration = read_registration(PUBLISHED / name)
    assert registration is not None, "a published set is registered"
    scenario = registration.scenarios[test["test"]["scenario"]]
    rows = [*gap_rows(name, test, data["rows"], scenario.off_track_m), luck_row(name, test)]
    return [*rows, *largest_loss_rows(name, test, data.get("contrasts", []))]


def _published(name: str) -> dict[str, Any]:
    file = PUBLISHED / name / "set" / "set.json"
    if not file.exists():
        raise SystemExit(
            f"expected a published set in {PUBLISHED / name}, got none; run advnerf experiment publish"
        )
    data: dict[str, Any] = read_json(file)
    return data


def gap_rows(
    name: str, test: dict[str, Any], rows: list[dict[str, Any]], half_lane_m: float
) -> list[LedgerRow]:
    """The rows of one set, from the test under its last condition."""
    command, which = f"python -m benchmarks.gap {name}", test["test"]
    said, real = (
        next(
            row
            for row in rows
            if (row["scenario"], row["victim"], row["method"], row["domain"])
            == (which["scenario"], which["victim"], which["method"], domain)
        )
        for domain in ("surrogate", "deployed")
    )
    note = (
        f"{real['searches']} searches, {real['drives']} drives; {real['off_track']} of them off the track, {100 * real['off_lane_share']:.0f} % of their "
        f"ticks; difference {test['difference_m'] / half_lane_m:.2f} half lanes per tick against {style_of(test['baseline']).title}"
    )
    low = (test["low_m"] or 0.0) / half_lane_m
    target, met = (f">= {_LEAST:g}", low >= _LEAST) if name in _FOREIGN else ("", None)
    bound = LedgerRow(f"{name}: gradient minus the strongest random family, deployed natively, lower 95 % bound", round(low, 3), "half lanes per tick", target, met, command, note)  # fmt: skip
    kept = 100.0 * real["excess_m"] / said["excess_m"]
    return [bound, LedgerRow(f"{name}: share of the surrogate's excess that is left, deployed natively", round(kept), "%", "", None, command, f"{said['excess_m']:.3f} to {real['excess_m']:.3f} m per tick")]  # fmt: skip


def place_rows(name: str, claim: dict[str, Any]) -> list[LedgerRow]:
    """How many more drives leave the lane than past the strongest baseline, over the places and victims of a claim; none that cannot be made."""
    if claim["difference_m"] is None:
        return []
    each = ", ".join(
        f"{one['scenario']} {one['victim']} {one['off_track_points']:+.0f}" for one in claim["each"]
    )
    note = (
        f"{claim['places']} places and {claim['victims']} victims, points: {each}; excess {claim['difference_m']:+.3f} m per tick more "
        f"(95 % {claim['low_m']:+.3f} to {claim['high_m']:+.3f})"
    )
    what = f"{name}: drives off the lane, gradient minus the strongest baseline, deployed natively"
    command = f"python -m benchmarks.gap {name}"
    points, low = claim["off_track_points"], claim["low_off_track_points"]
    rows = [LedgerRow(what, round(points), "points", f">= {_POINTS:g}", points >= _POINTS, command, note)]
    if low is not None:
        bound, target = f"{what}, lower 95 % bound", f"> {_LOW_POINTS:g}"
        rows.append(LedgerRow(bound, round(low), "points", target, low > _LOW_POINTS, command, note))
    return rows


def luck_row(name: str, test: dict[str, Any]) -> LedgerRow:
    """What is left of the random search that is strongest in the surrogate, beside the others and the gradient's."""
    found, pairs = luck_of(test), test["searches"][test["baseline"]]
    best = int(np.argmax([each["surrogate_m"] for each in pairs]))
    others = [100.0 * share for each, share in enumerate(found.baseline_shares) if each != best]
    ours = [100.0 * share for share in found.method_shares]
    there = "not tested" if test["p_surrogate"] is None else f"p = {test['p_surrogate']:.4f}, not adjusted"
    note = (
        f"{style_of(test['baseline']).title}: {pairs[best]['surrogate_m']:.3f} to {pairs[best]['deployed_m']:.3f} m per tick; its other searches keep {min(others):.0f} to "
        f"{max(others):.0f} %, median {np.median(others):.0f} %; the gradient's {min(ours):.0f} to {max(ours):.0f} %; {len(found.lucky)} of {len(pairs)} "
        f"are stronger in the surrogate than every gradient search{', and push to the other side' * found.other_side}; there the gradient adds {test['difference_surrogate_m']:+.3f} m per tick ({there})"
    )
    value = round(100.0 * found.baseline_shares[best])
    return LedgerRow(f"{name}: share left of the random search that is strongest in the surrogate, deployed natively", value, "%", "", None, f"python -m benchmarks.gap {name}", note)  # fmt: skip


def all_luck_rows(tests: list[tuple[str, dict[str, Any]]]) -> list[LedgerRow]:
    """What is left of random searches that are stronger in the surrogate than every gradient search, over the sets."""
    found = [(name, luck_of(test)) for name, test in tests]
    lucky = [(name, 100.0 * share) for name, each in found for share in each.lucky_shares]
    if not lucky:
        return []
    ours = [100.0 * share for _, each in found for share in each.method_shares]
    theirs = [100.0 * share for _, each in found for share in each.baseline_shares]
    note = (
        f"{len(lucky)} of {len(theirs)} random searches: {', '.join(f'{name} {share:.0f} %' for name, share in lucky)}; all random searches: median "
        f"{np.median(theirs):.0f} %; {len(ours)} gradient searches: {min(ours):.0f} to {max(ours):.0f} %, median {np.median(ours):.0f} %"
    )
    value = round(max(share for _, share in lucky))
    return [LedgerRow("random searches that are stronger in the surrogate than every gradient search: largest share left, deployed natively", value, "%", "", None, f"python -m benchmarks.gap {' '.join(name for name, _ in tests)}", note)]  # fmt: skip


def largest_loss_rows(name: str, test: dict[str, Any], contrasts: list[dict[str, Any]]) -> list[LedgerRow]:
    """Which single difference takes most of the random searches' excess, and what it takes of the gradient's."""
    singles = [row for row in contrasts if not row["name"].startswith("all of it")]
    changed = {(row["name"], row["method"]): 100.0 * row["difference_m"] / row["before_m"] for row in singles}
    losses = {what: share for (what, method), share in changed.items() if method == test["baseline"]}
    if not losses:
        return []
    what = min(losses, key=lambda each: losses[each])
    ours = changed[what, test["test"]["method"]]
    note = f"{what}; it changes the gradient's excess by {ours:+.0f} %"
    return [LedgerRow(f"{name}: largest change of the random searches' excess by a single difference", round(losses[what]), "%", "", None, f"python -m benchmarks.gap {name}", note)]  # fmt: skip


if __name__ == "__main__":
    main()
