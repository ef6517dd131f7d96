"""What is left of an attack where everything is the world's own? ``python -m benchmarks.gap SET...``.

Reads published gap sets (`launch/gap_*.campaign.yaml`): the difference between the gradient and the random family that is strongest in the
surrogate, past a panel that the world's own renderer shows, driven by the world's own car; and how much of the surrogate's excess is left.
"""

from __future__ import annotations

import argparse
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.registration import read_registration
from benchmarks.results import REPOSITORY, LedgerRow

PUBLISHED = REPOSITORY / "docs" / "results"
_LEAST = 0.25
# The target is for worlds that this project did not write.
_FOREIGN = ("gap_metadrive", "gap_metadrive_unseen", "gap_duckietown", "gap_duckietown_robust")


def main() -> None:
    """Record the rows of each set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", help="names of published gap sets")
    for name in parser.parse_args().sets:
        for row in ledger_rows(name):
            row.record()
            print(f"{row.line}: {row.value} {row.unit}; {row.note}")


def ledger_rows(name: str) -> list[LedgerRow]:
    """The rows of one set, from its published numbers."""
    registration = read_registration(PUBLISHED / name)
    if registration is None:
        raise SystemExit(f"expected a published set in {PUBLISHED / name}, got none; run advnerf publish")
    data = read_json(PUBLISHED / name / "set" / "set.json")
    test = data["primary"][-1]
    scenario = registration.scenario(test["test"]["scenario"])
    assert scenario is not None, "a primary test is of a registered scenario"
    return rows_of(name, test, data["rows"], scenario.off_track_m)


def rows_of(
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
    kept = 100.0 * real["excess_m"] / said["excess_m"]
    left = f"{said['excess_m']:.3f} to {real['excess_m']:.3f} m per tick"
    return [
        LedgerRow(f"{name}: gradient minus the strongest random family, deployed natively, lower 95 % bound", round(low, 3), "half lanes per tick", target, met, command, note),
        LedgerRow(f"{name}: share of the surrogate's excess that is left, deployed natively", round(kept), "%", "", None, command, left),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
