"""How near is the adjoint's gradient to that of the true closed loop, over the horizon, in a real learned scene?

``python -m benchmarks.closed_loop_cosine RUN_FOLDER`` (an experiment whose stages capture, scene and policy are there).

At the start of the attack on the board at the corner, float64: for T = 10, 20, 40 and 60 ticks the loop is differenced over a
sweep of steps, along the gradient and along random directions beside it. A row has a cosine with its interval, or says that it
cannot be told because the differences depend on their step. A horizon that was measured is kept in ``--folder``.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.attack.closed_loop import closed_loop_cosine
from advnerf_core.attack.health import closed_loss
from advnerf_core.documents import dump_yaml, read_json, read_yaml
from advnerf_core.files import write_atomically, write_json
from benchmarks.results import REPOSITORY, record_row
from nodes.experiment.node.check import in_double
from nodes.experiment.node.prepare import load_request, prepare
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.attack import Prepared

COMMAND = "python -m benchmarks.closed_loop_cosine RUN_FOLDER"
HORIZONS = (10, 20, 40, 60)


def request_of(run_folder: Path, ticks: int, folder: Path) -> Experiment:
    """The attack of ``launch/corner.experiment.yaml`` on the scene and the policy of a run folder; written into ``folder``."""
    data = read_yaml(REPOSITORY / "launch" / "corner.experiment.yaml").data
    calibration = run_folder / "capture" / "calibration"
    data["world"] |= {
        "file": str(run_folder / "scene" / "scene.safetensors"),
        "calibration": str(calibration),
    }
    data["victims"] = {"mine": {"policy": str(run_folder / "policy" / "policy.safetensors")}}
    data["objects"][0]["face"]["target"] = str(calibration / "board.yaml")
    file = folder / "corner.experiment.yaml"
    write_atomically(file, dump_yaml(data | {"horizon": ticks}))
    return load_request(file, folder=folder)


def measured(prepared: Prepared, directions: int) -> dict[str, Any]:
    """The cosine of one horizon with everything that it was made from."""
    began = time.monotonic()
    exact = in_double(prepared)
    theta = prepared.space.surrogate.initial_theta(torch.Generator().manual_seed(prepared.seed)).double()
    gradient = adjoint_gradient(exact, theta).gradient
    found = closed_loop_cosine(partial(closed_loss, exact), theta, gradient, directions, seed=prepared.seed)
    return {**found.to_dict(), "clean": prepared.clean_drive.to_dict(), "seconds": time.monotonic() - began}


def kept_or_measured(prepared: Prepared, directions: int, folder: Path) -> dict[str, Any]:
    """The same, once for each scene, policy, request and number of directions."""
    file = folder / f"{prepared.settings_hash[:16]}_{directions}.json"
    if not file.exists():
        write_json(file, measured(prepared, directions))
    found: dict[str, Any] = read_json(file)
    return found


def record(ticks: int, prepared: Prepared, directions: int, found: dict[str, Any]) -> None:
    """Write the row of a horizon."""
    clean = prepared.clean_drive
    note = (
        f"start of the attack on the board at the corner, 1 start, float64, {directions} random directions beside the gradient, "
        f"steps 1 to 1e-5; drive without attack: total CTE {clean.mean_total_cte_m:.2f} m. Information: the adjoint does not claim it"
    )
    value: float | str = "cannot be told"
    if found["interval"] is None:
        swept = ", ".join(f"{at['cosine']:+.2f} at {at['step']:g}" for at in found["at_steps"])
        note += f". The finite differences depend on their step: {swept}"
    else:
        value, low, high = found["interval"]
        agreeing = f"{found['plateau'][0]:g} to {found['plateau'][-1]:g}"
        note += f". 95 % interval {low:+.3f} to {high:+.3f}; the finite differences agree at steps {agreeing}"
    record_row(f"cosine to the true closed loop, T = {ticks}", value, "cosine", "", None, COMMAND, note)


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--horizons", type=int, nargs="+", default=list(HORIZONS), help="ticks T")
    parser.add_argument("--count", type=int, default=4, help="random directions beside the gradient")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/closed_loop_cosine"), help="where results are kept"
    )
    options = parser.parse_args()
    for ticks in options.horizons:
        prepared = prepare(request_of(options.run_folder.resolve(), ticks, options.folder))
        found = kept_or_measured(prepared, options.count, options.folder)
        print(f"T = {ticks}: {found['in_words']} ({found['seconds']:.0f} s)", flush=True)
        record(ticks, prepared, options.count, found)


if __name__ == "__main__":
    main()
