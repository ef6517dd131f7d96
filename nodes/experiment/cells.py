"""Cells of a campaign on the simulated lab: one search in the learned room, one live drive through the node graph.

A finished run folder of the same settings is taken as it is: its searches and live drives are cells already. Whatever it lacks (other seeds,
the cross-entropy method, the naive victim's other seeds) is computed here, by the same code.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.methods import method_name
from advnerf_core.driving.metrics import Horizon, first_still_tick
from advnerf_core.report.clips import ClipTrack, write_clip
from advnerf_core.report.conditions import NONE, style_of
from nodes.experiment import attack, deploy
from nodes.experiment.config import AttackConfig
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.finished import changed_settings, has_same_attacks, has_same_graph, is_finished
from nodes.experiment.learned_scene import load_background
from nodes.experiment.objects import attacked_object, surrogate_of
from nodes.experiment.run import load_experiment, run_experiment
from nodes.experiment.stages import hash_of, read_record
from nodes.lab.trials import evaluation
from nodes.lab.trials.trial import STALLED, counts
from nodes.runtime.errors import ConfigError, RuntimeFault
from nodes.runtime.progress import Report

__all__ = ["cell_inputs", "load_experiment", "prepare", "run_cell", "runs_alone", "search_cell"]

_VERSION = 1
_NEEDED = ("capture", "scene", "policy", "object")
# What searches may spend; the rest of the attack's settings concerns all cells.
_SPENT = ("iterations", "learning_rate", "random_evaluations", "random_sigma")
# Methods that are known to read only some of it; any other may read all.
_SPENT_BY = {
    NONE: (),
    "random": ("random_evaluations", "random_sigma"),
    "cem": ("random_evaluations",),
    "gradient": ("iterations", "learning_rate"),
}


class CellFault(RuntimeFault):
    """The live drive that cells are compared with is not there."""


@dataclass(frozen=True)
class _Cell:
    """One cell with its own seed in the experiment's settings, and where its parts are or will be."""

    experiment: Experiment
    victim: str
    reference: str
    seed: int
    folder: Path
    taken: bool
    same_graph: bool

    @property
    def search(self) -> attack.Search:
        return attack.Search(self.victim, self.method, self.seed, self.reference)

    @property
    def method(self) -> str:
        return method_name(self.reference)

    def live(self, condition: str) -> deploy.LiveRun:
        return deploy.LiveRun(self.victim, condition, self.seed)

    def searched_in(self, method: str) -> Path:
        """Folder of the drives in the learned room: the run folder's, if it has them."""
        taken = self.experiment.stage_folder("attack")
        if self.taken and (taken / f"{self.victim}_{method}_{self.seed}.json").exists():
            return taken
        return self.folder

    def driven_in(self, condition: str) -> Path:
        """Folder of a live drive; the drive without attack belongs to all methods."""
        taken = self.experiment.stage_folder("deploy")
        if self.searched_in(condition) != self.folder and self._is_driven_in(taken, condition):
            return taken
        if condition != NONE:
            return self.folder / "live"  # a search and a live drive of one cell leave files of one name
        inputs = hash_of(cell_inputs(self.experiment, "", self.victim, NONE, self.seed))
        return (
            self.folder.parent
            / "shared"
            / f"{self.experiment.config.name}_{self.live('none').name}_{inputs[:12]}"
        )

    def _is_driven_in(self, folder: Path, condition: str) -> bool:
        """Whether the run folder has this very drive: through this graph, past this attack, ended by no fault."""
        if not self.same_graph:
            return False
        try:
            driven = json.loads((folder / f"{self.live(condition).name}.json").read_text())
        except FileNotFoundError:
            return False
        shown = []
        if condition != NONE:
            shown = [load_attack(attack.attack_path(self.searched_in(condition), self.search)).attack_id]
        return driven["attack_ids"] == shown and counts(
            driven["outcome"]["stopped_early"], driven["off_track"]
        )


def runs_alone(experiment: Experiment) -> bool:
    """A live graph measures time, so its cell needs the machine for itself."""
    del experiment
    return True


def prepare(experiment: Experiment, report: Report) -> None:
    """Make room, scene, policies and object; a finished run folder of other settings is refused, never overwritten."""
    if all(is_finished(experiment.stage_folder(stage)) for stage in _NEEDED):
        if changed := changed_settings(experiment):
            raise ConfigError(
                f"{experiment.folder} was made with another {', '.join(changed)} than {experiment.file.name} ({experiment.setting}) says; "
                "name another run_folder in the campaign, or the changes under set"
            )
        return
    report(0.0, f"making what its cells need: {', '.join(_NEEDED)}")
    run_experiment(experiment, until=_NEEDED[-1])


def cell_inputs(experiment: Experiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What the result of a cell depends on: settings, and what scene and policies were made to be.

    Like the code, the node graph is not part of it: a new watching node must not throw hours of searches away.
    """
    del scenario, seed
    _require_victim(experiment, victim)
    config = experiment.config
    # How much memory may be used changes no result.
    searched = config.attack.model_dump(mode="json") | {"cache_mib": AttackConfig().cache_mib}
    other = set(_SPENT) - set(_SPENT_BY.get(method, _SPENT))
    records = {stage: read_record(experiment.stage_folder(stage)) for stage in _NEEDED}
    return {
        "version": _VERSION,
        "horizon": config.horizon,
        "lab": experiment.lab_config.model_dump(mode="json"),
        "object": config.object.model_dump(mode="json"),
        "attack": {key: value for key, value in searched.items() if key not in {*other, "seeds"}},
        "launch_file": config.deploy.launch_file,
        "nodes": list(config.deploy.nodes),
        "stages": {stage: record.digest if record else None for stage, record in records.items()},
    }


def search_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> None:
    """The part of a cell that needs no live graph: drives without attack in the learned room, and the search."""
    cell = _cell(experiment, scenario, victim, method, seed, folder)
    method = cell.method
    wanted = [
        each
        for each in (NONE, method)
        if not (cell.searched_in(each) / f"{victim}_{each}_{seed}.json").exists()
    ]
    if not wanted:
        return
    background = load_background(cell.experiment)
    if NONE in wanted:
        bare = surrogate_of(cell.experiment, [], background)
        attack.drive_without_attack(cell.experiment, bare, victim, seed, folder)
    if method in wanted and method != NONE:
        surrogate = surrogate_of(cell.experiment, [attacked_object(cell.experiment)], background)
        attack.run_search(
            cell.experiment, attack.sensor_of(cell.experiment, surrogate), cell.search, folder, report
        )


def searched_part(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """The cell as far as the learned room goes: it is not deployed."""
    search_cell(experiment, scenario, victim, method, seed, folder, report)
    return _surrogate(_cell(experiment, scenario, victim, method, seed, folder))


def run_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """The whole cell; see `advnerf_core.report.cells`. Goes on where it was stopped.

    Raises:
        DriveFault: The stack stopped the live drive again and again by a fault of its own.
    """
    found = searched_part(experiment, scenario, victim, method, seed, folder, report)
    cell = _cell(experiment, scenario, victim, method, seed, folder)
    report(0.9, "driving live")
    tell = partial(report, 0.9)
    none = _drive(cell, NONE, tell)
    driven = none if method == NONE else _drive(cell, cell.method, tell)
    deployed = {
        "total_cte_m": [driven["total_cte_m"]],
        "off_track": [driven["off_track"]],
        "none_total_cte_m": [none["total_cte_m"]],
    }
    where = cell.driven_in(cell.method)
    extra: dict[str, Any] = {
        "clip": _clip(cell, driven, where),
        "stopped_early": driven["outcome"]["stopped_early"],
        "missed_frames": driven["missed"],
        "mean_abs_cte_m": driven["mean_abs_cte_m"],
        "time_to_leave_s": driven["time_to_leave_s"],
        "horizon": experiment.config.horizon,
        "max_abs_cte_m": driven["max_abs_cte_m"],
        "off_track_m": experiment.room.off_track_m,
        "blocked_tick": [blocked_tick(driven)],
    }
    result = {**found, "deployed": deployed, "extra": extra}
    if where == experiment.stage_folder("deploy"):
        driven_at = (where / f"{cell.live(cell.method).name}.json").stat().st_mtime
        result["date"] = datetime.fromtimestamp(driven_at, timezone.utc).isoformat(timespec="seconds")
        extra["taken_from"] = experiment.folder.name
    return result


def blocked_tick(driven: dict[str, Any]) -> int | None:
    """The tick from which the car stood because it had run into something; None if it had not."""
    stopped = driven["outcome"]["stopped_early"]
    return first_still_tick(driven["states"]) if not stopped or STALLED in stopped else None


def _cell(experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path) -> _Cell:
    del scenario
    _require_victim(experiment, victim)
    config = experiment.config.model_copy(
        update={"attack": experiment.config.attack.model_copy(update={"seeds": (seed,)})}
    )
    own = replace(experiment, config=config)
    taken = has_same_attacks(own)
    return _Cell(own, victim, method, seed, folder, taken, taken and has_same_graph(own))


def _require_victim(experiment: Experiment, victim: str) -> None:
    if victim not in attack.victims(experiment):
        raise ConfigError(
            f"expected one of the victims {', '.join(attack.victims(experiment))} of {experiment.file.name}, got {victim}; "
            "set policy.naive_steps, or leave it out of the campaign"
        )


def _surrogate(cell: _Cell) -> dict[str, Any]:
    name = f"{cell.victim}_{cell.method}_{cell.seed}.json"
    drives = json.loads((cell.searched_in(cell.method) / name).read_text())
    none_file = cell.searched_in(NONE) / f"{cell.victim}_none_{cell.seed}.json"
    none = json.loads(none_file.read_text())
    found = {
        "attack_id": drives.get("attack_id"),
        "surrogate": {
            "total_cte_m": drives["total_cte_m"],
            "off_track": _off_track(cell.experiment, drives["states"]),
            "none_total_cte_m": none["total_cte_m"],
        },
    }
    return found | (
        {"seconds": drives["seconds"]}
        if cell.searched_in(cell.method) != cell.folder and "seconds" in drives
        else {}
    )


def _off_track(experiment: Experiment, drives: Sequence[Any]) -> list[bool]:
    horizon = Horizon(experiment.config.horizon, CONTROL_PERIOD_S, experiment.room.off_track_m)
    fence_m = float(np.abs(np.array(experiment.room.fence_m)).min())
    found = []
    for drive in drives:
        states = np.array(drive)[:, :3]
        outside = np.flatnonzero((np.abs(states[:, :2]) > fence_m).any(axis=1))
        stopped_s = float(outside[0]) * CONTROL_PERIOD_S if outside.size else None
        found.append(bool(evaluation.score(states, experiment.path, horizon, stopped_s)[0].off_track))
    return found


def _drive(cell: _Cell, condition: str, tell: Callable[[str], None]) -> dict[str, Any]:
    """A live drive; driven if it is not there."""
    folder, live = cell.driven_in(condition), cell.live(condition)
    file = folder / f"{live.name}.json"
    if not file.exists():
        shown = None if condition == NONE else attack.attack_path(cell.searched_in(condition), cell.search)
        deploy.drive_until_it_counts(cell.experiment, live, folder, shown, tell)
    driven: dict[str, Any] = json.loads(file.read_text())
    return driven


def _clip(cell: _Cell, driven: dict[str, Any], where: Path) -> str | None:
    """What the driving camera saw, as a clip beside the cell; None where the bag is gone."""
    bag = where / cell.live(cell.method).name / "bag"
    if not bag.exists():
        return None
    frames = evaluation.frames(
        bag, driven["outcome"]["start_real_ns"], len(driven["cte_m"]), CONTROL_PERIOD_S
    )
    title = f"{style_of(cell.method).title}, {cell.victim}, seed {cell.seed}"
    shown = "".join(driven["attack_ids"])
    track = ClipTrack(
        title,
        cell.method,
        list(frames),
        np.array(driven["cte_m"]),
        shown,
        driven["outcome"]["stopped_early"] or "ended",
    )
    path = write_clip(
        cell.folder / "clip.mp4", [track], 1.0 / CONTROL_PERIOD_S, cell.experiment.room.off_track_m
    )
    return f"{cell.folder.name}/{path.name}"


def is_searched(experiment: Experiment, victim: str, method: str, seed: int, folder: Path) -> bool:
    """Whether the search of a cell is finished, here or in the experiment's run folder."""
    cell = _cell(experiment, "", victim, method, seed, folder)
    return (cell.searched_in(cell.method) / f"{cell.search.name}.json").exists()


def attack_file(experiment: Experiment, victim: str, method: str, seed: int, folder: Path) -> AttackFile:
    """The attack file of a cell whose search is finished."""
    cell = _cell(experiment, "", victim, method, seed, folder)
    return load_attack(attack.attack_path(cell.searched_in(cell.method), cell.search))


def drive_without_attack_of(experiment: Experiment, victim: str, seed: int, folder: Path) -> Path:
    """The bag of the live drive that cells of this victim and seed are compared with.

    Raises:
        CellFault: It is not driven yet, or its bag is gone.
    """
    cell = _cell(experiment, "", victim, NONE, seed, folder)
    bag = cell.driven_in(NONE) / cell.live(NONE).name / "bag"
    if not bag.exists():
        raise CellFault(
            f"expected the live drive without attack of the {victim} victim, seed {seed}, at {bag}, got none; run that cell first"
        )
    return bag
