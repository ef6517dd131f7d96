"""Runs a trial with a launched graph. Supervisor and operator share this process; the nodes run in their own."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from advnerf_core.files import write_json
from nodes.lab.trials.drive_health import read_health, spoiled_by
from nodes.lab.trials.trial import SpoiledError, TrialError, TrialNode, TrialOutcome, TrialPlan
from nodes.launching.launch import Launch
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import LaunchError, NodeFinished
from nodes.runtime.loop import NodeLoop

OPERATOR = "operator"
TICK_S = 0.1


def run_trial(
    launch_file: Path,
    overrides: Sequence[str],
    run_dir: Path,
    plan: TrialPlan,
    ready_timeout_s: float,
    guide: Callable[[str], None] | None = None,
    host: str | None = None,
) -> TrialOutcome:
    """Start the graph, run the trial, and stop the graph.

    Args:
        launch_file: The node graph, which records a bag.
        overrides: ``node.key=value`` and ``params.name=value``.
        run_dir: Folder of the run for ``trial.json``, the bag and the logs.
        plan: The plan of the drive.
        ready_timeout_s: Longest time for the graph to become ready [s].
        guide: Called with instructions for the operator of a real car.
        host: Host of the launch file that this computer is. The other host must be running.

    Raises:
        LaunchError: A node died of an error, or the launch file is wrong.
        TrialError: The trial failed; `SpoiledError` if load or a fault of the stack kept it from measuring anything.
    """
    with Launch(launch_file, overrides, run_dir, host=host) as launch:
        node = TrialNode(plan, lambda: launch.failure, guide)
        try:
            launch.wait_ready(ready_timeout_s)
            _operate(node, launch.run_dir)
        except (LaunchError, TrialError) as error:
            raise (SpoiledError(str(error)) if launch.timed_out else error) from None
    if launch.failure:
        raise SpoiledError(launch.failure) if launch.timed_out else LaunchError(launch.failure)
    outcome = node.outcome
    if not outcome.start_real_ns:
        raise SpoiledError(f"the stack stopped before the car moved: {outcome.stopped_early}")
    health = read_health(
        run_dir / "bag", outcome.start_real_ns, outcome.end_real_ns, outcome.stopped_early, TICK_S
    )
    if spoiled := spoiled_by(health):
        raise SpoiledError(spoiled)
    write_json(run_dir / "trial.json", outcome.to_dict())
    return outcome


def _operate(node: TrialNode, run_dir: Path) -> None:
    clock = SystemClock()
    with Bus(run_dir, clock) as bus:
        loop = NodeLoop(OPERATOR, node, bus, clock)
        try:
            with contextlib.suppress(NodeFinished):
                loop.run()
        finally:
            bus.close(farewell=True)
            loop.close()
