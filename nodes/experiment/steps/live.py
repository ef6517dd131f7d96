"""Live drives: one run of the node graph against the simulated lab, repeated until it counts, and measured from its bag."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import DriveMetrics, Horizon, first_still_tick
from hardware.mocap.vicon import free_udp_port
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.world import collided_with
from nodes.control.stop_causes import is_stall
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import DeployedDrive
from nodes.experiment.show.faces import on_screen, panel_of, wanted_face
from nodes.experiment.show.given import given_in, victim_sha256, victim_spec
from nodes.lab.trials.evaluation import attack_ids, counterfactual, score, timing, trajectory, why_not_shown
from nodes.lab.trials.trial import TrialOutcome, TrialPlan
from nodes.lab.trials.trial_runner import TrialNodes
from nodes.lab.trials.tries import NotDrivenError, drive_with_tries
from nodes.launching.launch_file import Plan, load_launch
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, RuntimeFault
from nodes.runtime.progress import Report

Pose = tuple[float, float, float]
# Folder of the nodes' sockets, logs and configurations in the run folder.
NODES = "nodes"
# Nodes that may remember images of the drive before.
_REMEMBERING = ("policy", "counterfactual")
# Parts of the launch file that follow from the experiment; see `live_overrides`.
_SET_HERE = (
    *("params.policy", "params.attack", "params.calibration", "params.vicon_port", "policy.sha256"),
    *("twin.lab", "twin.camera_effects", "monitor.plain_rgb", "monitor.face_m"),
)
# What a frame takes to a command at least.
_LEAST_LATENCY_S = 0.02
# The absent panel of the empty scene stands outside the room, out of every camera's sight.
_OUT_OF_SIGHT_M = 60.0


@dataclass(frozen=True)
class LiveRun:
    """One live run.

    Attributes:
        name: Name of its folder and its result.
        scenario: Name of the path.
        attack: Shown attack; None for none.
        ticks: Number of measured control ticks; None uses the experiment's.
        empty: Whether the panel is removed.
        compare: Whether the counterfactual node also steers by the clean frames, to measure the attack's effect.
    """

    name: str
    victim: str
    scenario: str
    start: Pose
    attack: Path | None = None
    ticks: int | None = None
    empty: bool = False
    compare: bool = False


def lab_of(experiment: Experiment) -> LabConfig:
    """The simulated lab of the live nodes.

    Raises:
        ConfigError: The world is not the lab.
    """
    config = experiment.named_world.config
    if not isinstance(config, LabConfig):
        raise ConfigError(
            f"{experiment.file}: expected world.kind lab with deploy.through nodes, as the live nodes simulate no other world, got "
            f"{experiment.named_world.kind}; set deploy.through=world"
        )
    return config


def check_live(experiment: Experiment, place: str) -> None:
    """Check that live nodes can drive an experiment; ``place`` is where its section ``deploy`` is, for errors.

    Raises:
        ConfigError: The world is not the lab, a lost frame would stop its car, or a change does not fit the launch file.
    """
    rate_hz, wanted = lab_of(experiment).camera.rate_hz, experiment.config.deploy
    for change in wanted.changes:
        if (key := change.partition("=")[0].strip()).startswith(_SET_HERE):
            raise ConfigError(
                f"{place}: expected changes of what the experiment itself does not set, got {change}; change the experiment's own setting of {key}"
            )
    if not (wanted.changes or wanted.camera.lost):
        return
    try:
        graph = load_launch(experiment.launch_file, wanted.changes)
    except ConfigError as error:
        raise ConfigError(f"{place}: changes: {error}") from error
    limit_s = _command_age_limit_s(graph)
    if wanted.camera.lost and 2.0 / rate_hz + _LEAST_LATENCY_S >= limit_s:
        raise ConfigError(
            f"{place}: expected deploy.camera with lost 0, as at {rate_hz:g} Hz the first lost frame leaves the car without a command for "
            f"{limit_s:g} s, and the stack stops it, got lost {wanted.camera.lost:g}; set it to 0, or raise world.camera.rate_hz"
        )


def _command_age_limit_s(graph: Plan) -> float:
    """Largest age of a command in a node graph [s]: as its motor node is configured, or that node's default."""
    from nodes.motor import MotorConfig  # loads the drivers of its devices

    default = MotorConfig.model_fields["command_age_limit_s"].default
    motor = graph.resolved["nodes"].get("motor") or {}
    return float((motor.get("config") or {}).get("command_age_limit_s", default))


class LiveNodes:
    """The live nodes of an experiment, which are started for the first drive and kept for the next ones; see `TrialNodes`."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        ready_timeout_s = experiment.config.deploy.ready_timeout_s
        self.graph = TrialNodes(experiment.launch_file, experiment.folder / NODES, ready_timeout_s)
        self._vicon_port = 0

    def __enter__(self) -> LiveNodes:
        return self

    def __exit__(self, *raised: object) -> None:
        self.graph.close()

    def drive(self, live: LiveRun, plan: TrialPlan, more: Sequence[str], folder: Path) -> TrialOutcome:
        """Drive one run, into a folder for ``trial.json`` and the bag, with more overrides of the launch file; see `TrialNodes.drive`."""
        experiment = self._experiment
        if not self.graph.pids:
            self._vicon_port = free_udp_port()
        overrides = [f"params.vicon_port={self._vicon_port}", *live_overrides(experiment, live), *more]
        # Nothing is known of the memory of a user's policy but what it declares.
        again = _REMEMBERING if live.victim in given_in(experiment.config) else ()
        return self.graph.drive(overrides, plan, folder, again)


def drive_until_it_counts(
    experiment: Experiment,
    live: LiveRun,
    folder: Path,
    tell: Callable[[str], None],
    nodes: LiveNodes,
) -> dict[str, Any]:
    """Drive one run until it counts, into its own folder and its JSON in ``folder``; an existing run is read. See `drive_with_tries` for errors."""
    file = folder / f"{live.name}.json"
    return drive_with_tries(lambda: drive_live(experiment, live, folder, nodes), file, tell)


def drive_live(experiment: Experiment, live: LiveRun, folder: Path, nodes: LiveNodes) -> dict[str, Any]:
    """Drive one run through the node graph, which records its bag, and measure it.

    Raises:
        SpoiledError: Load or a fault of the stack spoiled the drive. Nothing was measured.
    """
    needed, more = tuple(experiment.config.deploy.nodes), []
    if live.compare:
        needed, more = (*needed, "counterfactual"), ["params.counterfactual=true"]
    horizon = _horizon(experiment, live)
    plan = TrialPlan(live.start, horizon.ticks * horizon.dt_s + 0.2, needed)
    run_dir = folder / live.name
    outcome = nodes.drive(live, plan, more, run_dir)
    bag, path = run_dir / "bag", experiment.paths[live.scenario]
    states = trajectory(bag, outcome.start_real_ns, horizon)
    stopped_s = (outcome.end_real_ns - outcome.start_real_ns) / NS_PER_S if outcome.stopped_early else None
    metrics, held = score(states, path, horizon, stopped_s)
    # A frame that was captured less than a tick before the end may rightly find the car disarmed.
    last_frame_ns = outcome.end_real_ns - round(horizon.dt_s * NS_PER_S)
    times = timing(bag, outcome.start_real_ns, last_frame_ns)
    drawn = sorted(attack_ids(bag))
    _check_drawn(live, bag, drawn)
    result: dict[str, Any] = {
        "victim": live.victim,
        "attack_ids": drawn,
        "outcome": asdict(outcome),
        "states": held.tolist(),
        "cte_m": path.project(held[:, :2]).cte_m.tolist(),
        "metrics": asdict(metrics),
        "frames": times.frames,
        "missed": times.missed,
        "capture_to_serial_ms": times.capture_to_serial_ms.tolist(),
        "hops_ms": {name: values.tolist() for name, values in times.hops_ms.items()},
    }
    if live.compare and (found := counterfactual(bag, outcome.start_real_ns, last_frame_ns)) is not None:
        result["counterfactual"] = asdict(found)
    return result


def as_drive(experiment: Experiment, driven: dict[str, Any]) -> DeployedDrive:
    """A live run as a deployed drive; the policy's commands are in its bag."""
    metrics = driven["metrics"] | {"ctes_m": tuple(driven["metrics"]["ctes_m"])}
    states, tick = np.array(driven["states"]), blocked_tick(driven)
    hit = None if tick is None else collided_with(experiment.named_world.make(), states[tick])
    return DeployedDrive(states, np.zeros(0), DriveMetrics(**metrics), tick, collided_with=hit)


def blocked_tick(driven: dict[str, Any]) -> int | None:
    """The tick from which the car stood because of a collision; None without one."""
    stopped = driven["outcome"]["stopped_early"]
    return first_still_tick(driven["states"]) if not stopped or is_stall(stopped) else None


def extra_runs(experiment: Experiment) -> dict[str, LiveRun]:
    """Runs of the main victim besides the cells: laps without attack, and a drive without the panel, if they are requested."""
    wanted, scenario = experiment.config.deploy, experiment.config.paths[0]
    start = experiment.references[scenario].drive_start
    runs, main = {}, experiment.config.main_victim
    if wanted.laps:
        way_m = wanted.laps * experiment.paths[scenario].length_m
        ticks = round(way_m / experiment.car.speed_mps / experiment.config.dt_s)
        runs["laps"] = LiveRun("laps", main, scenario, start, ticks=ticks)
    if wanted.empty_scene:
        runs["empty"] = LiveRun("empty", main, scenario, start, empty=True)
    return runs


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Stage live: drive the missing runs of `extra_runs`. A run whose tries are all spoiled leaves no result."""
    runs = extra_runs(experiment)
    with LiveNodes(experiment) as nodes:
        for index, live in enumerate(runs.values()):
            report(index / len(runs), live.name)
            with suppress(NotDrivenError):  # the report shows it
                drive_until_it_counts(experiment, live, folder, partial(report, index / len(runs)), nodes)


def live_overrides(experiment: Experiment, live: LiveRun) -> list[str]:
    """Overrides of the launch file for a run: its calibration and room, its victim, its attack."""
    wanted = experiment.config.deploy
    overrides = [
        *wanted.changes,
        f"params.calibration={wanted.calibration or experiment.calibration_folder}",
        f"params.policy={victim_spec(experiment, live.victim)}",
        f"policy.sha256={victim_sha256(experiment, live.victim)}",
        f"twin.lab={json.dumps(lab_of(experiment).model_dump(mode='json'))}",
    ]
    if not (effects := wanted.camera).ideal:
        overrides.append(f"twin.camera_effects={json.dumps(effects.model_dump(mode='json'))}")
    if on_screen(experiment):
        overrides += [
            f"monitor.plain_rgb={json.dumps(wanted_face(experiment).plain_rgb)}",
            f"monitor.face_m={panel_of(experiment).square_m}",
        ]
    if live.attack is not None:
        overrides.append(f"params.attack={live.attack}")
    if live.empty:
        overrides.append(f"twin.lab.{wanted_face(experiment).panel}.x_m={_OUT_OF_SIGHT_M}")
    return overrides


def _horizon(experiment: Experiment, live: LiveRun) -> Horizon:
    """Control ticks over which a run is measured."""
    limits = experiment.limits
    return limits if live.ticks is None else replace(limits, ticks=live.ticks)


def _check_drawn(live: LiveRun, bag: Path, drawn: list[str]) -> None:
    expected = [load_attack(live.attack).attack_id] if live.attack is not None else []
    if drawn != expected:
        raise RuntimeFault(
            f"expected the attacks {expected} in the frames of run {live.name}, got {drawn}: {why_not_shown(bag)}"
        )
