"""Question: does retraining on found attacks cure the policy, and for how long? ``python -m benchmarks.retraining RUN_FOLDER``.

Reads what ``advnerf experiment run launch/junction.experiment.yaml --setting retrain`` wrote; computes nothing anew.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from benchmarks.results import REPOSITORY, record_row
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_spec
from nodes.experiment.steps import retrain_plot
from nodes.experiment.steps.run import load_experiment

_TARGET = 1.1


def rows_of(summary: dict[str, Any], allowed: int) -> list[tuple[str, float, str, str, bool | None, str]]:
    """Rows of the ledger: the retrained policy under the old attacks, and what attacks on each round's policy are worth; ``allowed`` rounds may be run."""
    rows: list[tuple[str, float, str, str, bool | None, str]] = []
    for name, drive in summary["old_attacks"].items():
        note = (
            f"one seed, one start that nothing has seen, deployed: original undisturbed {drive['original_undisturbed_m']:.2f} m, attacked "
            f"{drive['original_attacked_m']:.2f} m; retrained undisturbed {drive['retrained_undisturbed_m']:.2f} m, attacked {drive['retrained_attacked_m']:.2f} m"
        )
        line = f"retrained once, under the old attack, {name}, over the original undisturbed"
        rows.append((line, drive["ratio"], "x", f"<= {_TARGET} x", drive["ratio"] <= _TARGET, note))
    for number, each in enumerate(summary["rounds"]):
        for name in each["surrogate"]:
            line = f"attack on the policy after {number} round{'s' * (number != 1)} of retraining, {name}, deployed"
            note = f"in the learned scene {each['surrogate'][name]:.3f} m; victim {each['victim'][:12]}, gradient, one seed"
            if number == len(summary["rounds"]) - 1 and max(each["surrogate"].values()) > summary["pays_m"]:
                ended = (
                    "the number of rounds ended the loop"
                    if number >= allowed
                    else f"the loop was stopped before its {allowed} rounds were over"
                )
                note += (
                    f"; {ended}: an attack pays above {summary['pays_m']:g} m per tick in the learned scene"
                )
            rows.append((line, each["deployed"][name], "m per tick of excess", "", None, note))
    return rows


def command_of(experiment: Experiment) -> str:
    """What makes these rounds: the manifest's command may be of something else that has used the run folder since."""
    file = experiment.file.relative_to(REPOSITORY)
    folder = os.path.relpath(experiment.folder, REPOSITORY)
    return f"advnerf experiment run {file} --setting {experiment.setting} --folder {folder}"


def publish(found: Path, original: Path, docs: Path) -> None:
    """The rounds, the attacked policies and the curve into the documentation."""
    text, kept = (found / "retrain.json").read_text(), docs / "results" / "retrain"
    summary = json.loads(text)
    write_atomically(kept / "retrain.json", text)
    for number in range(len(summary["rounds"])):
        file = found / f"round{number - 1}" / "policy.safetensors" if number else original
        write_atomically(kept / f"policy_{number}.safetensors", file.read_bytes())
    retrain_plot.draw(docs / "retraining.png", summary["rounds"], summary["pays_m"])


def main() -> None:
    """Record the rows, and put rounds and curve into docs/."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the intersection's experiment")
    parser.add_argument("--dry", action="store_true", help="print only")
    options = parser.parse_args()
    experiment = load_experiment(
        REPOSITORY / "launch" / "junction.experiment.yaml", "retrain", [], options.folder
    )
    found = experiment.stage_folder("retrain")
    summary = read_json(found / "retrain.json")
    allowed = experiment.config.retrain.rounds if experiment.config.retrain else 0
    for line, value, unit, target, met, note in rows_of(summary, allowed):
        print(f"{line}: {value:.2f} {unit} (target {target or '-'}): {met}")
        if not options.dry:
            record_row(line, value, unit, target, met, command_of(experiment), note)
    if not options.dry:
        original = Path(victim_spec(experiment, experiment.config.main_victim))
        publish(found, original, REPOSITORY / "docs")


if __name__ == "__main__":
    main()
