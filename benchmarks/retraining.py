"""Question: does retraining on found attacks cure the policy, and for how long? ``python -m benchmarks.retraining RUN_FOLDER``.

Reads what ``advnerf experiment run launch/junction.experiment.yaml --setting retrain`` wrote; computes nothing anew. Runs with other seeds are added
with ``--seed``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from benchmarks.results import REPOSITORY, LedgerRow
from nodes.experiment.show.given import victim_spec
from nodes.experiment.steps import retrain_plot
from nodes.experiment.steps.run import load_experiment

_TARGET = 1.1
_DRIVES = ("original_undisturbed", "original_attacked", "retrained_undisturbed", "retrained_attacked")
COMMAND = "advnerf experiment run launch/junction.experiment.yaml --setting retrain --folder runs/retrain"
_KEPT = REPOSITORY / "docs" / "results" / "retrain"


def kept_summaries() -> list[dict[str, Any]]:
    """What was found with each seed; the first one's policies are kept too."""
    return [read_json(file) for file in (_KEPT / "retrain.json", *sorted(_KEPT.glob("seed_*.json")))]


def ledger_rows() -> list[LedgerRow]:
    """Rows of what is kept."""
    return rows_of(kept_summaries())


def rows_of(seeds: Sequence[dict[str, Any]]) -> list[LedgerRow]:
    """Rows of the ledger, means over seeds: the retrained policies under the old attacks, and what attacks on each round's policies are worth."""
    rows = list[LedgerRow]()
    for name in seeds[0]["old_attacks"]:
        drives = [each["old_attacks"][name] for each in seeds]
        totals = (
            f"{part.replace('_', ' ')} {_each([drive[f'{part}_m'] for drive in drives], 2)} m"
            for part in _DRIVES
        )
        ratios = [drive["ratio"] for drive in drives]
        line = f"retrained once, under the old attack, {name}, over the original undisturbed"
        note = f"seeds in turn: {_each(ratios, 3)}; one start that nothing has seen, deployed: {'; '.join(totals)}"
        ratio = float(np.mean(ratios))
        rows.append(LedgerRow(line, ratio, "x", f"<= {_TARGET} x", ratio <= _TARGET, COMMAND, note))
    for number in range(max(len(each["rounds"]) for each in seeds)):
        rows += _round_rows(
            number, {seed: each for seed, each in enumerate(seeds) if number < len(each["rounds"])}
        )
    return rows


def _round_rows(number: int, seeds: Mapping[int, dict[str, Any]]) -> list[LedgerRow]:
    rounds, rows = [each["rounds"][number] for each in seeds.values()], list[LedgerRow]()
    paying = sum(
        max(each["surrogate"].values()) > seed["pays_m"]
        for each, seed in zip(rounds, seeds.values(), strict=True)
    )
    pays_m = next(iter(seeds.values()))["pays_m"]
    for name in rounds[0]["surrogate"]:
        deployed_m, learned_m = (
            [each[domain][name] for each in rounds] for domain in ("deployed", "surrogate")
        )
        note = (
            f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}: {_each(deployed_m, 3)} m; in the learned scene {_each(learned_m, 3)} m; "
            f"gradient, victims {', '.join(each['victim'][:12] for each in rounds)}; an attack pays on {paying} of {len(seeds)}: above {pays_m:g} m per "
            "tick in the learned scene, on any path"
        )
        line = (
            f"attack on the policy after {number} round{'s' * (number != 1)} of retraining, {name}, deployed"
        )
        value = float(np.mean(deployed_m))
        rows.append(LedgerRow(line, value, "m per tick of excess", "", None, COMMAND, note))
    return rows


def _each(values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def publish(found: Path, original: Path, docs: Path) -> None:
    """The rounds and the attacked policies of the first seed into the documentation."""
    text, kept = (found / "retrain.json").read_text(), docs / "results" / "retrain"
    summary = read_json(found / "retrain.json")
    write_atomically(kept / "retrain.json", text)
    for number in range(len(summary["rounds"])):
        file = found / f"round{number - 1}" / "policy.safetensors" if number else original
        write_atomically(kept / f"policy_{number}.safetensors", file.read_bytes())


def main() -> None:
    """Put rounds and curve into docs/, and record the rows of all seeds."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the intersection's experiment")
    parser.add_argument(
        "--seed", type=int, default=0, help="its seed; above 0: a further one, whose policies are not kept"
    )
    options = parser.parse_args()
    experiment = load_experiment(
        REPOSITORY / "launch" / "junction.experiment.yaml", "retrain", [], options.folder
    )
    found = experiment.stage_folder("retrain")
    if options.seed:
        write_atomically(_KEPT / f"seed_{options.seed}.json", (found / "retrain.json").read_text())
    else:
        original = Path(victim_spec(experiment, experiment.config.main_victim))
        publish(found, original, REPOSITORY / "docs")
    seeds = kept_summaries()
    longest = max(seeds, key=lambda each: len(each["rounds"]))
    retrain_plot.draw(REPOSITORY / "docs" / "retraining.png", longest["rounds"], longest["pays_m"])
    for row in rows_of(seeds):
        print(f"{row.line}: {row.value:.2f} {row.unit} (target {row.target or '-'}): {row.met}")
        row.record()


if __name__ == "__main__":
    main()
