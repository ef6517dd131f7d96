"""Trains the victims of the demo with the code on the path, of this build or of an earlier one; run by ``benchmarks.victim_training``.

It prints the user core-seconds and the seconds that the stage took, without imports, as JSON. An earlier build has its modules elsewhere.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from importlib import import_module
from pathlib import Path
from typing import Any

LAUNCH_FILE = Path("launch/room.experiment.yaml")


def main() -> None:
    """Train into the folder ``policy`` of a run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run_folder", type=Path, help="a run whose scene is learned and baked")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--number-type", choices=["float32", "bfloat16"])
    arguments = parser.parse_args()
    stages, policy = _modules()
    options = {}
    if arguments.number_type:
        options["number_type"] = getattr(import_module("torch"), arguments.number_type)
    experiment = stages.load_experiment(LAUNCH_FILE.resolve(), "demo", arguments.set, arguments.run_folder)
    output = arguments.run_folder / "policy"
    output.mkdir()
    began, began_s = resource.getrusage(resource.RUSAGE_SELF).ru_utime, time.perf_counter()
    policy.run(experiment, output, lambda *_, **__: None, **options)
    user_s, wall_s = resource.getrusage(resource.RUSAGE_SELF).ru_utime - began, time.perf_counter() - began_s
    print(json.dumps({"user_s": user_s, "wall_s": wall_s}))


def _modules() -> tuple[Any, Any]:
    import_module("advnerf_core")  # before torch: it chooses how torch's threads wait
    try:
        return import_module("nodes.experiment.steps.run"), import_module("nodes.experiment.steps.policy")
    except ModuleNotFoundError:  # af4e442
        return import_module("nodes.experiment.run"), import_module("nodes.experiment.policy")


if __name__ == "__main__":
    main()
