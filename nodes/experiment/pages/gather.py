"""Collects the data of the report's sections from the run folder: drives, searches, fidelity, and measurements of live drives."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.report import data as rd
from advnerf_core.report.cells import read_cell
from advnerf_core.report.conditions import EMPTY
from advnerf_core.report.reference import DOMAINS, Domain
from nodes.experiment.engine.artefact import read_artefact
from nodes.experiment.engine.run_folder import ATTACK, SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import has_face, panel_of, wanted_face
from nodes.experiment.show.learned_scene import FIDELITY, view_pictures
from nodes.experiment.steps.attack import planned_evaluations
from nodes.experiment.steps.deploy import DRIVES
from nodes.experiment.steps.frozen import frozen_hashes
from nodes.experiment.steps.keys import driven_folder
from nodes.experiment.steps.live import extra_runs, lab_of
from nodes.experiment.steps.steering_gate import steering_of_victims
from nodes.lab.trials import evaluation
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.machine import memory_gib, processor_name

_PATH_POINTS = 400


def gather(
    experiment: Experiment,
    films: Mapping[str, rd.Film | None],
    seen: Mapping[str, Mapping[str, NDArray[np.uint8]]],
    done: str,
    overview: NDArray[np.uint8] | None,
) -> rd.ReportData:
    """All data of the page of an experiment with all earlier stages and cells finished.

    Args:
        films: Films by scenario.
        seen: Camera images of the objects, by scenario and method.
        done: Summary of the searches and drives, in one paragraph.
    """
    live = experiment.config.deploy.live
    return rd.ReportData(
        drives=tuple(
            _drives(experiment, name, films.get(name), seen.get(name, {}))
            for name in experiment.config.cell_paths
        ),
        manifest=_manifest(experiment),
        overview=overview,
        textures=tuple(_textures(experiment)) if has_face(experiment) else (),
        fidelity=None if experiment.given_scene is not None else _fidelity(experiment),
        done=done,
        live=live,
        **(_live_parts(experiment) if live else {}),
    )


def _drives(
    experiment: Experiment, scenario: str, film: rd.Film | None, seen: Mapping[str, NDArray[np.uint8]]
) -> rd.Drives:
    plan = [cell for cell in experiment.cells if cell.scenario == scenario]
    runs = [run for domain in DOMAINS for cell in plan for run in _runs(experiment, cell, domain)]
    if scenario == experiment.config.cell_paths[0] and (empty := _extra(experiment, EMPTY)) is not None:
        runs.append(
            rd.Run(
                "deployed",
                EMPTY,
                empty["victim"],
                experiment.config.seeds[0],
                0,
                np.array(empty["states"])[:, :3],
                np.array(empty["cte_m"]),
                _note(empty),
            )
        )
    curves = [curve for cell in plan if cell.searched for curve in _curves(experiment, cell)]
    scene = _scene(experiment, scenario)
    dt_s, goal = experiment.config.dt_s, _maximised(experiment)
    return rd.Drives(scenario, scene, dt_s, tuple(runs), tuple(curves), film, seen, goal)


def _maximised(experiment: Experiment) -> rd.Maximised | None:
    """The objective that the searches maximised, by their attack files; None for the total CTE."""
    for cell in experiment.cells:
        if cell.searched:
            with _of_finished(experiment, cell):
                found = load_attack(experiment.cell_folder(cell) / ATTACK).extra.get("objective")
            return None if found is None else rd.Maximised(found["name"], found["unit"])
    return None


@contextmanager
def _of_finished(experiment: Experiment, cell: Cell) -> Iterator[None]:
    """Say of a file that a finished cell lost how its cell is run again: its result alone keeps it from that."""
    try:
        yield
    except (AdvnerfError, OSError) as error:
        result = experiment.cell_result(cell)
        raise RuntimeFault(
            f"{error}; cell {cell.name} is finished, but a file of it is gone or damaged: delete {result} and the folder {result.with_suffix('')}, and "
            "run the experiment again"
        ) from error


def _curves(experiment: Experiment, cell: Cell) -> Iterator[rd.LossCurve]:
    """The curve of a search: of the objective's values, for ``cte`` over the drive without an attack, which the attack file holds; none of older files."""
    with _of_finished(experiment, cell):
        attack = load_attack(experiment.cell_folder(cell) / ATTACK)
        found = read_json(driven_folder(experiment, cell) / SEARCHED)
    clean, goal = attack.clean_drive, attack.extra.get("objective")
    if goal is not None:
        if "curve_value" in found:
            values = np.array(found["curve_value"])
            yield rd.LossCurve(cell.method, values, cell.victim, goal.get("clean_value"))
    elif clean is not None:
        totals_m = np.array(found["curve_total_cte_m"])
        excess_m = (totals_m - clean.mean_total_cte_m) / clean.ticks
        yield rd.LossCurve(cell.method, excess_m, cell.victim)


def _runs(experiment: Experiment, cell: Cell, domain: Domain) -> Iterator[rd.Run]:
    file = driven_folder(experiment, cell) / (SEARCHED if domain == "surrogate" else DRIVES)
    if domain == "deployed" and read_cell(experiment.cell_result(cell)).deployed is None:
        return  # also if a live arm was driven but the one to compare with was not
    with _of_finished(experiment, cell):
        found = read_json(file)
    notes = [_note(each) for each in found.get("live", ())] or [""] * len(found["states"])
    for start, (states, note) in enumerate(zip(found["states"], notes, strict=True)):
        poses = np.array(states)[:, :3]
        cte_m = experiment.paths[cell.scenario].project(poses[:, :2]).cte_m
        yield rd.Run(domain, cell.method, cell.victim, cell.seed, start, poses, cte_m, note)


def _note(live: Mapping[str, Any]) -> str:
    outcome = live["outcome"]
    stopped_s = (outcome["end_real_ns"] - outcome["start_real_ns"]) * 1e-9
    return f"stopped at {stopped_s:.1f} s: {outcome['stopped_early']}" if outcome["stopped_early"] else ""


def _extra(experiment: Experiment, name: str) -> dict[str, Any] | None:
    """A live drive besides the cells' drives; None if it was not requested, or every try was spoiled."""
    run = extra_runs(experiment).get(name) if experiment.config.deploy.live else None
    file = experiment.stage_folder("live") / f"{name}.json"
    found: dict[str, Any] | None = read_json(file) if run is not None and file.exists() else None
    return found


def _live_parts(experiment: Experiment) -> dict[str, Any]:
    """Latency and laps of live drives, and reasons for missing ones."""
    driven = {name: extra for name in ("laps", EMPTY) if (extra := _extra(experiment, name)) is not None}
    measured = [
        *driven.values(),
        *(each for cell in experiment.cells for each in _live_results(experiment, cell)),
    ]
    found: dict[str, Any] = {
        "latency": _latency(experiment, measured),
        "not_measured": _not_measured(experiment, driven, measured),
    }
    if "laps" in driven:
        laps = driven["laps"]
        found["laps"] = rd.Laps(
            experiment.config.deploy.laps,
            np.array(laps["states"]),
            np.array(laps["cte_m"]),
            laps["metrics"]["mean_cte_m"],
            laps["metrics"]["off_track"],
        )
    return found


def _not_measured(
    experiment: Experiment, driven: dict[str, dict[str, Any]], measured: list[dict[str, Any]]
) -> dict[str, str]:
    """Reasons for missing parts of the report."""
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


def _settings(experiment: Experiment) -> dict[str, str]:
    config, attack = experiment.config, experiment.config.attack
    starts = {name: experiment.measured_starts(name).tolist() for name in config.cell_paths}
    poses = {
        f"measured starts, {name} (x, y, yaw)": "; ".join(
            f"({x:.2f} m, {y:.2f} m, {np.degrees(yaw):.1f}°)" for x, y, yaw in found
        )
        for name, found in starts.items()
    }
    rates = (
        f", learning rate {attack.learning_rate:g}, time batch {attack.time_batch}"
        if "gradient" in config.method_names
        else ""
    )
    goal = _maximised(experiment)
    return {
        "setting": experiment.setting,
        **({} if goal is None else {"objective": f"{goal.name} [{goal.unit}], which the searches maximised"}),
        "searches": f"{planned_evaluations(experiment)} evaluations each, over {experiment.searched_ticks} control ticks of {config.dt_s:g} s{rates}",
        "drives": f"{config.horizon} control ticks of {config.dt_s:g} s",
        "space": ", ".join(f"{name} {value}" for name, value in config.space.model_dump().items()),
        "carrier": ", ".join(f"{name} {value}" for name, value in config.carrier.model_dump().items()),
        **poses,
        "seeds": ", ".join(str(seed) for seed in config.seeds),
        "speed": f"{experiment.car.speed_mps:g} m/s",
        "off-track": f"|CTE| > {experiment.limits.off_track_m:g} m",
    }


def _scene(experiment: Experiment, scenario: str) -> rd.Scene:
    path, world, fence_m = experiment.paths[scenario], experiment.world, experiment.world.fence_m
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], np.float64)
    edges, faces = [np.asarray(edge) for edge in world.road_edge], {}
    if experiment.config.deploy.live:
        lab = lab_of(experiment)
        edges.append(0.5 * lab.room.side_m * square)
        faces = {
            name: rd.face_segment(face.T_world_from_face, face.width_m)
            for name, face in (("board", lab.board), ("monitor", lab.monitor))
        }
    if has_face(experiment):  # the attacked one first
        panel, name = panel_of(experiment), wanted_face(experiment).panel
        faces = {name: rd.face_segment(panel.T_world_from_face, panel.square_m), **faces}
    return rd.Scene(
        path_xy_m=path.pose_at(np.linspace(0.0, path.length_m, _PATH_POINTS))[:, :2],
        off_track_m=experiment.limits.off_track_m,
        closed=path.closed,
        edges_m=tuple(edges),
        objects_m=tuple(np.asarray(thing.corners_m()) for thing in experiment.objects),
        faces_m=faces,
        fence_m=None if fence_m is None else fence_m * square[:4],
    )


def _live_results(experiment: Experiment, cell: Cell) -> list[dict[str, Any]]:
    file = driven_folder(experiment, cell) / DRIVES
    if read_cell(experiment.cell_result(cell)).not_driven_live:
        return []  # an arm was driven, but the one to compare with was not
    with _of_finished(experiment, cell):
        found: list[dict[str, Any]] = read_json(file)["live"]
    return found


def _textures(experiment: Experiment) -> Iterator[rd.Texture]:
    for cell in filter(lambda each: each.searched, experiment.cells):
        with _of_finished(experiment, cell):
            attack = load_attack(experiment.cell_folder(cell) / ATTACK)
        whose = "" if cell.victim == experiment.config.main_victim else f", {cell.victim} victim"
        yield rd.Texture(
            f"{cell.method}, seed {cell.seed}{whose}",
            cell.method,
            attack.required_face().texture,
            attack.attack_id,
        )


def _fidelity(experiment: Experiment) -> rd.Fidelity:
    scene = read_json(experiment.stage_folder("scene") / FIDELITY)
    steering = steering_of_victims(experiment)[experiment.config.main_victim]
    shown = {int(i) for i in np.linspace(0, len(scene["views"]) - 1, rd.SHOWN_VIEWS).round()}
    views = []
    for index, (view, angles) in enumerate(zip(scene["views"], steering, strict=True)):
        images = view_pictures(experiment, index) if index in shown else {}
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
    return rd.Fidelity(tuple(views), experiment.car.control_unit)


def _latency(experiment: Experiment, results: list[dict[str, Any]]) -> rd.Latency | None:
    if not results:
        return None
    samples = np.concatenate([r["capture_to_serial_ms"] for r in results])
    hops_ms = {
        f"capture to {name}": np.concatenate([r["hops_ms"][name] for r in results])
        for name in evaluation.HOPS
    }
    period_ms = 1e3 * experiment.config.dt_s
    return rd.Latency(samples, period_ms, sum(r["missed"] for r in results), hops_ms)


def _timings(experiment: Experiment) -> dict[str, float]:
    config = experiment.config
    policies = dict.fromkeys(map(config.policy_stage, config.attacked))
    names = ("capture", "scene", "bake", *policies, "object", "retrain", "live")
    records = {name: read_artefact(experiment.stage_folder(name)) for name in names}
    results = [experiment.cell_result(cell) for cell in experiment.cells]
    seconds = {name: record.seconds for name, record in records.items() if record is not None}
    return {**seconds, "cells": sum(read_json(file)["seconds"] for file in results)}


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
        frozen_hashes(experiment),
        manifest["versions"],
        machine,
        _settings(experiment),
        _timings(experiment),
    )
