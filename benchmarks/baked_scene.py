"""What does baking the scene gain, and what does it cost? ``python -m benchmarks.baked_scene RUN_FOLDER``.

In the scene and against the victims of a run folder of the room (``make demo``), on the same views and starts through the field and through
the baked scene. ``--pairs`` searches and deploys attacks both ways. ``--speed`` compares with the code before there were baked scenes;
there the run folder may be the junction's. ``--frames`` compares frames alone, in a run folder of any experiment whose scene was baked.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.methods import SearchRun, load_method
from advnerf_core.attack.search.record import Evaluation
from advnerf_core.documents import read_json
from advnerf_core.geometry import planar_poses
from advnerf_core.learning.recipe import recovery_states
from advnerf_core.objects.voxel.model import load_object, save_object
from advnerf_core.scene.surrogate import BackgroundRenderer
from advnerf_core.splats.scene_file import bake_scene
from benchmarks.results import REPOSITORY, record_row
from benchmarks.timing import seconds_in_turns
from nodes.experiment.plan.victims import HARDENED, NAIVE
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.faces import PaintedScene, face_space
from nodes.experiment.show.learned_scene import load_background, load_field
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps import bake as bake_stage
from nodes.experiment.steps.attack import attack_problem, search_settings

COMMAND = "python -m benchmarks.baked_scene"
_VIEWS, _EXCESS_M, _MOST_EVALUATIONS, _ITERATIONS, _SEEDS = 200, 0.15, 60, 50, 3
_TURNS = 7
Backgrounds = dict[str, BackgroundRenderer]


def record(
    line: str,
    value: float,
    unit: str,
    target: str,
    met: bool | None,
    note: str = "",
    options: str = "runs/demo",
) -> None:
    """A row of the ledger."""
    print(f"{line}: {value:.4g} {unit} ({target}); {note}", flush=True)
    record_row(line, value, unit, target, met, f"{COMMAND} {options}", note)


def fidelity(experiment: Experiment, backgrounds: Backgrounds) -> None:
    """PSNR of the held-out views as the bake stage found it, and the victim's steering on views that bricks were not made for."""
    found = read_json(experiment.stage_folder("bake") / "baked.json")
    lost_db = found["psnr_field_db"] - found["psnr_baked_db"]
    note = f"{found['psnr_baked_db']:.2f} dB of {found['psnr_field_db']:.2f} dB through the field; {found['mib']:.0f} MiB of voxels"
    record("baked scene: PSNR that held-out views lose", lost_db, "dB", "<= 0.3 dB", lost_db <= 0.3, note)
    path = experiment.paths[experiment.config.paths[0]]
    states = recovery_states(path, _VIEWS, np.random.default_rng(77), experiment.world.off_track_m, 0.3, None)
    poses, policy = (
        planar_poses(states) @ experiment.mount,
        load_victim(experiment, HARDENED).policy,
    )
    with torch.no_grad():
        on = {
            name: torch.cat(
                [policy(each(pose[None], experiment.view.pinhole)[0].permute(0, 3, 1, 2)) for pose in poses]
            )
            for name, each in backgrounds.items()
        }
    apart = (on["baked"] - on["field"]).abs()
    record(
        "baked scene: difference of steering", float(apart.mean()), "rad mean abs", "<= 0.002 rad", bool(apart.mean() <= 0.002),
        f"{_VIEWS} driving views within {experiment.world.off_track_m:g} m and 0.3 rad of the path; largest {float(apart.max()):.4f} rad",
    )  # fmt: skip


def frames(experiment: Experiment, backgrounds: Backgrounds, run: Path) -> None:
    """Time of a frame both ways, in turns, on views along the paths."""
    poses, pinhole = bake_stage.views_of(experiment)[::40], experiment.view.pinhole
    taken_s = seconds_in_turns(
        {name: partial(each, poses, pinhole) for name, each in backgrounds.items()}, _TURNS
    )
    found = read_json(experiment.stage_folder("bake") / "baked.json")
    bounds = "an unbounded" if experiment.world.box.contraction else "a bounded"
    each_ms = {name: 1e3 * seconds / len(poses) for name, seconds in taken_s.items()}
    note = (
        f"{experiment.config.name}, {run.name}: {each_ms['baked']:.1f} ms against {each_ms['field']:.1f} ms, medians of {_TURNS} runs in turns; held-out views "
        f"{found['psnr_baked_db']:.2f} dB against {found['psnr_field_db']:.2f} dB; {found['mib']:.0f} MiB of voxels"
    )
    ratio = taken_s["field"] / taken_s["baked"]
    line = f"frame of {bounds} scene, baked"
    record(line, ratio, "x as fast as through its field", "printed", None, note, "RUN --frames")


@contextmanager
def _code_of_before(run: Path, before: str) -> Iterator[tuple[Path, Path]]:
    """The code of a commit, with our script of measurements, and the run folder as that code can read it."""
    with TemporaryDirectory() as work:
        old = Path(work) / "code"
        subprocess.run(
            ["git", "worktree", "add", "--detach", "-f", old, before],
            cwd=REPOSITORY,
            check=True,
            capture_output=True,
        )
        try:
            shutil.copy(REPOSITORY / "benchmarks" / "ticks.py", old / "benchmarks" / "ticks.py")
            _copy_as_of_before(run, Path(work) / "run")
            yield old, Path(work) / "run"
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", old], cwd=REPOSITORY, check=True)


def speed(run: Path, before: str, turns: int) -> None:
    """Ticks and iterations of this code and of that of a commit, each in processes of its own, in turns."""
    found: dict[str, list[dict[str, float]]] = {"before": [], "now": []}
    with _code_of_before(run, before) as (old, copy):
        for _ in range(turns):
            found["before"].append(_measured(old, copy))
            found["now"].append(_measured(REPOSITORY, run))
    where = "room" if "tick, 1" in found["now"][0] else "junction"
    lines = {
        "tick, 1": ("surrogate tick, one 64^3 object", 3.0),
        "tick, 5": ("surrogate tick, five 64^3 objects", 3.0),
        "iteration": (f"attack iteration, {where}", 2.5),
    }
    for name in found["now"][0]:
        line, least = lines[name]
        before_ms, now_ms = (median(each[name] for each in found[when]) for when in ("before", "now"))
        note = f"{now_ms:.1f} ms against {before_ms:.1f} ms; medians of {turns} processes each, in turns"
        ratio = before_ms / now_ms
        record(
            f"{line}, against the code before baked scenes",
            ratio,
            "x as fast",
            f">= {least:g} x",
            ratio >= least,
            note,
            f"runs/{run.resolve().name} --speed",
        )


def _measured(code: Path, run: Path) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": str(code)}
    environment.pop("OMP_WAIT_POLICY", None)  # each code as its commands would have it
    done = subprocess.run(
        # As a module: run by its path, it would find benchmarks/coverage.py where numba looks for coverage.
        [sys.executable, "-W", "ignore", "-m", "benchmarks.ticks", run.resolve()],
        cwd=code,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _copy_as_of_before(run: Path, target: Path) -> None:
    """A run folder that the code before can read: the scene in single precision, with the header that it knew."""
    for stage in ("capture", "policy", "scene", "object"):
        if not (run / stage).exists():  # a panel is built when it is needed
            continue
        shutil.copytree(
            run / stage,
            target / stage,
            ignore=shutil.ignore_patterns("photos", "frames", "*.checkpoint.*", "views"),
        )
    manifest = read_json(run / "manifest.json")
    for unknown in ("reference", "measure"):
        del manifest["config"][unknown]
    (target / "manifest.json").write_text(json.dumps(manifest))
    for file in target.glob("object/*.safetensors"):  # a surface between voxels was not known
        model = load_object(file)
        save_object(file, replace(model, grids=replace(model.grids, density=model.grids.density.clip(0.0))))
    file = target / "scene" / "scene.safetensors"
    with safe_open(file, framework="pt") as scene:
        header = scene.metadata()
        tensors = {name: scene.get_tensor(name) for name in scene.keys()}  # noqa: SIM118 - not a dict
    tensors["grid.table"] = tensors["grid.table"].float()
    config = {
        key: value
        for key, value in json.loads(header["config"]).items()
        if key not in ("contraction", "learned_background")
    }
    save_file(tensors, file, {**header, "format": "advnerf-scene-1", "config": json.dumps(config)})


def _problem(experiment: Experiment, background: BackgroundRenderer, victim: str, seed: int) -> AttackProblem:
    policy = load_victim(experiment, victim)
    return attack_problem(
        experiment, face_space(experiment, background), policy, experiment.config.paths[0], seed
    )


class _ReachedError(Exception):
    """The search found what was asked for."""


def reach(experiment: Experiment) -> None:
    """From a trained scene to an attack: baking, and the search until it predicts enough."""
    began = time.perf_counter()
    baked = bake_scene(load_field(experiment), bake_stage.views_of(experiment), experiment.view.pinhole)
    baking_s = time.perf_counter() - began
    problem, space = _problem(experiment, baked, HARDENED, 0), face_space(experiment, baked)
    plain_m = float(evaluate(problem, space.surrogate.plain_theta())[1].protocol_cte_m.mean())
    best: list[tuple[float, int]] = []

    def told(evaluation: Evaluation) -> None:
        excess_m = (evaluation.predicted_total_cte_m - plain_m) / problem.steps
        best.append((excess_m, evaluation.iteration))
        if excess_m >= _EXCESS_M:
            raise _ReachedError

    settings = replace(search_settings(experiment, load_method("gradient")), evaluations=_MOST_EVALUATIONS)
    with suppress(_ReachedError):
        space.search("gradient", problem, settings, SearchRun(0, None, told))
    taken_s, (excess_m, iteration) = time.perf_counter() - began, max(best)
    record(
        "trained scene to an attack that predicts an excess of 0.15 m a tick",
        taken_s,
        "s",
        "<= 8 s",
        taken_s <= 8.0 and excess_m >= _EXCESS_M,
        f"hardened victim, T = {problem.steps}: {excess_m:.3f} m a tick after {iteration + 1} evaluations; {baking_s:.0f} s of it baking",
    )


def totals(experiment: Experiment, backgrounds: Backgrounds) -> None:
    """What searches through the baked scene and through the field find, from the same noise; all of it judged by the field."""
    settings = replace(search_settings(experiment, load_method("gradient")), evaluations=_ITERATIONS)
    found_m: dict[str, list[float]] = {name: [] for name in backgrounds}
    for seed in range(_SEEDS):
        judge = _problem(experiment, backgrounds["field"], HARDENED, seed)
        for name, each in backgrounds.items():
            problem = _problem(experiment, each, HARDENED, seed)
            theta = face_space(experiment, each).search("gradient", problem, settings, SearchRun(seed)).theta
            found_m[name].append(float(evaluate(judge, theta)[1].protocol_cte_m.mean()))
        print(f"seed {seed}: {found_m}", flush=True)
    spread_m = max(found_m["field"]) - min(found_m["field"])
    apart_m = abs(mean(found_m["baked"]) - mean(found_m["field"]))
    both = "; ".join(
        f"{name} {', '.join(f'{total:.3f}' for total in each)} m" for name, each in found_m.items()
    )
    record(
        f"totals after {_ITERATIONS} iterations through a baked scene and through the field",
        apart_m,
        "m apart in the mean",
        f"<= {spread_m:.3f} m, the seeds' spread through the field",
        apart_m <= spread_m,
        f"{_SEEDS} seeds, room, T = {judge.steps}: {both}",
        "runs/demo --totals",
    )


def searched_pairs(
    experiment: Experiment, backgrounds: Backgrounds, victims: Sequence[str]
) -> list[dict[str, float]]:
    """Excess [m a tick] of attacks found through each background, from the same starts and seeds, deployed in the world."""
    # Seeds of one start would repeat one drive.
    attack = experiment.config.attack.model_copy(update={"nominal_start": False})
    experiment = replace(experiment, config=experiment.config.model_copy(update={"attack": attack}))
    scenario, rows = experiment.config.paths[0], []
    settings = search_settings(experiment, load_method("gradient"))
    with experiment.open_world() as scene:
        dressed = PaintedScene(experiment, scene)
        for victim in victims:
            policy = load_victim(experiment, victim).policy
            for seed in range(_SEEDS):
                starts = experiment.start_states(scenario, seed)
                driven = partial(deployed_drives, experiment, dressed, policy, scenario, starts)
                plain_m = [drive.metrics.total_cte_m for drive in driven(None)]
                found = {}
                for name, each in backgrounds.items():
                    problem = _problem(experiment, each, victim, seed)
                    theta = (
                        face_space(experiment, each)
                        .search("gradient", problem, settings, SearchRun(seed))
                        .theta
                    )
                    totals_m = [drive.metrics.total_cte_m for drive in driven(theta)]
                    found[name] = float(np.mean(np.subtract(totals_m, plain_m))) / experiment.config.horizon
                rows.append(found)
                print(f"{victim}, seed {seed}: {found}", flush=True)
    return rows


def pairs(experiment: Experiment, backgrounds: Backgrounds) -> None:
    """Attacks found both ways, from the same starts and seeds, deployed in the world."""
    rows = searched_pairs(experiment, backgrounds, (HARDENED, NAIVE))
    field_m, baked_m = (float(mean(row[name] for row in rows)) for name in ("field", "baked"))
    difference = abs(baked_m - field_m) / field_m
    evaluations = search_settings(experiment, load_method("gradient")).evaluations
    note = f"{baked_m:.4f} m a tick against {field_m:.4f} m; {len(rows)} pairs of searches, two victims, three starts, {evaluations} evaluations each"
    record(
        "deployed excess of attacks found through a baked scene and through the field",
        100 * difference,
        "% apart",
        "<= 10 %",
        difference <= 0.1,
        note,
        "runs/demo --pairs",
    )


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--speed", action="store_true", help="compare with the code of a commit, instead")
    parser.add_argument("--before", default="fad839a", help="that commit")
    parser.add_argument(
        "--totals",
        action="store_true",
        help="compare what fifty iterations find both ways, instead (minutes)",
    )
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument(
        "--pairs", action="store_true", help="search and deploy attacks both ways, instead (minutes)"
    )
    parser.add_argument("--frames", action="store_true", help="compare frames alone, in any run folder")
    options = parser.parse_args()
    experiment = Experiment.resolved_in(options.run.resolve())
    backgrounds: Backgrounds = {"field": load_field(experiment), "baked": load_background(experiment)}
    if options.frames:
        frames(experiment, backgrounds, options.run)
        return
    if options.pairs:
        pairs(experiment, backgrounds)
        return
    if options.totals:
        totals(experiment, backgrounds)
        return
    if options.speed:
        speed(options.run, options.before, options.turns)
        return
    fidelity(experiment, backgrounds)
    reach(experiment)


if __name__ == "__main__":
    main()
