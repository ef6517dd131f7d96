"""A published folder of simulated drives: one set under two conditions, with everything that lies beside a set."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from advnerf_core.driving.metrics import DriveMetrics, drive_metrics
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.page import film_of
from advnerf_core.report.evidence.publishing import write_numbers, write_page
from advnerf_core.report.evidence.registration import (
    FILE,
    WITHDRAWN,
    Contrast,
    PrimaryTest,
    RegisteredCell,
    RegisteredScenario,
    Registration,
)

Floats = NDArray[np.float64]
NAME, CONDITIONS, GIVEN_UP = "simulated", ("track", "own"), "later"
_METHODS, _REACH_M = ("random", "gradient"), {"none": 0.0, "random": 0.1, "gradient": 0.8}
_TICKS, _DT_S, _STEP_M, _LIMIT_M = 60, 0.1, 0.07, 0.4
_SPACE = {"kind": "colours", "cells": 8}


@dataclass(frozen=True)
class Simulated:
    """What a simulated set is made of.

    Attributes:
        registration: Of it.
        path: That is driven.
        rng: Of effects and noise.
    """

    registration: Registration
    path: DrivingPath
    rng: np.random.Generator


def write_simulated_set(folder: Path, searches: int = 6, starts: int = 5, seed: int = 0) -> Path:
    """A registered set of drives about a square that leave it with an effect by method and some noise; returns its ``set.json``."""
    rng, path = np.random.default_rng(seed), DrivingPath.rounded_square(4.0, 1.0)
    registration = _registration(folder.name, searches, starts, path, rng)
    (folder / FILE).parent.mkdir(parents=True)
    (folder / FILE).write_text(registration.model_dump_json(indent=1) + "\n")
    (folder / WITHDRAWN).write_text(json.dumps({GIVEN_UP: "It would have taken two days."}) + "\n")
    _write_cells(folder, Simulated(registration, path, rng))
    _write_beside(folder, registration)
    file = write_numbers(folder)
    write_page(folder.parent)
    return file


def _registration(
    name: str, searches: int, starts: int, path: DrivingPath, rng: np.random.Generator
) -> Registration:
    poses = [path.pose_at(0.2) + 0.1 * rng.standard_normal(3) * [1, 1, 0.25] for _ in range(starts)]
    scenario = RegisteredScenario(
        settings_sha256="0" * 64,
        path=path.to_dict(),
        ticks=_TICKS,
        dt_s=_DT_S,
        off_track_m=_LIMIT_M,
        held_cap_m=1.5,
        starts=tuple((float(x), float(y), float(yaw)) for x, y, yaw in poses),
        deployed_starts=starts,
        evaluations=50,
        space=_SPACE,
        victims={},
        drives_well_mean_cte_m=0.08,
    )
    conditions = (*CONDITIONS, GIVEN_UP)
    searched = [("none", 0), *((method, each) for method in _METHODS for each in range(searches))]
    return Registration(
        name=name,
        file="simulated.experiment.yaml",
        setting="",
        date="2026-01-01T00:00:00+00:00",
        software_version="0",
        scenarios=dict.fromkeys(conditions, scenario),
        cells=tuple(
            RegisteredCell(scenario=where, victim="hardened", method=method, seed=each)
            for where in conditions
            for method, each in searched
        ),
        primary=tuple(
            PrimaryTest(scenario=where, victim="hardened", method="gradient", against=("random",))
            for where in conditions
        ),
        contrasts=(Contrast(name="the world's own car", before=CONDITIONS[0], after=CONDITIONS[1]),),
    ).as_filed()


def _write_cells(folder: Path, made: Simulated) -> None:
    """Cells of both conditions, which share searches and drives in the learned scene."""
    cells = [cell for cell in made.registration.cells if cell.scenario == CONDITIONS[0]]
    effects_m = [_REACH_M[cell.method] * (1.0 + 0.2 * made.rng.standard_normal()) for cell in cells]
    learned = _drives(made, effects_m)
    for where in CONDITIONS:
        deployed = _drives(made, [0.9 * each for each in effects_m])
        for cell, *drives in zip(cells, learned, deployed, strict=True):
            here = cell.model_copy(update={"scenario": where})
            _write_cell(folder, made, here, drives, [learned[0], deployed[0]])


def _drives(made: Simulated, effects_m: list[float]) -> list[list[KeptDrive]]:
    """For each effect one drive from each start: the car steers towards a line that leaves the path by the effect, and some noise."""
    scenario = made.registration.scenarios[CONDITIONS[0]]
    starts = np.array(scenario.starts)
    states = np.tile(starts, (len(effects_m), 1))
    effect_m = np.repeat(effects_m, len(starts))
    poses, commands = [states], []
    for tick in range(_TICKS):
        at = made.path.project(states[:, :2])
        aim_m = effect_m * ((tick + 1) / _TICKS) ** 2 + 0.01 * made.rng.standard_normal(len(states))
        along = made.path.pose_at(at.s_m)[:, 2]
        off_rad = np.angle(np.exp(1j * (states[:, 2] - along)))
        turn = (
            np.clip(1.2 * (aim_m - at.cte_m) - 0.9 * off_rad, -0.25, 0.25)
            + made.path.curvature_at(at.s_m) * _STEP_M
        )
        heading = states[:, 2] + turn / 2.0
        states = states + np.stack([_STEP_M * np.cos(heading), _STEP_M * np.sin(heading), turn], axis=1)
        poses.append(states)
        commands.append(turn / _STEP_M)
    kept = [
        KeptDrive.of(drive, _TICKS, command)
        for drive, command in zip(np.stack(poses, axis=1), np.stack(commands, axis=1), strict=True)
    ]
    return [kept[first : first + len(starts)] for first in range(0, len(kept), len(starts))]


def _write_cell(
    folder: Path,
    made: Simulated,
    cell: RegisteredCell,
    drives: list[list[KeptDrive]],
    clean: list[list[KeptDrive]],
) -> None:
    horizon = made.registration.scenarios[cell.scenario].horizon

    def metrics(part: list[KeptDrive]) -> list[DriveMetrics]:
        return [drive_metrics(made.path, each.poses(), horizon, each.driven_ticks) for each in part]

    domains = ("surrogate", "deployed")
    found = {domain: metrics(part) for domain, part in zip(domains, drives, strict=True)}
    none = {domain: metrics(part) for domain, part in zip(domains, clean, strict=True)}
    totals = {
        domain: {
            "total_cte_m": [each.total_cte_m for each in found[domain]],
            "off_track": [each.off_track for each in found[domain]],
            "none_total_cte_m": [each.total_cte_m for each in none[domain]],
        }
        for domain in domains
    }
    searched = cell.method != "none"
    data = {
        **cell.model_dump(),
        **totals,
        "attack_id": hashlib.sha256(f"{cell.method} {cell.seed}".encode()).hexdigest()[:12]
        if searched
        else None,
        "settings_hash": hashlib.sha256(cell.name.encode()).hexdigest(),
        "registration": made.registration.digest,
        "policy_sha256": "1" * 64,
        "stages": {"scene": "3" * 64, "policy": "2" * 64},
        "seconds": 1.0,
        "machine": "simulated",
        "date": "2026-01-02T00:00:00+00:00",
        "kept": {
            domain: [each.model_dump() for each in part] for domain, part in zip(domains, drives, strict=True)
        },
        "extra": {
            "evaluations": 50 if searched else 0,
            "horizon": _TICKS,
            "space": _SPACE,
            "deployed_through": "world",
            "off_track_m": _LIMIT_M,
            "max_abs_cte_m": max(each.max_cte_m for each in found["deployed"]),
            "blocked_tick": [None] * len(drives[1]),
        },
    }
    (folder / f"{cell.name}.json").write_text(json.dumps(data, indent=1) + "\n")


def _write_beside(folder: Path, registration: Registration) -> None:
    """Predictions, verdicts of the gate, a film, and a reference build of two stages."""
    for cell in registration.cells:
        if cell.method == "gradient" and cell.scenario == CONDITIONS[1]:
            total_m, none_m = 12.0 + cell.seed, 2.0
            said = {
                "settings_hash": hashlib.sha256(cell.name.encode()).hexdigest(),
                "total_cte_m": total_m,
                "none_total_cte_m": none_m,
                "excess_m": (total_m - none_m) / _TICKS,
                "excess_low_m": 0.1,
                "excess_high_m": 0.3,
                "ratio": total_m / none_m,
                "ratio_low": 4.0,
                "ratio_high": 9.0,
            }
            _write(folder / "predictions" / f"{cell.name}.json", said)
    numbers = {
        "views": 24,
        "psnr_db": 30.0,
        "ssim": 0.9,
        "steering": 0.01,
        "steering_worst": 0.05,
        "correlation": 0.99,
    }
    for where in CONDITIONS:
        for kind in ("", ".drive"):
            verdict = {"key": f"4{kind}", "passed": True, "reasons": [], "numbers": numbers}
            _write(folder / "gate" / f"{where}_hardened{kind}.json", verdict)
    Image.effect_noise((32, 32), 40.0).save(folder.parent / film_of(folder.name))
    for stage in ("scene", "policy"):
        _write(folder.parent / "reference" / f"{stage}_0" / "weights.json", {stage: [0.1, 0.2]})


def _write(file: Path, data: object) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(data, indent=1) + "\n")
