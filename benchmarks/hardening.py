"""Does the hardened victim ignore random textures, also of families it was not trained on? ``python -m benchmarks.hardening RUN_FOLDER``.

Run it before any gradient: the label "hardened" needs equivalence to no attack on the families that validate.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from benchmarks.results import record_row


def main() -> None:
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.context import Experiment
    from nodes.experiment.hardening import TRAINED_ON, hardness, margin_m
    from nodes.experiment.policy import HARDENED

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--textures", type=int, default=12)
    options = parser.parse_args()
    experiment = Experiment.resolved_in(options.run.resolve())
    limit_m = margin_m(experiment)
    for found in hardness(experiment, HARDENED, options.textures):
        test, role = found.test, "trained on" if found.family == TRAINED_ON else "validates"
        interval = test.interval
        note = (
            f"{role}; 90 % interval {interval.low:.3f} to {interval.high:.3f} m, p = {test.p:.4f}; worst texture {found.worst_m:.3f} m; "
            f"{options.textures} textures x {experiment.config.measure.starts} starts, surrogate"
        )
        print(f"{found.scenario}, {found.family}: {interval.mean:.4f} m per tick, {note}")
        record_row(
            f"{experiment.config.name}, {found.scenario}: hardened victim past {found.family}, mean excess",
            interval.mean,
            "m per tick",
            f"equivalent to 0 within {limit_m:g} m",
            test.equivalent,
            f"python -m benchmarks.hardening {options.run}",
            note,
        )


if __name__ == "__main__":
    main()
