"""Runs a trial against a launched graph: supervisor and operator in one process, the nodes in theirs."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from advnerf_core.files import write_atomically
from nodes.lab.trials.trial import NotStartedError, TrialNode, TrialOutcome, TrialPlan
from nodes.launching.launch import Launch
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import LaunchError, NodeFinished
from nodes.runtime.loop import NodeLoop

OPERATOR = "operator"


def run_trial(
    launch_file: Path,
    overrides: Sequence[str],
    run_dir: Path,
    plan: TrialPlan,
    ready_timeout_s: float,
    guide: Callable[[str], None] | None = None,
    host: str | None = None,
) -> TrialOutcome:
    """Start the graph, carry out the plan, stop the graph.

    Args:
        launch_file: The node graph; it records a bag.
        overrides: ``node.key=value`` and ``params.name=value``.
        run_dir: Folder of the run; gets ``trial.json``, the bag and the logs.
        plan: What is driven.
        ready_timeout_s: How long the graph may take to become ready [s].
        guide: Told what a person has to do, where the car is a real one.
        host: Which of the launch file's hosts this computer is; its other host must be running.

    Raises:
        LaunchError: A node died or never became ready.
        TrialError: The trial could not be carried out; `NotStartedError` if the stack stopped it before the car had moved.
    """
    with Launch(launch_file, overrides, run_dir, host=host) as launch:
        launch.wait_ready(ready_timeout_s)
        node = TrialNode(plan, lambda: launch.failure, guide)
        _operate(node, launch.run_dir)
    if launch.failure:
        raise LaunchError(launch.failure)
    if not node.outcome.start_real_ns:
        raise NotStartedError(
            f"expected a drive in {run_dir}, but the stack stopped before the car had moved: {node.outcome.stopped_early}; cure that, "
            "and start again: what is finished is kept"
        )
    write_atomically(run_dir / "trial.json", json.dumps(node.outcome.to_dict(), indent=1) + "\n")
    return node.outcome


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
