"""Judging a victim: what N textures do to it in the surrogate, and which searches were begun with the verdict there."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.search import textures
from advnerf_core.fields.colour_grid import colour_grid
from advnerf_core.report.evidence.hardness import FILE, HardnessError, read_hardness
from benchmarks.victim_hardness import judge
from nodes.experiment.engine.run_folder import SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.run.cells import search_cell
from nodes.experiment.show.spaces import make_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem, from_measured_starts, past

STARTS, TEXTURES = 3, 2


@pytest.fixture
def ours(trained, tmp_path):
    """The untrained experiment in a folder of its own, along one path, with a few measured starts."""
    folder = tmp_path / "run"
    for stage in ("scene", "object", "policy"):
        shutil.copytree(trained.stage_folder(stage), folder / stage)
    measure = trained.config.measure.model_copy(update={"starts": STARTS})
    config = trained.config.model_copy(update={"measure": measure, "paths": ("right",)})
    return replace(trained, folder=folder, config=config)


def test_the_worst_texture_is_the_largest_excess_of_drives_with_textures_drawn_again(ours):
    import torch

    verdict = judge(ours, HARDENED, TEXTURES)
    (found,) = verdict.families
    assert (found.scenario, found.family, verdict.starts) == ("right", "random_natural", STARTS)
    assert verdict.margin_m == pytest.approx(0.1 * ours.limits.off_track_m)
    # Again, with textures of the family drawn here and driven one by one.
    space = make_space(ours, None)
    problem = attack_problem(ours, space, load_victim(ours, HARDENED), "right", verdict.seed)
    problem = from_measured_starts(ours, "right", problem)
    generator = torch.Generator().manual_seed(verdict.seed)
    grids = [colour_grid(field) for field in space.surrogate.objects]
    plain_m = evaluate(past(problem, space, space.plain), space.plain.colours)[1].protocol_cte_m.numpy()
    excess_m = []
    for _ in range(TEXTURES):
        theta = ours.config.attack.random_sigma * torch.cat(
            [textures.natural(grid, generator) for grid in grids]
        )
        driven_m = evaluate(problem, theta)[1].protocol_cte_m.numpy()
        excess_m.append(np.mean(driven_m - plain_m) / problem.steps)
    assert found.excess_m == pytest.approx(excess_m, abs=1e-9)
    assert found.worst_m == pytest.approx(max(excess_m), abs=1e-9)
    # A victim is judged once.
    assert judge(ours, HARDENED, 5) == verdict
    assert read_hardness(ours.folder / FILE).verdicts == (verdict,)


def test_a_search_keeps_the_verdict_that_was_there_when_it_began(ours, tmp_path):
    def hardness_of(seed):
        folder = tmp_path / "cells" / str(seed)
        search_cell(ours, Cell("right", HARDENED, "gradient", seed), folder, lambda part, text="": None)
        return json.loads((folder / SEARCHED).read_text())["hardness"]

    assert hardness_of(0) == ""
    verdict = judge(ours, HARDENED, TEXTURES)
    assert verdict.passed  # random weights steer by nothing
    assert hardness_of(1) == verdict.digest
    # A search that was begun without a verdict stays without one, also where it is finished later.
    (tmp_path / "cells" / "0" / SEARCHED).unlink()
    assert hardness_of(0) == ""


def test_a_victim_is_not_judged_after_a_gradient_search(ours):
    ours.cell_folder(Cell("right", HARDENED, "gradient", 0)).mkdir(parents=True)
    with pytest.raises(HardnessError, match="before any gradient search"):
        judge(ours, HARDENED, TEXTURES)
    assert not (ours.folder / FILE).exists()
