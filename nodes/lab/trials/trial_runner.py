"""Runs trials with launched graphs. Supervisor and operator share this process; the nodes run in their own."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from pathlib import Path

from advnerf_core.files import write_json
from nodes.lab.trials.drive_health import read_health, spoiled_by
from nodes.lab.trials.trial import SpoiledError, TrialError, TrialNode, TrialOutcome, TrialPlan
from nodes.launching.launch import Launch
from nodes.launching.launch_file import RECORDER, Plan, load_launch
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.config import node_document
from nodes.runtime.errors import LaunchError, NodeFinished
from nodes.runtime.loop import NodeLoop

OPERATOR = "operator"
TICK_S = 0.1
# Lock of live graphs, which measure time: over all experiments on this machine only one drives at a time.
LIVE_LOCK = Path(tempfile.gettempdir()) / "advnerf-live.lock"
# Nodes that may be started again while the others keep running. The others hold a device, or decide about stopping.
_EXCHANGEABLE = frozenset({RECORDER, "compositor", "monitor", "policy", "counterfactual"})


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
        run_dir: Folder of the run for ``trial.json``, the bag and the logs.
        guide: Called with instructions for the operator of a real car.
        host: Host of the launch file that this computer is. The other host must be running.

    Raises:
        LaunchError: A node died of an error, or the launch file is wrong.
        TrialError: The trial failed; `SpoiledError` if load or a fault of the stack kept it from measuring anything.
    """
    with Launch(launch_file, overrides, run_dir, host=host) as launch:
        outcome = _driven(launch, plan, ready_timeout_s, guide)
    return _counted(launch, outcome, run_dir)


class TrialNodes:
    """The graph of consecutive trials on the twin. The first trial starts it; a later one starts only the recorder again, and the nodes that its
    overrides change.

    After a trial that failed or does not count, and when a node has died, the next one starts all nodes again.

    Args:
        launch_file: The node graph, which records a bag.
        run_dir: Folder for sockets, logs and configurations of the nodes.

    Attributes:
        starts: How often the whole graph was started.
    """

    def __init__(self, launch_file: Path, run_dir: Path, ready_timeout_s: float) -> None:
        self._file, self._run_dir, self._ready_timeout_s = launch_file, run_dir, ready_timeout_s
        self._launch: Launch | None = None
        self.starts = 0

    def __enter__(self) -> TrialNodes:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def pids(self) -> dict[str, int]:
        """Process id of every running node."""
        return {} if self._launch is None else self._launch.pids

    def drive(
        self, overrides: Sequence[str], plan: TrialPlan, folder: Path, again: Collection[str] = ()
    ) -> TrialOutcome:
        """Run one trial.

        Args:
            overrides: All overrides of the launch file for this trial.
            folder: Folder for ``trial.json`` and the bag.
            again: Nodes to start again even if their configuration stays.

        Raises:
            LaunchError: A node died of an error, or the launch file is wrong.
            TrialError: The trial failed; `SpoiledError` if load or a fault of the stack kept it from measuring anything.
        """
        try:
            launch = self._started(overrides, folder.resolve() / "bag", again)
            outcome = _driven(launch, plan, self._ready_timeout_s)
            if RECORDER in launch.plan.nodes and not launch.failure:
                launch.finish(RECORDER)
            return _counted(launch, outcome, folder)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop all nodes."""
        launch, self._launch = self._launch, None
        if launch is not None:
            launch.stop()

    def _started(self, overrides: Sequence[str], bag: Path, again: Collection[str]) -> Launch:
        """The launch with these overrides, which records into a bag: the running one if its other nodes can stay."""
        launch, overrides = self._launch, [*overrides, f"record.output={bag}"]
        if (
            launch is not None
            and not launch.ending
            and launch.plan.nodes.keys() - {RECORDER} <= launch.pids.keys()
        ):
            plan = load_launch(self._file, overrides, launch.run_dir)
            changed = _changed(launch.plan, plan) | {RECORDER, *again} & plan.nodes.keys()
            if changed <= _EXCHANGEABLE:
                with contextlib.suppress(LaunchError):  # a node died meanwhile
                    launch.exchange(plan, changed)
                    launch.wait_ready(self._ready_timeout_s)
                    return launch
        self.close()
        shutil.rmtree(bag, ignore_errors=True)  # of the recorder that ended with these nodes
        self._launch = Launch(self._file, overrides, self._run_dir)
        self._launch.start()
        self.starts += 1
        return self._launch


def _changed(old: Plan, new: Plan) -> set[str]:
    """Names of nodes that differ between two plans."""
    return {
        name
        for name in old.nodes.keys() | new.nodes.keys()
        if old.nodes.get(name) != new.nodes.get(name)
        or node_document(old.documents[name]) != node_document(new.documents[name])
    }


def _driven(
    launch: Launch, plan: TrialPlan, ready_timeout_s: float, guide: Callable[[str], None] | None = None
) -> TrialOutcome:
    """Run the trial with a launch that was started."""
    node = TrialNode(plan, lambda: launch.failure, guide)
    try:
        launch.wait_ready(ready_timeout_s)
        _operate(node, launch.run_dir)
    except (LaunchError, TrialError) as error:
        raise (SpoiledError(str(error)) if launch.timed_out else error) from None
    return node.outcome


def _counted(launch: Launch, outcome: TrialOutcome, folder: Path) -> TrialOutcome:
    """The outcome of a trial whose bag is finished, if it counts."""
    if launch.failure:
        raise SpoiledError(launch.failure) if launch.timed_out else LaunchError(launch.failure)
    if not outcome.start_real_ns:
        raise SpoiledError(f"the stack stopped before the car moved: {outcome.stopped_early}")
    health = read_health(
        folder / "bag", outcome.start_real_ns, outcome.end_real_ns, outcome.stopped_early, TICK_S
    )
    if spoiled := spoiled_by(health):
        raise SpoiledError(spoiled)
    write_json(folder / "trial.json", asdict(outcome))
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
