"""Attacks on a policy that can only be asked, at equal policy calls: ``python -m benchmarks.black_box RUN_FOLDER``.

In the learned scene of an experiment's run folder, against its hardened victim written as an ONNX file, on its one path. Methods:

- white box: the gradient attack on the same policy in torch; its calls are iterations x starts x ticks, forward only;
- distilled, guided: `advnerf_core.attack.search.black_box`; everything that is asked counts;
- evolution, cem, random: closed-loop evaluations only, starts x ticks calls each; random textures are the floor.

The effect is what the best texture so far adds to the total CTE of the plain board, and is given as a share of the white box's. Every
method gets up to ``--multiple`` times the white box's calls, piece by piece: searches keep their state under the output folder, a
piece ends after ``--minutes``, and the next call goes on. The rows of the methods asked for are recorded when they are through
(``--record`` before).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from advnerf_core.attack.adjoint import AttackProblem, BlackBoxError, adjoint_gradient, evaluate
from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.methods import SearchRun, SearchSettings, load_method
from advnerf_core.attack.search.black_box import BlackBoxSearch, black_box_attack
from advnerf_core.attack.search.distil import Distillation
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.query_count import CountedPolicy, calls_per_evaluation
from advnerf_core.attack.search.record import Evaluation, OnEvaluation
from advnerf_core.attack.search.search import draw_start_states
from advnerf_core.documents import read_json
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.files import write_atomically, write_json
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import load_any_policy
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.attack_lab import lab_problem
from benchmarks.results import record_row
from calibration.schema import RoomCalibration, load_calibration

LINE = "black box"
MethodName = Literal["distilled", "guided", "evolution", "cem", "random"]
METHODS: tuple[MethodName, ...] = get_args(MethodName)
MARKS = (1, 2, 5, 10, 20, 50)
TARGET_SHARE, TARGET_MULTIPLE = 0.6, 50
ITERATIONS, STARTS = 50, 3


class OutOfTimeError(Exception):
    """A piece is over; the state file goes on from here."""


def make_problem(folder: Path, steps: int) -> AttackProblem:
    """The experiment's own attack: its face where its attack files have it, its starts of seed 0, over fewer ticks."""
    attack = load_attack(folder / "cells" / "track_hardened_gradient_0" / "attack.safetensors")
    plain = read_json(folder / "manifest.json")["config"]["carrier"]["plain_rgb"]
    shown, carrier = attack.required_face(), attack.face_object
    face = cube_face_object(
        shown.size_m[0], carrier.theta.shape[0], tuple(plain), carrier.T_world_from_object
    )
    problem = lab_problem(folder, [face], steps, time_batch=16, cache_bytes=512 * 2**20)
    nominal = tuple(problem.start_states[0].tolist())
    starts = draw_start_states((nominal[0], nominal[1], nominal[2]), STARTS, 0.1, 0)
    room = load_calibration(RoomCalibration, folder / "capture" / "calibration" / "room.yaml")
    fence_m = float(np.abs(np.array(room.fence_m)).min())
    return replace(problem, start_states=starts, fence_m=fence_m)


class Search:
    """One method in the output folder: its curve of best effect against calls, and its state.

    Args:
        name: Of the method.
        out: Output folder.
        per_evaluation: Calls of one drive.
    """

    def __init__(self, name: str, out: Path, per_evaluation: int) -> None:
        self.name, self.state_path = name, out / f"{name}.state.safetensors"
        self._curve_path, self._per_evaluation = out / f"{name}.json", per_evaluation
        self.curve: list[list[float]] = read_json(self._curve_path) if self._curve_path.exists() else []

    def listen(self, first_calls: int, step_calls: int, end_s: float) -> OnEvaluation:
        """What writes the curve: of evaluation k, ``first + k * step + one drive`` calls had been made when its total was known."""

        def told(evaluation: Evaluation) -> None:
            k = evaluation.iteration
            calls = (first_calls if k else 0) + k * step_calls + self._per_evaluation
            after_next = first_calls + (k + 2) * step_calls
            self.curve = [
                *self.curve[:k],
                [calls, evaluation.predicted_total_cte_m, evaluation.seconds, after_next],
            ]
            write_atomically(self._curve_path, json.dumps(self.curve))
            if time.monotonic() > end_s:
                raise OutOfTimeError

        return told

    def best_m(self, calls: float) -> float | None:
        """Best total CTE when so many calls had been made; None before the first, or if the search has not come so far."""
        totals = [total for made, total, *_ in self.curve if made <= calls]
        return max(totals) if totals else None


def runner(
    name: MethodName, problem: AttackProblem, calls: int, lessons: Distillation
) -> tuple[int, int, Callable[..., Any]]:
    """First calls, calls of a step, and the search of a method within a budget of calls."""
    each = calls_per_evaluation(problem)
    if name == "distilled" or name == "guided":
        search = BlackBoxSearch.usual(name, distillation=lessons)
        return (
            search.first_calls(),
            search.step_calls(problem),
            lambda **kept: black_box_attack(problem, search, calls, SearchRun(**kept)),
        )
    settings = SearchSettings(calls // each, population=20)
    return 0, each, lambda **kept: load_method(name).search(problem, settings, SearchRun(**kept))


def white_box(problem: AttackProblem, out: Path, end_s: float) -> tuple[float, float]:
    """Total CTE of the plain board, and of the best texture of the gradient attack."""
    search = Search("white_box", out, calls_per_evaluation(problem))
    told = search.listen(0, calls_per_evaluation(problem), end_s)
    if len(search.curve) < ITERATIONS:
        gradient_attack(problem, ITERATIONS, run=SearchRun(state_path=search.state_path, on_evaluation=told))
    surrogate = problem.sensor
    assert isinstance(surrogate, Surrogate)
    _, totals = evaluate(problem, surrogate.plain_theta())
    return float(totals.protocol_cte_m.mean()), max(total for _, total, *_ in search.curve)


def victim_of(folder: Path, out: Path) -> Any:
    """The hardened victim as an ONNX file, by the project's own export, behind a counter."""
    path = out / "victim.onnx"
    if not path.exists():
        loaded = load_policy(folder / "policy" / "policy.safetensors")
        export_onnx(loaded.policy, PolicyContract(loaded.view, goal_size=loaded.policy.goal_size), path)
    return CountedPolicy(load_any_policy(path).policy)


def about(folder: Path, steps: int) -> str:
    """Short hash of the victim, the scene, the attacked face and the ticks: another one has a folder of its own."""
    attack = load_attack(folder / "cells" / "track_hardened_gradient_0" / "attack.safetensors")
    policy = load_policy(folder / "policy" / "policy.safetensors")
    pose, size_m = attack.face_object.T_world_from_object, attack.required_face().size_m
    told = [policy.sha256, attack.scene_sha256, pose.tolist(), list(size_m), steps]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:8]


def shares(
    searches: list[Search], white_calls: int, none_m: float, white_m: float
) -> dict[str, dict[str, float]]:
    """Share of the white box's effect by method and multiple of its calls, as far as each search has come."""
    table: dict[str, dict[str, float]] = {}
    for search in searches:
        # A budget is used up when the next step, which is whole or not at all, would exceed it.
        marks = [mark for mark in MARKS if search.curve and mark * white_calls < search.curve[-1][3]]
        best = {str(mark): search.best_m(mark * white_calls) for mark in marks}
        table[search.name] = {
            mark: (m - none_m) / (white_m - none_m) for mark, m in best.items() if m is not None
        }
    return table


def draw(searches: list[Search], white_calls: int, none_m: float, white_m: float, path: Path) -> None:
    """Best effect so far against calls."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.5, 4.5), layout="constrained")
    for search in searches:
        if search.curve:
            calls, totals = np.array(search.curve)[:, :2].T
            effect = 100 * (np.maximum.accumulate(totals) - none_m) / (white_m - none_m)
            axes.step(calls / white_calls, effect, where="post", label=search.name)
    axes.axhline(100, color="black", linewidth=1, label="white box, 50 iterations")
    axes.axhline(100 * TARGET_SHARE, color="grey", linestyle="--", linewidth=1, label="target")
    axes.set(
        xscale="log", xlabel=f"policy calls / {white_calls}", ylabel="best effect so far / white box's [%]"
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def record(
    table: dict[str, dict[str, float]], none_m: float, white_m: float, white_calls: int, steps: int
) -> None:
    """Rows of the ledger."""
    command = "python -m benchmarks.black_box " + " ".join(sys.argv[1:])
    base = f"{white_calls} calls = {ITERATIONS} iterations x {STARTS} starts x {steps} ticks; none {none_m:.2f} m, white box {white_m:.2f} m"
    for name, row in table.items():
        if not row:
            continue
        last = max(row, key=int)
        reached = [mark for mark in row if row[mark] >= TARGET_SHARE]
        curve = ", ".join(f"{mark} x: {100 * share:.0f} %" for mark, share in row.items())
        aimed = name != "random"
        target = f">= {100 * TARGET_SHARE:.0f} % at {TARGET_MULTIPLE} x the calls" if aimed else ""
        met = bool(reached) if aimed and (reached or int(last) >= TARGET_MULTIPLE) else None
        note = f"{base}; best so far at {curve}"
        if int(last) < TARGET_MULTIPLE:
            note += f"; the search was ended at {last} x"
        record_row(
            f"{LINE}, {name}",
            100 * row[last],
            f"% of the white-box effect at {last} x",
            target,
            met,
            command,
            note,
        )


def main() -> None:
    """Go on for a piece; draw and print what is there; record when all methods are through."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/black_box"))
    parser.add_argument("--steps", type=int, default=40, help="ticks of a drive")
    parser.add_argument(
        "--multiple", type=float, default=50.0, help="calls of each method, in those of the white box"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--minutes", type=float, default=9.0, help="of this piece; call again to go on")
    parser.add_argument(
        "--record", action="store_true", help="record the rows although not all of them are through"
    )
    parser.add_argument(
        "--trial", action="store_true", help="small: 4 ticks, equal calls, another folder, no rows"
    )
    options = parser.parse_args()
    if options.trial:
        options.steps, options.multiple, options.out = (
            4,
            1.0,
            options.out.with_name(options.out.name + "_trial"),
        )
    options.out = options.out / about(options.run_folder, options.steps)
    options.out.mkdir(parents=True, exist_ok=True)
    print(f"in {options.out}")
    finished, numbers = _piece(options)
    table = numbers["shares"]
    for name, row in table.items():
        print(name, {mark: f"{100 * share:.0f} %" for mark, share in row.items()})
    if not options.trial and (finished or options.record):
        table = {name: table[name] for name in options.methods}
        record(table, numbers["none_m"], numbers["white_m"], numbers["white_calls"], options.steps)
    print("finished" if finished else "not finished: call again to go on")


def _piece(options: argparse.Namespace) -> tuple[bool, dict[str, Any]]:
    end_s = time.monotonic() + 60 * options.minutes
    white_problem = make_problem(options.run_folder, options.steps)
    white_calls = ITERATIONS * calls_per_evaluation(white_problem)
    problem = replace(white_problem, policy=victim_of(options.run_folder, options.out))
    _refuses_gradients(problem)
    try:
        none_m, white_m = white_box(white_problem, options.out, end_s)
    except OutOfTimeError:
        raise SystemExit("not finished: call again to go on") from None
    searches = [Search(name, options.out, calls_per_evaluation(problem)) for name in METHODS]
    lessons = Distillation(warm_pairs=24) if options.trial else Distillation()
    finished = True
    for name, search in zip(METHODS, searches, strict=True):
        if name not in options.methods:
            continue
        first, step, go = runner(name, problem, round(options.multiple * white_calls), lessons)
        try:
            go(state_path=search.state_path, on_evaluation=search.listen(first, step, end_s))
        except OutOfTimeError:
            finished = False
            break
    table = shares(searches, white_calls, none_m, white_m)
    draw(searches, white_calls, none_m, white_m, options.out / "black_box.png")
    numbers = {"none_m": none_m, "white_m": white_m, "white_calls": white_calls, "shares": table}
    write_json(options.out / "black_box.json", numbers)
    return finished, numbers


def _refuses_gradients(problem: AttackProblem) -> None:
    surrogate = problem.sensor
    assert isinstance(surrogate, Surrogate)
    try:
        adjoint_gradient(problem, surrogate.plain_theta())
    except BlackBoxError:
        return
    raise SystemExit("expected the ONNX victim to refuse a gradient, got one")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
