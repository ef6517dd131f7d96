"""Stage report: one page, one JSON and one table about everything that the stages before left."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import Horizon
from advnerf_core.geometry import planar_poses
from advnerf_core.report import data as rd
from advnerf_core.report import tables, targets
from advnerf_core.report.clips import ClipTrack, write_clip
from advnerf_core.report.conditions import NONE
from advnerf_core.report.page import write_report
from advnerf_core.report.results import read_results
from nodes.experiment import memory
from nodes.experiment.attack import METHODS, attack_path, searches, sensor_of, start_states
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.deploy import LiveRun, live_runs
from nodes.experiment.images import as_uint8
from nodes.experiment.objects import attacked_object, surrogate_of
from nodes.experiment.policy import HARDENED
from nodes.experiment.stages import read_record
from nodes.lab.trials import evaluation
from nodes.runtime.machine import memory_gib, processor_name
from nodes.runtime.progress import Report

SHOWN_VIEWS = 6
_PATH_POINTS = 400


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``report.html`` and ``results.json``."""
    rows = memory.measure(experiment, folder, lambda part, text="": report(0.6 * part, text))
    report(0.6, "cutting clips")
    clips = _clips(experiment, folder)
    report(0.9, "writing the page")
    write_report(_report_data(experiment, clips, rows), folder)


def print_summary(experiment: Experiment, console: Console) -> None:
    """The transfer table and the targets, and where the page is."""
    folder = experiment.stage_folder("report")
    data = read_results(folder / "results.json")
    console.print(tables.transfer_table(tables.transfer_rows(data)).rich())
    console.print(targets.targets_table(targets.evaluate_targets(data)).rich())
    console.print(f"report: {folder / 'report.html'}", highlight=False, soft_wrap=True)


def _report_data(
    experiment: Experiment, clips: tuple[rd.Clip, ...], memory_rows: tuple[rd.MemoryRow, ...]
) -> rd.ReportData:
    live = {run.name: _live_result(experiment, run) for run in live_runs(experiment)}
    laps = next((live[run.name] for run in live_runs(experiment) if run.condition == "laps"), None)
    return rd.ReportData(
        settings=_settings(experiment),
        scene=_scene(experiment),
        runs=(*_surrogate_runs(experiment), *_deployed_runs(experiment, live)),
        manifest=_manifest(experiment),
        curves=tuple(_curves(experiment)),
        textures=tuple(_textures(experiment)),
        clips=clips,
        fidelity=_fidelity(experiment),
        latency=_latency(live),
        memory=memory_rows,
        timings=tuple(_timings(experiment)),
        laps=None
        if laps is None
        else rd.Laps(
            experiment.config.deploy.laps,
            np.array(laps["states"]),
            np.array(laps["cte_m"]),
            laps["mean_abs_cte_m"],
            laps["off_track"],
        ),
        not_measured={} if laps else {"laps": "this setting drives no laps; make experiment does"},
    )


def _settings(experiment: Experiment) -> rd.Settings:
    attack = experiment.config.attack
    return rd.Settings(
        name="full" if experiment.setting == "full" else "small",
        horizon_steps=experiment.config.horizon,
        control_period_s=CONTROL_PERIOD_S,
        iterations=attack.iterations,
        random_evaluations=attack.random_evaluations,
        start_poses=start_states(experiment, attack.seeds[0]).numpy(),
        seeds=attack.seeds,
        speed_mps=experiment.speed_mps,
        learning_rate=attack.learning_rate,
        off_track_m=experiment.room.off_track_m,
        extra={
            "optimised ticks (T)": attack.horizon,
            "face cells": experiment.config.object.resolution,
            "time batch": attack.time_batch,
        },
    )


def _scene(experiment: Experiment) -> rd.Scene:
    lab, path = experiment.lab_config, experiment.path
    half = lab.room.side_m / 2
    return rd.Scene(
        path_xy_m=path.pose_at(np.linspace(0.0, path.length_m, _PATH_POINTS))[:, :2],
        off_track_m=experiment.room.off_track_m,
        room_m=(-half, -half, half, half),
        fence_m=np.array(experiment.room.fence_m),
        board_m=rd.face_segment(lab.board.T_world_from_face, lab.board.width_m),
        monitor_m=rd.face_segment(lab.monitor.T_world_from_face, lab.monitor.width_m),
        tape_width_m=lab.track.tape_width_m,
    )


def _surrogate_runs(experiment: Experiment) -> Iterator[rd.Run]:
    folder, path = experiment.stage_folder("attack"), experiment.path
    horizon = Horizon(experiment.config.horizon, CONTROL_PERIOD_S, experiment.room.off_track_m)
    fence_m = float(np.abs(np.array(experiment.room.fence_m)).min())
    attacked = [(s.victim, s.method, s.seed) for s in searches(experiment)]
    clean = sorted({(victim, NONE, seed) for victim, _, seed in attacked})
    for victim, condition, seed in [*clean, *attacked]:
        result = json.loads((folder / f"{victim}_{condition}_{seed}.json").read_text())
        for start, states in enumerate(result["states"]):
            outside = np.flatnonzero((np.abs(np.array(states)[:, :2]) > fence_m).any(axis=1))
            stopped_s = float(outside[0]) * CONTROL_PERIOD_S if outside.size else None
            metrics, held = evaluation.score(np.array(states)[:, :3], path, horizon, stopped_s)
            yield rd.Run(
                "surrogate",
                condition,
                victim,  # type: ignore[arg-type]
                seed,
                start,
                held,
                path.project(held[:, :2]).cte_m,
                metrics.total_cte_m,
                metrics.mean_cte_m,
                metrics.off_track,
                metrics.time_to_leaving_s,
                attack_id=result.get("attack_id", ""),
                note="" if stopped_s is None else f"crosses the fence at {stopped_s:.1f} s",
            )


def _live_result(experiment: Experiment, live: LiveRun) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((experiment.stage_folder("deploy") / f"{live.name}.json").read_text())
    return result


def _deployed_runs(experiment: Experiment, live: dict[str, dict[str, Any]]) -> Iterator[rd.Run]:
    for result in live.values():
        if result["condition"] == "laps":
            continue
        outcome = result["outcome"]
        stopped_s = (outcome["end_real_ns"] - outcome["start_real_ns"]) * 1e-9
        yield rd.Run(
            "deployed",
            result["condition"],
            result["victim"],
            result["seed"],
            0,
            np.array(result["states"]),
            np.array(result["cte_m"]),
            result["total_cte_m"],
            result["mean_abs_cte_m"],
            result["off_track"],
            result["time_to_leave_s"],
            attack_id="".join(result["attack_ids"]),
            note=f"stopped at {stopped_s:.1f} s: {outcome['stopped_early']}"
            if outcome["stopped_early"]
            else "",
        )


def _curves(experiment: Experiment) -> Iterator[rd.LossCurve]:
    for search in searches(experiment):
        result = json.loads((experiment.stage_folder("attack") / f"{search.name}.json").read_text())
        yield rd.LossCurve(search.method, search.seed, np.array(result["curve_total_cte_m"]), search.victim)  # type: ignore[arg-type]


def _textures(experiment: Experiment) -> Iterator[rd.Texture]:
    for search in searches(experiment):
        attack = load_attack(attack_path(experiment.stage_folder("attack"), search))
        label = f"{search.method}, seed {search.seed}" + (
            "" if search.victim == HARDENED else f", {search.victim} victim"
        )
        texture = attack.required_face().texture
        yield rd.Texture(label, search.method, texture, attack.attack_id, search.seed, search.victim)  # type: ignore[arg-type]


def _fidelity(experiment: Experiment) -> rd.Fidelity:
    scene = json.loads((experiment.stage_folder("scene") / "fidelity.json").read_text())
    steering = json.loads((experiment.stage_folder("policy") / "policy.json").read_text())[
        "steering_on_held_out_views"
    ]
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
                angles["real_rad"],
                angles["surrogate_rad"],
                **images,
            )
        )
    return rd.Fidelity(tuple(views))


def _latency(live: dict[str, dict[str, Any]]) -> rd.Latency:
    results = list(live.values())
    samples = np.concatenate([r["capture_to_serial_ms"] for r in results])
    hops = tuple(
        rd.Hop.from_samples(f"capture to {name}", np.concatenate([r["hops_ms"][name] for r in results]))
        for name in evaluation.HOPS
    )
    return rd.Latency(samples, 1e3 * CONTROL_PERIOD_S, sum(r["missed"] for r in results), hops)


def _timings(experiment: Experiment) -> Iterator[rd.StageTiming]:
    for name in ("capture", "scene", "policy", "object", "attack", "deploy"):
        record = read_record(experiment.stage_folder(name))
        if record is not None:
            yield rd.StageTiming(name, record.seconds)


def _manifest(experiment: Experiment) -> rd.Manifest:
    manifest = json.loads((experiment.folder / "manifest.json").read_text())
    frozen = json.loads((experiment.stage_folder("attack") / "frozen.json").read_text())
    machine = {
        "processor": processor_name(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{memory_gib():.0f} GiB",
        "system": platform.platform(),
    }
    # The wall time from a clean clone is not known here: benchmarks/newcomer measures it.
    return rd.Manifest(
        manifest["command"],
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
        frozen,
        manifest["versions"],
        machine,
    )


def _clips(experiment: Experiment, folder: Path) -> tuple[rd.Clip, ...]:
    """Surrogate attacked, deployed clean and deployed attacked side by side, for the first seed."""
    seed = experiment.config.attack.seeds[0]
    tracks = [
        _surrogate_track(experiment, seed),
        _deployed_track(experiment, NONE, seed),
        _deployed_track(experiment, "gradient", seed),
    ]
    path = write_clip(folder / "attack.mp4", tracks, 1.0 / CONTROL_PERIOD_S, experiment.room.off_track_m)
    caption = "What the driving camera sees: the attack in the learned scene, the live drive without it, and the live drive with it."
    return (rd.Clip("The attack as the car sees it", path, caption),)


def _surrogate_track(experiment: Experiment, seed: int) -> ClipTrack:
    search = next(
        s for s in searches(experiment) if (s.victim, s.method, s.seed) == (HARDENED, METHODS[1], seed)
    )
    folder = experiment.stage_folder("attack")
    states = np.array(json.loads((folder / f"{search.name}.json").read_text())["states"][0])
    attack = load_attack(attack_path(folder, search))
    surrogate = surrogate_of(experiment, [attacked_object(experiment)])
    surrogate.camera = experiment.camera.pinhole
    sensor = sensor_of(experiment, surrogate)
    poses = planar_poses(states) @ experiment.camera.mount
    images = [
        sensor.render(pose[None], torch.from_numpy(attack.face_object.theta)).images[0] for pose in poses
    ]
    frames = [as_uint8(image) for image in images]
    cte_m = experiment.path.project(states[:, :2]).cte_m
    return ClipTrack("learned scene, attacked", "gradient", frames, cte_m, attack.attack_id)


def _deployed_track(experiment: Experiment, condition: str, seed: int) -> ClipTrack:
    live = LiveRun(HARDENED, condition, seed)
    result = _live_result(experiment, live)
    bag = experiment.stage_folder("deploy") / live.name / "bag"
    frames = evaluation.frames(
        bag, result["outcome"]["start_real_ns"], len(result["cte_m"]), CONTROL_PERIOD_S
    )
    title = "live, no attack" if condition == NONE else "live, attacked"
    note = result["outcome"]["stopped_early"] or "ended"
    return ClipTrack(
        title, condition, list(frames), np.array(result["cte_m"]), "".join(result["attack_ids"]), note
    )


def _read_rgb(path: Path) -> Any:
    return np.ascontiguousarray(cv2.cvtColor(np.asarray(cv2.imread(str(path))), cv2.COLOR_BGR2RGB))
