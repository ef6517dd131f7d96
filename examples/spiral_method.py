"""A method of attack of your own: it walks along a spiral of textures.

    .venv/bin/python examples/spiral_method.py
    .venv/bin/advnerf attack run launch/corner.attack.yaml -o runs/spiral --set search.method=../examples/spiral_method.py:Spiral

The method is a function and a `Method` that says what the function needs; see docs/methods.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from advnerf_core.attack.methods import Method, SearchRun, SearchSettings, load_method
from advnerf_core.attack.search.search import SearchResult, begin, evaluate_theta, search_fingerprint
from benchmarks.attack_toy import toy_problem

EVALUATIONS = 10


@dataclass(frozen=True)
class Options:
    """What only this method knows.

    Attributes:
        turns: Turns of the spiral per evaluation.
        growth: How far theta grows per evaluation.
    """

    turns: float = 0.1
    growth: float = 0.4


def search(problem: Any, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """Evaluate textures along a spiral in a random plane; a stopped search goes on from its state file."""
    options, shape = settings.options, problem.sensor.theta_shape
    across, up = torch.randn((2, *shape), generator=torch.Generator().manual_seed(run.seed))
    fingerprint = search_fingerprint(
        problem, shape, method="spiral", seed=run.seed, options=repr(options), hash=run.settings_hash
    )
    state = begin(run.state_path, fingerprint, dict)
    while (number := len(state.history)) < settings.evaluations:
        angle = torch.tensor(2.0 * torch.pi * options.turns * number)
        theta = options.growth * number * (torch.cos(angle) * across + torch.sin(angle) * up)
        evaluate_theta(problem, theta, state, run, fingerprint)
    return state.result()


Spiral = Method(search, Options=Options)


if __name__ == "__main__":
    problem = toy_problem(steps=10, resolution=8, dtype=torch.float32)
    print(f"total cross-track error after {EVALUATIONS} evaluations of each method:")
    for reference in (f"{__file__}:Spiral", "random", "gradient"):
        method = load_method(reference)
        settings = SearchSettings(EVALUATIONS, learning_rate=0.5, options=method.options({}))
        if reference == "random":
            settings = SearchSettings(EVALUATIONS)
        found = method.search(problem, settings, SearchRun(seed=0))
        print(f"  {reference.rpartition(':')[2]:9} {found.best.predicted_total_cte_m:.3f} m")
