"""Does a victim withstand random textures? ``python -m benchmarks.hardening RUN_FOLDER`` judges one, and keeps the verdict.

Run it when the policies are trained, and before any gradient search: ``advnerf experiment run FILE --until policy``. Without a run folder it tells what the
best random search of each published set did to the set's victim, from the kept drives.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from advnerf_core.report.evidence.verifying.layout import complete_sets
from benchmarks.results import record_row
from benchmarks.strongest import Strongest, strongest_random
from nodes.experiment.plan.victims import HARDENED

PUBLISHED = Path("docs/results")


def main() -> None:
    """Judge the victim of a run folder, or read the published sets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, nargs="?", help="run folder; without one: the published sets")
    parser.add_argument("--victim", default=HARDENED)
    parser.add_argument(
        "--textures", type=int, default=0, help="of each family; 0: as many as a search evaluates"
    )
    options = parser.parse_args()
    if options.run is None:
        for name in complete_sets(PUBLISHED):
            for found in strongest_random(PUBLISHED / name):
                _record_published(name, found)
    else:
        _judge(options.run, options.victim, options.textures)


def _judge(run: Path, victim: str, textures: int) -> None:
    from benchmarks.victim_hardness import judge
    from nodes.experiment.show.context import Experiment

    experiment = Experiment.resolved_in(run.resolve())
    verdict = judge(experiment, victim, textures)
    for found in verdict.families:
        bound = "no bound from one start" if found.upper_m is None else f"at most {found.upper_m:.4f} m"
        met = found.upper_m is not None and found.upper_m <= verdict.margin_m
        note = (
            f"mean over {verdict.starts} starts, {bound} (one-sided {100 * verdict.level:.0f} %); trained on {', '.join(verdict.trained_on)}; surrogate; "
            f"policy {verdict.policy_sha256[:12]}"
        )
        print(
            f"{found.scenario}, {found.family}: worst of {verdict.textures} textures {found.worst_m:.4f} m per tick, {note}"
        )
        record_row(
            f"{experiment.config.name}, {found.scenario}: {victim} with the worst of {verdict.textures} textures, {found.family}",
            found.worst_m,
            "m per tick",
            f"upper bound <= {verdict.margin_m:g} m",
            met,
            f"python -m benchmarks.hardening {run}",
            note,
        )
    print(
        "passed: pages call it hardened"
        if verdict.passed
        else "not passed: pages call it trained with textures"
    )


def _record_published(name: str, found: Strongest) -> None:
    victim = "" if found.victim == HARDENED else found.victim
    place = f"{found.scenario} {victim}".strip().replace("_", " ")
    for domain, reached in (("learned scene", found.surrogate), ("deployed", found.deployed)):
        print(f"{name}, {place}, {domain}: {found.how}: {reached.text}")
        record_row(
            f"{name}, {place}: best random search against the victim, {domain}",
            reached.best_m,
            "m per tick",
            f"<= {found.margin_m:g} m, the margin of a hardened victim",
            reached.best_m <= found.margin_m,
            "python -m benchmarks.hardening",
            f"{found.how}: {reached.text}",
        )


if __name__ == "__main__":
    main()
