"""Stage deploy: drive every attack live through the node graph against the simulated lab, and measure from the bag."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import Horizon
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.conditions import NONE
from nodes.experiment.attack import METHODS, Search, attack_path, frozen_hashes, victims
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.policy import HARDENED, NAIVE, victim_file
from nodes.lab.trials.evaluation import attack_ids, counterfactual, score, timing, trajectory
from nodes.lab.trials.trial import NotStartedError, TrialPlan, counts
from nodes.lab.trials.trial_runner import run_trial
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.progress import Report

# The absent board or monitor of the empty scene stands outside the room, out of every camera's sight.
_OUT_OF_SIGHT_M = 60.0


class FrozenChangedError(RuntimeFault):
    """Something that was fixed before the first attack is no longer what it was."""


class DriveFault(RuntimeFault):
    """A live drive was ended again and again by a fault of the stack, so that it measures nothing."""


_ATTEMPTS = 3
# What every victim meets, in this order.
_CONDITIONS = (NONE, *METHODS)


@dataclass(frozen=True)
class LiveRun:
    """One live run: which victim meets what; conditions have the names of `advnerf_core.report.conditions`."""

    victim: str
    condition: str
    seed: int

    @property
    def name(self) -> str:
        """Name of its folder and result."""
        return f"{self.victim}_{self.condition}_{self.seed}"


def live_runs(experiment: Experiment) -> list[LiveRun]:
    """All runs of the stage, in order: laps, then for each seed none, random, gradient; the naive victim last."""
    seeds, deploy = experiment.config.attack.seeds, experiment.config.deploy
    plan = [LiveRun(HARDENED, "laps", seeds[0])] if deploy.laps else []
    plan += [LiveRun(HARDENED, condition, seed) for seed in seeds for condition in _CONDITIONS]
    if deploy.empty_scene:
        plan.append(LiveRun(HARDENED, "empty", seeds[0]))
    if NAIVE in victims(experiment):
        plan += [LiveRun(NAIVE, condition, seeds[0]) for condition in _CONDITIONS]
    return plan


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Drive what is not driven yet; one folder with a bag and one JSON per run."""
    _check_frozen(experiment)
    plan = live_runs(experiment)
    for index, live in enumerate(plan):
        report(index / len(plan), f"{live.victim} {live.condition} seed {live.seed}")
        if not (folder / f"{live.name}.json").exists():
            attack = _attack_file(experiment, live) if live.condition in METHODS else None
            drive_until_it_counts(experiment, live, folder, attack, partial(report, index / len(plan)))


def drive_until_it_counts(
    experiment: Experiment, live: LiveRun, folder: Path, attack: Path | None, tell: Callable[[str], None]
) -> None:
    """Drive one run, again if a fault of the stack ended it or kept it from beginning: a busy machine is late now and then.

    Args:
        experiment: Of the room.
        live: Which run.
        folder: Where its folder and its JSON go.
        attack: What is shown.
        tell: Told of drives that do not count.

    Raises:
        DriveFault: None of a few attempts counts; no JSON is left.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        shutil.rmtree(folder / live.name, ignore_errors=True)  # of a drive that was broken off
        if not (stopped := _fault_of(experiment, live, folder, attack)):
            return
        tell(
            f"{live.name} does not count, the stack stopped it: {stopped} (attempt {attempt} of {_ATTEMPTS})"
        )
    raise DriveFault(
        f"the stack stopped the live drive {live.name} {_ATTEMPTS} times, at last: {stopped}; cure that (advnerf doctor, another load on this machine), "
        "and give the command again, which goes on here"
    )


def _check_frozen(experiment: Experiment) -> None:
    then = json.loads((experiment.stage_folder("attack") / "frozen.json").read_text())
    changed = [
        name for name, value in frozen_hashes(experiment).items() if name != "config" and then[name] != value
    ]
    if changed:
        raise FrozenChangedError(
            f"expected {', '.join(changed)} as frozen before the first attack, got another; run the attack stage again"
        )


def drive_live(
    experiment: Experiment, live: LiveRun, folder: Path, attack: Path | None, compare: bool = False
) -> None:
    """Drive one run through the node graph, with an attack file or none; leaves its bag and a JSON of what was measured in it.

    Args:
        experiment: Of the room.
        live: Which run.
        folder: Where its folder and its JSON go.
        attack: What the compositor or the monitor shows.
        compare: Let the counterfactual node steer by the clean frames too, and measure what the attack added.
    """
    deploy = experiment.config.deploy
    horizon = live_horizon(experiment, live)
    nodes, overrides = tuple(deploy.nodes), live_overrides(experiment, live, attack)
    if compare:
        nodes, overrides = (*nodes, "counterfactual"), [*overrides, "params.counterfactual=true"]
    plan = TrialPlan(experiment.room.start_pose, horizon.ticks * horizon.dt_s + 0.2, nodes)
    run_dir = folder / live.name
    outcome = run_trial(experiment.launch_file, overrides, run_dir, plan, deploy.ready_timeout_s)
    bag = run_dir / "bag"
    states = trajectory(bag, outcome.start_real_ns, horizon)
    stopped_s = (outcome.end_real_ns - outcome.start_real_ns) / NS_PER_S if outcome.stopped_early else None
    metrics, held = score(states, experiment.path, horizon, stopped_s)
    # A frame that was captured less than a tick before the end may rightly find the car disarmed.
    last_frame_ns = outcome.end_real_ns - round(CONTROL_PERIOD_S * NS_PER_S)
    times = timing(bag, outcome.start_real_ns, last_frame_ns)
    drawn = sorted(attack_ids(bag))
    _check_drawn(live, drawn, attack)
    result: dict[str, Any] = {
        "victim": live.victim,
        "condition": live.condition,
        "seed": live.seed,
        "attack_ids": drawn,
        "outcome": outcome.to_dict(),
        "states": held.tolist(),
        "cte_m": experiment.path.project(held[:, :2]).cte_m.tolist(),
        "total_cte_m": metrics.total_cte_m,
        "mean_abs_cte_m": metrics.mean_cte_m,
        "max_abs_cte_m": metrics.max_cte_m,
        "off_track": metrics.off_track,
        "time_to_leave_s": metrics.time_to_leaving_s,
        "frames": times.frames,
        "missed": times.missed,
        "capture_to_serial_ms": times.capture_to_serial_ms.tolist(),
        "hops_ms": {name: values.tolist() for name, values in times.hops_ms.items()},
    }
    if compare and (found := counterfactual(bag, outcome.start_real_ns, last_frame_ns)) is not None:
        result["counterfactual"] = asdict(found)
    write_atomically(folder / f"{live.name}.json", json.dumps(result) + "\n")


def _fault_of(experiment: Experiment, live: LiveRun, folder: Path, attack: Path | None) -> str:
    """Drive once; empty, or the fault of the stack for which the drive does not count."""
    file = folder / f"{live.name}.json"
    try:
        drive_live(experiment, live, folder, attack)
    except NotStartedError as error:
        return str(error)
    driven = json.loads(file.read_text())
    stopped: str = driven["outcome"]["stopped_early"]
    if counts(stopped, driven["off_track"]):
        return ""
    file.unlink()
    return stopped


def live_horizon(experiment: Experiment, live: LiveRun) -> Horizon:
    """Control ticks over which a run is measured."""
    ticks = experiment.config.horizon
    if live.condition == "laps":
        ticks = round(
            experiment.config.deploy.laps * experiment.path.length_m / experiment.speed_mps / CONTROL_PERIOD_S
        )
    return Horizon(ticks, CONTROL_PERIOD_S, experiment.room.off_track_m)


def live_overrides(experiment: Experiment, live: LiveRun, attack: Path | None) -> list[str]:
    """What the launch file is told for a run: its calibration and room, its victim, its attack."""
    policy = victim_file(experiment, live.victim)
    calibration = experiment.calibration_file("camera").parent
    overrides = [
        f"params.calibration={calibration}",
        f"params.policy={policy}",
        f"params.vicon_port={_free_udp_port()}",
        f"policy.sha256={load_policy(policy).sha256}",
        f"twin.lab={json.dumps(experiment.lab_config.model_dump(mode='json'))}",
    ]
    if experiment.shown_on_monitor:
        overrides += [
            f"monitor.plain_rgb={json.dumps(experiment.config.object.plain_rgb)}",
            f"monitor.face_m={experiment.face_m}",
        ]
    if attack is not None:
        overrides.append(f"params.attack={attack}")
    if live.condition == "empty":
        overrides.append(f"twin.lab.{experiment.config.object.target}.x_m={_OUT_OF_SIGHT_M}")
    return overrides


def _free_udp_port() -> int:
    """A port for this run's motion capture, so that a lab or another run on this host does not answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _attack_file(experiment: Experiment, live: LiveRun) -> Path:
    assert live.condition in METHODS
    return attack_path(experiment.stage_folder("attack"), Search(live.victim, live.condition, live.seed))


def _check_drawn(live: LiveRun, drawn: list[str], attack: Path | None) -> None:
    expected = [load_attack(attack).attack_id] if attack is not None else []
    if drawn != expected:
        raise RuntimeFault(f"expected the attacks {expected} in the frames of run {live.name}, got {drawn}")
