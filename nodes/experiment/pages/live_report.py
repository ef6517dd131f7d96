"""What live drives add to the report: maps, films, textures, timing, memory."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.report import data as rd
from advnerf_core.report.cells import read_cell
from nodes.experiment.engine.artefact import read_artefact
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import FIDELITY
from nodes.experiment.show.spaces import make_space
from nodes.experiment.steps import films, memory
from nodes.experiment.steps.attack import cells
from nodes.experiment.steps.deploy import DRIVES
from nodes.experiment.steps.frozen import frozen_hashes
from nodes.experiment.steps.keys import driven_folder
from nodes.experiment.steps.live import extra_runs, lab_of
from nodes.experiment.steps.search_files import ATTACK, SEARCHED
from nodes.experiment.steps.steering_gate import steering_of_victims
from nodes.lab.trials import evaluation
from nodes.runtime.machine import memory_gib, processor_name
from nodes.runtime.progress import Report

SHOWN_VIEWS = 6
_PATH_POINTS = 400


def measure(experiment: Experiment, folder: Path, report: Report) -> rd.ReportData:
    """Measure memory, cut films, and read everything that the page is made of."""
    rows = memory.measure(experiment, folder, lambda part, text="": report(0.6 * part, text))
    report(0.6, "cutting clips")
    return _report_data(experiment, _clips(experiment, folder), rows)


def _report_data(
    experiment: Experiment, clips: tuple[rd.Clip, ...], memory_rows: tuple[rd.MemoryRow, ...]
) -> rd.ReportData:
    extras = experiment.stage_folder("live")
    driven = {
        name: read_json(file)
        for name, run in extra_runs(experiment).items()
        if (file := extras / f"{run.name}.json").exists()
    }
    live = {cell: _live_results(experiment, cell) for cell in cells(experiment)}
    measured = [*driven.values(), *(each for found in live.values() for each in found)]
    laps = driven.get("laps")
    return rd.ReportData(
        settings=_settings(experiment),
        scene=_scene(experiment),
        runs=(*_surrogate_runs(experiment), *_deployed_runs(experiment, live, driven)),
        manifest=_manifest(experiment),
        curves=tuple(_curves(experiment)),
        textures=tuple(_textures(experiment)),
        clips=clips,
        fidelity=_fidelity(experiment),
        latency=_latency(experiment, measured),
        memory=memory_rows,
        timings=tuple(_timings(experiment)),
        laps=None
        if laps is None
        else rd.Laps(
            experiment.config.deploy.laps,
            np.array(laps["states"]),
            np.array(laps["cte_m"]),
            laps["metrics"]["mean_cte_m"],
            laps["metrics"]["off_track"],
        ),
        not_measured=_not_measured(experiment, driven, measured),
    )


def _not_measured(
    experiment: Experiment, driven: dict[str, dict[str, Any]], measured: list[dict[str, Any]]
) -> dict[str, str]:
    """Why parts of the report are missing."""
    found = {}
    if "laps" not in driven:
        wanted = experiment.config.deploy.laps
        found["laps"] = (
            f"all tries were spoiled; remove {experiment.stage_folder('live')} to drive the laps again"
            if wanted
            else "this setting drives no laps; make experiment does"
        )
    if not measured:
        found["latency"] = "no live drive counts"
    return found


def _settings(experiment: Experiment) -> rd.Settings:
    attack, scenario = experiment.config.attack, experiment.config.scenarios[0]
    space = experiment.config.space.model_dump()
    return rd.Settings(
        name="full" if experiment.setting == "full" else "small",
        horizon_steps=experiment.config.horizon,
        control_period_s=experiment.config.dt_s,
        iterations=attack.evaluations,
        random_evaluations=attack.evaluations,
        start_poses=experiment.measured_starts(scenario).numpy(),
        seeds=attack.seeds,
        speed_mps=experiment.car.speed_mps,
        learning_rate=attack.learning_rate,
        off_track_m=experiment.limits.off_track_m,
        extra={
            "optimised ticks (T)": experiment.searched_ticks,
            "face cells": space["resolution"],
            "time batch": attack.time_batch,
        },
    )


def _scene(experiment: Experiment) -> rd.Scene:
    lab, path = lab_of(experiment), experiment.paths[experiment.config.scenarios[0]]
    half, fence_m = lab.room.side_m / 2, experiment.world.fence_m
    fence = None if fence_m is None else fence_m * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return rd.Scene(
        path_xy_m=path.pose_at(np.linspace(0.0, path.length_m, _PATH_POINTS))[:, :2],
        off_track_m=experiment.limits.off_track_m,
        room_m=(-half, -half, half, half),
        fence_m=fence,
        board_m=rd.face_segment(lab.board.T_world_from_face, lab.board.width_m),
        monitor_m=rd.face_segment(lab.monitor.T_world_from_face, lab.monitor.width_m),
        tape_width_m=lab.track.tape_width_m,
    )


def _surrogate_runs(experiment: Experiment) -> Iterator[rd.Run]:
    for cell in cells(experiment):
        found = _searched(experiment, cell)
        for start, states in enumerate(found["states"]):
            path, xy = experiment.paths[cell.scenario], np.array(states)[:, :2]
            yield rd.Run(
                "surrogate",
                cell.method,
                cell.victim,
                cell.seed,
                start,
                np.array(states)[:, :3],
                path.project(xy).cte_m,
                found["total_cte_m"][start],
            )


def _searched(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    found: dict[str, Any] = read_json(driven_folder(experiment, cell) / SEARCHED)
    return found


def _live_results(experiment: Experiment, cell: Cell) -> list[dict[str, Any]]:
    file = driven_folder(experiment, cell) / DRIVES
    if read_cell(experiment.cell_result(cell)).not_driven_live:
        return []  # of an arm that was driven, when the one that it is compared with was not
    found: list[dict[str, Any]] = read_json(file)["live"]
    return found


def _deployed_runs(
    experiment: Experiment, live: dict[Cell, list[dict[str, Any]]], extras: dict[str, dict[str, Any]]
) -> Iterator[rd.Run]:
    rows = [
        (cell.method, cell.seed, start, each)
        for cell, found in live.items()
        for start, each in enumerate(found)
    ]
    rows += [
        ("empty", experiment.config.attack.seeds[0], 0, each)
        for name, each in extras.items()
        if name == "empty"
    ]
    for condition, seed, start, result in rows:
        outcome = result["outcome"]
        stopped_s = (outcome["end_real_ns"] - outcome["start_real_ns"]) * 1e-9
        yield rd.Run(
            "deployed",
            condition,
            result["victim"],
            seed,
            start,
            np.array(result["states"]),
            np.array(result["cte_m"]),
            result["metrics"]["total_cte_m"],
            note=f"stopped at {stopped_s:.1f} s: {outcome['stopped_early']}"
            if outcome["stopped_early"]
            else "",
        )


def _curves(experiment: Experiment) -> Iterator[rd.LossCurve]:
    for cell in _attacked(experiment):
        curve = np.array(_searched(experiment, cell)["curve_total_cte_m"])
        yield rd.LossCurve(cell.method, cell.seed, curve, cell.victim)


def _textures(experiment: Experiment) -> Iterator[rd.Texture]:
    for cell in _attacked(experiment):
        attack = load_attack(experiment.cell_folder(cell) / ATTACK)
        whose = "" if cell.victim == experiment.config.main_victim else f", {cell.victim} victim"
        yield rd.Texture(
            f"{cell.method}, seed {cell.seed}{whose}",
            cell.method,
            attack.required_face().texture,
            attack.attack_id,
            cell.seed,
            cell.victim,
        )


def _attacked(experiment: Experiment) -> list[Cell]:
    return [cell for cell in cells(experiment) if cell.searched]


def _fidelity(experiment: Experiment) -> rd.Fidelity:
    scene = read_json(experiment.stage_folder("scene") / FIDELITY)
    steering = steering_of_victims(experiment)[experiment.config.main_victim]
    shown = {int(i) for i in np.linspace(0, len(scene["views"]) - 1, SHOWN_VIEWS).round()}
    views = []
    for index, (view, angles) in enumerate(zip(scene["views"], steering, strict=True)):
        images = {
            name: _read_rgb(experiment.folder / view[f"{name}_image"]) if index in shown else None
            for name in ("real", "surrogate")
        }
        views.append(
            rd.FidelityView(
                view["label"],
                view["psnr_full_db"],
                view["psnr_policy_db"],
                view["ssim_full"],
                view["ssim_policy"],
                angles["real"],
                angles["surrogate"],
                **images,
            )
        )
    return rd.Fidelity(tuple(views))


def _latency(experiment: Experiment, results: list[dict[str, Any]]) -> rd.Latency | None:
    if not results:
        return None
    samples = np.concatenate([r["capture_to_serial_ms"] for r in results])
    hops = tuple(
        rd.Hop.from_samples(f"capture to {name}", np.concatenate([r["hops_ms"][name] for r in results]))
        for name in evaluation.HOPS
    )
    period_ms = 1e3 * experiment.config.dt_s
    return rd.Latency(samples, period_ms, sum(r["missed"] for r in results), hops)


def _timings(experiment: Experiment) -> Iterator[rd.StageTiming]:
    for name in ("capture", "scene", "bake", "policy", "object", "live"):
        record = read_artefact(experiment.stage_folder(name))
        if record is not None:
            yield rd.StageTiming(name, record.seconds)
    results = [experiment.cell_result(cell) for cell in cells(experiment)]
    yield rd.StageTiming("cells", sum(read_json(file)["seconds"] for file in results))


def _manifest(experiment: Experiment) -> rd.Manifest:
    manifest = read_json(experiment.folder / "manifest.json")
    machine = {
        "processor": processor_name(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{memory_gib():.0f} GiB",
        "system": platform.platform(),
    }
    return rd.Manifest(
        manifest["command"],
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
        frozen_hashes(experiment),
        manifest["versions"],
        machine,
    )


def _clips(experiment: Experiment, folder: Path) -> tuple[rd.Clip, ...]:
    """Surrogate attacked, deployed clean and deployed attacked side by side, for the first seed, as far as they were driven."""
    caption = "What the driving camera sees: the attack in the learned scene, the live drive without it, and the live drive with it."
    space = make_space(experiment, None)
    return tuple(
        rd.Clip(
            f"The attack as the car sees it ({name})",
            films.film_scenario(experiment, None, space, name, folder),
            caption,
        )
        for name in experiment.config.scenarios
    )


def _read_rgb(path: Path) -> Any:
    return np.ascontiguousarray(cv2.cvtColor(np.asarray(cv2.imread(str(path))), cv2.COLOR_BGR2RGB))
