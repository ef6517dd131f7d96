"""Question: does retraining on found attacks cure the policy, and for how long? ``python -m benchmarks.retraining RUN_FOLDER``.

Reads what ``advnerf experiment launch/intersection.experiment.yaml --setting retrain`` wrote; computes nothing anew.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.results import record_row

_TARGET = 1.1


def rows_of(summary: dict[str, Any]) -> list[tuple[str, float, str, str, bool | None, str]]:
    """Rows of the ledger: the retrained policy under the old attacks, and what attacks on each round's policy are worth."""
    rows: list[tuple[str, float, str, str, bool | None, str]] = []
    for name, drive in summary["old_attacks"].items():
        note = (
            f"one seed, one start that nothing has seen, deployed: original undisturbed {drive['original_undisturbed_m']:.2f} m, attacked "
            f"{drive['original_attacked_m']:.2f} m; retrained undisturbed {drive['retrained_undisturbed_m']:.2f} m, attacked {drive['retrained_attacked_m']:.2f} m"
        )
        line = f"#5 retrained under the old attack, {name}, over the original undisturbed"
        rows.append((line, drive["ratio"], "x", f"<= {_TARGET} x", drive["ratio"] <= _TARGET, note))
    for number, each in enumerate(summary["rounds"]):
        for name in each["surrogate"]:
            line = f"#5 attack -> retrain -> attack, round {number}, {name}, deployed"
            note = f"in the learned scene {each['surrogate'][name]:.2f} x; victim {each['victim'][:12]}, gradient, one seed"
            if number == len(summary["rounds"]) - 1 and max(each["surrogate"].values()) >= summary["pays_ratio"]:
                note += f"; the number of rounds ended the loop: an attack pays from {summary['pays_ratio']:g} x in the learned scene"
            rows.append((line, each["deployed"][name], "x no attack", "", None, note))
    return rows


def command_of(manifest: dict[str, Any], summary: dict[str, Any], folder: Path) -> str:
    """What makes these rounds: other commands may have used the run folder since."""
    file = Path("launch") / Path(manifest["file"]).name
    rounds = len(summary["rounds"]) - 1
    return (
        f"advnerf experiment {file} --setting {manifest['setting']} --run-folder {folder} --set retrain.rounds={rounds}"
    )


def main() -> None:
    """Record the rows."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the intersection's experiment")
    parser.add_argument("--dry", action="store_true", help="print only")
    options = parser.parse_args()
    summary = json.loads((options.folder / "retrain" / "retrain.json").read_text())
    command = command_of(json.loads((options.folder / "manifest.json").read_text()), summary, options.folder)
    for line, value, unit, target, met, note in rows_of(summary):
        print(f"{line}: {value:.2f} {unit} (target {target or '-'}): {met}")
        if not options.dry:
            record_row(line, value, unit, target, met, command, note)


if __name__ == "__main__":
    main()
