"""Drives a series of trials: the runs of the plan that have no result file yet.

On the twin, the series runs automatically. With a real car, the operator places the car, guided by messages, and arms it. The series
may be interrupted between runs at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.files import sha256_of
from advnerf_core.policies.load import policy_file_sha256
from calibration.schema import RoomCalibration, load_calibration
from nodes.lab.trials.bags import find_drives, measure_drives
from nodes.lab.trials.evaluation import why_not_shown
from nodes.lab.trials.plan import (
    NONE,
    CampaignError,
    PlannedDrive,
    TrialsPlan,
    finished,
    keep_plan,
    make_runs,
)
from nodes.lab.trials.trial import SpoiledError, TrialPlan
from nodes.lab.trials.trial_runner import TICK_S, run_trial
from nodes.lab.trials.tries import NotDrivenError, drive_with_tries
from nodes.launching.launch_file import Plan, load_launch
from nodes.launching.launch_hosts import ALL_HOSTS, operator_of
from nodes.runtime.errors import ConfigError

# Time that the car drives after the last tick, so that there are poses after it.
_TAIL_S = 0.2
_NOT_WATCHED = ("recorder", "viewer")


@dataclass(frozen=True)
class Series:
    """A series of trials that is ready to be driven.

    Attributes:
        folder: Folder for the plan, the results and one folder per run.
        nodes: Nodes that must be ready before anything moves.
    """

    folder: Path
    plan: TrialsPlan
    room: RoomCalibration
    nodes: tuple[str, ...]

    @property
    def results(self) -> dict[str, dict[str, Any]]:
        """Results of the finished runs, by name of the run."""
        return finished(self.folder, self.plan)


def prepare_series(
    launch_file: Path,
    overrides: Sequence[str],
    folder: Path,
    attacks: dict[str, list[Path]],
    repeats: int,
    seed: int,
    ticks: int,
    start_pose: tuple[float, float, float] | None = None,
    host: str | None = None,
) -> Series:
    """Read all files, fix the order, and store the plan in the folder.

    Args:
        launch_file: Node graph with a safety node, whose room is used, and a recorder.
        folder: New folder, or the same series' folder.
        attacks: Attack files of each condition besides ``none``.
        start_pose: Start pose of each drive; None uses the room's.
        host: Host of the launch file that this computer is, or all. It must be the operator's host, with the recorder.

    Raises:
        CampaignError: The folder belongs to another series.
    """
    launched = load_launch(launch_file, overrides, host=host)
    # Nodes of both hosts are needed, because the room is in the configuration of the safety node, which is on the car.
    whole = launched if host is None else load_launch(launch_file, overrides, host=ALL_HOSTS)
    room_file = _room_file(whole)
    _require_trials_here(launched, whole, host)
    room = load_calibration(RoomCalibration, room_file)
    policy = whole.documents["policy"].data.get("policy") if "policy" in whole.documents else None
    policy_file = Path(policy) if policy and Path(policy).is_file() else None
    plan = TrialsPlan(
        str(launch_file),
        tuple(overrides),
        seed,
        ticks,
        start_pose or room.start_pose,
        sha256_of(room_file),
        "" if policy_file is None else policy_file_sha256(policy_file),
        make_runs(attacks, repeats, seed),
        host,
    )
    keep_plan(folder, plan)
    nodes = tuple(name for name, entry in whole.nodes.items() if entry.required and name not in _NOT_WATCHED)
    return Series(folder, plan, room, nodes)


def drive_series(
    series: Series,
    ready_timeout_s: float,
    begin: Callable[[PlannedDrive], None],
    guide: Callable[[str], None],
) -> None:
    """Drive the runs that are not finished.

    Args:
        guide: Called with instructions for the operator.
    """
    done = series.results
    for run in series.plan.runs:
        if run.name not in done:
            begin(run)
            drive_run(series, run, ready_timeout_s, guide)


def drive_run(
    series: Series, run: PlannedDrive, ready_timeout_s: float, guide: Callable[[str], None]
) -> dict[str, Any]:
    """Drive one run and write its result. A run that load or a fault of the stack spoiled is driven again, at most three times."""
    file = series.folder / f"{run.name}.json"
    try:
        return drive_with_tries(lambda: _drive_once(series, run, ready_timeout_s, guide), file, guide)
    except NotDrivenError as error:
        raise CampaignError(
            f"{error}; fix this first, then remove {file.with_suffix('.tries.json')} to drive it again"
        ) from None


def _drive_once(
    series: Series, run: PlannedDrive, ready_timeout_s: float, guide: Callable[[str], None]
) -> dict[str, Any]:
    plan, run_dir = series.plan, series.folder / run.name
    trial = TrialPlan(plan.start_pose, plan.ticks * TICK_S + _TAIL_S, series.nodes, by_hand=True)
    overrides = [*plan.overrides, f"params.attack={run.attack}"]
    outcome = run_trial(Path(plan.launch), overrides, run_dir, trial, ready_timeout_s, guide, plan.host)
    # Evaluated from the bag alone, so that `advnerf bag evaluate` gives exactly the same numbers.
    found = measure_drives(run_dir / "bag", series.room, plan.ticks)[-1]
    if not found["counts"]:
        raise SpoiledError(found["stopped_early"])
    require_shown(run, found, run_dir / "bag")
    return {"condition": run.condition, "repeat": run.repeat, "peer": outcome.peer, **found}


def require_shown(run: PlannedDrive, found: dict[str, Any], bag: Path) -> None:
    """Raise unless exactly the attack of a run was shown in the last drive of its bag; the error quotes the labels.

    Args:
        found: That drive, as `measure_drives` evaluates it.

    Raises:
        CampaignError: No attack or another one was shown.
    """
    wanted = [run.attack_id] if run.attack_id else []
    if found["attack_ids"] != wanted:
        span = find_drives(bag)[-1]
        why = why_not_shown(bag, span.start_real_ns, span.end_real_ns)
        raise CampaignError(
            f"expected the attacks {wanted} to be shown in run {run.name}, got {found['attack_ids']}: {why}; check compositor or monitor"
        )


def summarise(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise the results in one row per condition: runs, mean and standard deviation of the total CTE [m], ratio to no attack,
    number of runs off the track, spoiled tries before these runs, number of runs without checksums.

    The standard deviation is a sample's (n - 1), and None for a single run. The ratio compares the means.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault(result["condition"], []).append(result)
    base = np.mean([each["total_cte_m"] for each in groups[NONE]]) if NONE in groups else None
    rows = []
    for condition in sorted(groups, key=lambda name: (name != NONE, name != "random", name)):
        totals = [each["total_cte_m"] for each in groups[condition]]
        latencies = [ms for each in groups[condition] for ms in each.get("capture_to_serial_ms", [])]
        rows.append(
            {
                "condition": condition,
                "runs": len(totals),
                "mean_m": float(np.mean(totals)),
                "std_m": float(np.std(totals, ddof=1)) if len(totals) > 1 else None,
                "ratio": float(np.mean(totals) / base) if base else None,
                "off_track": sum(bool(each["off_track"]) for each in groups[condition]),
                "stopped_early": sum(bool(each["stopped_early"]) for each in groups[condition]),
                "latency_p50_ms": float(np.median(latencies)) if latencies else None,
                "spoiled_tries": sum(len(each.get("spoiled", [])) for each in groups[condition]),
                "unchecked": sum(bool(each.get("unchecked")) for each in groups[condition]),
            }
        )
    return rows


def _require_trials_here(launched: Plan, whole: Plan, host: str | None) -> None:
    """Check that this host is the operator's host, which can arm, and that the bag is recorded here."""
    hosts = launched.launch.hosts
    if host not in (None, ALL_HOSTS) and (operator := operator_of(launched.launch)) != host:
        raise ConfigError(
            f"{launched.file}: expected trials to run on the operator's host, {operator}; got --host {host}. Run them there, or set operator={host}"
        )
    if "recorder" in launched.documents:
        return
    if "recorder" in whole.documents:
        home = whole.nodes["recorder"].host
        raise ConfigError(
            f"{launched.file}: expected the bags of trials on {host}, but {home} records (of {', '.join(hosts)}); set record.host={host}"
        )
    raise ConfigError(
        f"{launched.file}: expected the key record, because trials are evaluated from their bags; add it to the launch file"
    )


def _room_file(launched: Plan) -> Path:
    room = launched.documents["safety"].data.get("room") if "safety" in launched.documents else None
    if not room:
        raise ConfigError(
            f"{launched.file}: expected a node safety with a room, whose path the drives are compared with; add it"
        )
    if "attack" not in launched.launch.params:
        raise ConfigError(
            f"{launched.file}: expected a parameter called attack, for the conditions of the trials; add it to params"
        )
    return Path(room)
