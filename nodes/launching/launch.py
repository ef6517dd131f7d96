"""The supervisor: starts the nodes of a launch file, watches them, and stops all of them.

One thread starts and watches all processes. PR_SET_PDEATHSIG is sent when this thread ends, so it must live as long as they do. A
required node that dies, hangs or does not start stops the whole launch. The supervisor never arms the car.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TextIO

from advnerf_core.documents import dump_yaml
from advnerf_core.files import write_atomically
from advnerf_core.places import require_utf8
from nodes.launching.child import Child
from nodes.launching.launch_file import Plan, load_launch
from nodes.launching.running import leave_card
from nodes.runtime.bus import Bus
from nodes.runtime.config import node_document
from nodes.runtime.errors import LaunchError
from nodes.runtime.locks import HeldError, hold
from nodes.runtime.paths import RESOLVED_NAME, require_new
from nodes.runtime.topics import status_topic

_POLL_S = 0.05
_SIGINT_S, _SIGTERM_S = 5.0, 2.0
# A longer pause of the supervisor (Ctrl-Z, a busy computer) is no silence of the nodes: what they sent meanwhile has not been delivered yet.
_HELD_UP_S = 0.5
_UP = ("ready", "active")


class Launch:
    """A running launch.

    Args:
        file: A ``*.launch.yaml`` file.
        overrides: ``node.key=value`` and ``params.name=value``.
        run_dir: Folder of the run: sockets, logs, resolved configuration.
        report: Called with one line per event, from the supervisor's thread.
        host: Host of the launch file that this computer is; None if the file has no hosts.

    Use it as a context manager: leaving it stops all nodes.
    """

    def __init__(
        self,
        file: Path,
        overrides: Sequence[str] = (),
        run_dir: Path = Path("runs/launch"),
        report: Callable[[str], None] | None = None,
        host: str | None = None,
    ) -> None:
        self.run_dir = Path(run_dir).resolve()
        require_utf8(self.run_dir)
        self.plan: Plan = load_launch(Path(file), overrides, self.run_dir, host)
        self.failure = ""
        self.timed_out = False  # whether a node was too slow, instead of ended by its own error
        self._report = report or (lambda line: None)
        self._children = {name: Child(name, entry, self.run_dir) for name, entry in self.plan.nodes.items()}
        # Plain flags: an Event takes a lock, and a signal handler that sets it could deadlock with itself.
        self._stopping = self._impatient = False
        self._started, self._ready, self._done = threading.Event(), threading.Event(), threading.Event()
        self._tasks: SimpleQueue[tuple[Callable[[], None], threading.Event]] = SimpleQueue()
        self._looked_at: float | None = None
        self._thread = threading.Thread(target=self._supervise, name="supervisor", daemon=True)
        self._lock: TextIO | None = None
        self._card: Path | None = None
        self._bus: Bus | None = None

    def __enter__(self) -> Launch:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    @property
    def pids(self) -> dict[str, int]:
        """Process id of every running node."""
        return {name: child.pid for name, child in self._children.items() if child.running}

    @property
    def ending(self) -> bool:
        """Whether the launch has ended, or is about to."""
        return self._stopping or self._done.is_set()

    @property
    def statuses(self) -> dict[str, Any]:
        """Last ``NodeStatus`` of every node that has reported."""
        return {name: child.status for name, child in self._children.items() if child.status is not None}

    @property
    def exit_code(self) -> int:
        """Exit code: 0, or 1 after a failure, which `failure` describes."""
        return 1 if self.failure else 0

    def start(self) -> None:
        """Lock the run folder, write the resolved configuration and start all nodes."""
        self._lock = _lock_run(self.run_dir)
        try:
            self._require_new_bags()
            self._write_configuration()
        except BaseException:
            self._lock.close()
            raise
        self._thread.start()
        self._started.wait()

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Wait until every node is running and every subscription is connected to its publisher."""
        deadline = time.monotonic() + timeout_s
        while not self._ready.wait(0.02):
            if self._done.is_set():
                raise LaunchError(self.failure or "the launch was stopped before it was ready")
            if time.monotonic() > deadline:
                self.timed_out = True
                raise LaunchError(
                    f"expected the launch to be ready within {timeout_s:g} s: {self._what_is_missing()}"
                )

    def finish(self, name: str) -> None:
        """Stop one node, and wait until it has ended; the others keep running.

        Raises:
            LaunchError: The launch has ended.
        """
        self._by_supervisor(lambda: self._finish([name]))

    def exchange(self, plan: Plan, names: Collection[str]) -> None:
        """Start some nodes again with their configuration in another plan; the others keep running. `wait_ready` waits for all.

        Args:
            plan: A plan of the same launch file and run folder, in which only these nodes differ.
            names: The nodes.

        Raises:
            LaunchError: The launch has ended.
        """
        self._by_supervisor(lambda: self._exchange(plan, names))

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until the launch ends. Returns the exit code, or None on timeout."""
        return self.exit_code if self._done.wait(timeout_s) else None

    def stop(self) -> int:
        """Stop all nodes (SIGINT, after 5 s SIGTERM, then SIGKILL) and wait until they have ended."""
        self.request_stop()
        if self._thread.ident is not None:
            self._thread.join()
        return self.exit_code

    def request_stop(self, kill: bool = False) -> None:
        """Start stopping without waiting. Safe in a signal handler. ``kill`` skips SIGINT and SIGTERM."""
        self._stopping = True
        self._impatient = self._impatient or kill

    def _by_supervisor(self, task: Callable[[], None]) -> None:
        """Have a task done by the supervisor's thread, from which all processes must be started."""
        finished = threading.Event()
        self._tasks.put((task, finished))
        while not finished.wait(_POLL_S):
            if self._done.is_set():
                raise LaunchError(self.failure or "the launch was stopped")

    def _finish(self, names: Collection[str]) -> None:
        children = [self._children[name] for name in names]
        for child in children:
            child.given_up = True  # its end is no failure, and nothing waits for it
        self._stop_children([child for child in children if child.running])

    def _exchange(self, plan: Plan, names: Collection[str]) -> None:
        self._finish(names)
        self.plan = plan
        self._write_configuration()
        for child in self._children.values():
            child.status = None  # the connections that it reported may be those of nodes that ended
        self._ready.clear()
        for child in (self._children[name] for name in plan.nodes if name in names):
            child.given_up = False
            child.start()
            self._report(f"{child.name}: started again, process {child.pid}")

    def _require_new_bags(self) -> None:
        """Refuse a run folder with a bag of an earlier launch, before any node starts; the recorder would."""
        for name, entry in self.plan.nodes.items():
            if entry.module == "nodes.recorder":
                require_new(self.run_dir / self.plan.documents[name].data.get("output", "bag"))

    def _write_configuration(self) -> None:
        resolved = dump_yaml(self.plan.resolved)
        write_atomically(self.run_dir / RESOLVED_NAME, resolved)
        for name, child in self._children.items():
            document = node_document(self.plan.documents[name])
            write_atomically(child.config, dump_yaml(document))

    def _supervise(self) -> None:
        try:
            self._card = leave_card(self.plan.launch.name, self.run_dir)
            self._bus = Bus(self.run_dir)
            for name in self._children:
                self._bus.subscribe(status_topic(name))
            for child in self._children.values():
                child.start()
                self._report(f"{child.name}: started, process {child.pid}")
            self._started.set()
            while not self._stopping:
                self._watch(self._bus)
        except Exception as error:  # after any error, no process may be left running
            self._fail(f"the supervisor failed: {type(error).__name__}: {error}")
        finally:
            self._take_down()

    def _watch(self, bus: Bus) -> None:
        bus.wait(_POLL_S)
        with contextlib.suppress(Empty):
            task, finished = self._tasks.get_nowait()
            task()
            finished.set()
        now = time.monotonic()
        self._excuse_pause(now)
        for received in bus.receive():
            child = self._children[received.topic.rsplit("/", 1)[-1]]
            status = received.message()
            if int(status.pid) == child.pid:
                child.status, child.status_at = status, now
        for child in self._children.values():
            self._look_after(child, now)
        if not self._ready.is_set() and not self._stopping and not self._what_is_missing():
            self._ready.set()
            self._report("all nodes are ready")

    def _excuse_pause(self, now: float) -> None:
        """Do not count the time in which the supervisor itself did not run as silence of its nodes, which would be killed for it."""
        pause_s = 0.0 if self._looked_at is None else now - self._looked_at
        self._looked_at = now
        if pause_s <= _HELD_UP_S:
            return
        for child in self._children.values():
            child.excuse(pause_s)
        self._report(f"the launch was held up for {pause_s:.1f} s; its nodes went on")

    def _look_after(self, child: Child, now: float) -> None:
        if child.restart_at is not None:
            if now >= child.restart_at:
                child.start()
                self._report(f"{child.name}: restarted, process {child.pid}")
        elif child.running:
            if trouble := _silence(child, now):
                self.timed_out |= child.entry.required and not self.failure
                child.signal(signal.SIGKILL)
                self._died(child, f"{trouble} and was killed (log: {child.log})", now)
        elif not child.given_up:
            if child.entry.ends_launch and child.exit_code == 0:
                self._report(f"{child.name}: finished")
                self._stopping = True
                child.given_up = True
            else:
                self._died(child, child.how_it_ended(), now)

    def _died(self, child: Child, how: str, now: float) -> None:
        if child.entry.required:
            child.given_up = True
            self._fail(f"required node {child.name} {how}")
            return
        rule = child.entry.respawn
        recent = [t for t in child.restarts if rule is not None and now - t < rule.window_s]
        if rule is None or len(recent) >= rule.max_restarts:
            child.given_up = True
            self._report(f"{child.name} {how}; it is not restarted")
            return
        delay_s = min(rule.delay_s * 2.0 ** len(recent), rule.max_delay_s)
        child.restarts = [*recent, now]
        child.restart_at = now + delay_s
        self._report(f"{child.name} {how}; restarting it in {delay_s:g} s")

    def _fail(self, why: str) -> None:
        if not self.failure:
            self.failure = why
        self._report(why)
        self._stopping = True

    def _what_is_missing(self) -> str:
        """Describe why the launch is not ready; empty if it is."""
        wanted: dict[str, int] = {}
        connected: dict[str, int] = {}
        missing: list[str] = []
        for child in self._children.values():
            if child.given_up:
                continue
            status = child.status
            if status is None or status.state not in _UP:
                missing.append(
                    f"{child.name} is {status.state + ' ' + status.text if status else 'silent'}".strip()
                )
                continue
            for topic in status.subscriptions:
                wanted[topic] = wanted.get(topic, 0) + 1
            connected |= dict(zip(status.publications, map(int, status.subscribers), strict=True))
        for topic, count in wanted.items():
            if connected.get(topic, count) < count:
                missing.append(f"{topic} has {connected[topic]} of {count} subscribers")
        return ", ".join(missing)

    def _take_down(self) -> None:
        try:
            for last in (False, True):
                self._stop_children(
                    [c for c in self._children.values() if c.entry.stop_last is last and c.running]
                )
        finally:
            for child in self._children.values():
                if child.running:
                    child.signal(signal.SIGKILL)
            if self._bus is not None:
                self._bus.close()
            if self._card is not None:
                self._card.unlink(missing_ok=True)
            if self._lock is not None:
                self._lock.close()
            self._started.set()
            self._done.set()

    def _stop_children(self, children: list[Child]) -> None:
        for number, patience_s in (
            (signal.SIGINT, _SIGINT_S),
            (signal.SIGTERM, _SIGTERM_S),
            (signal.SIGKILL, _SIGTERM_S),
        ):
            for child in children:
                if child.running:
                    child.signal(number)
            deadline = time.monotonic() + patience_s
            while any(child.running for child in children):
                impatient = self._impatient and number != signal.SIGKILL
                if impatient or time.monotonic() > deadline:
                    break
                time.sleep(0.01)
            else:
                return
            late = ", ".join(child.name for child in children if child.running)
            self._report(f"{late}: still running after {number.name}")


def _silence(child: Child, now: float) -> str:
    if child.status_at is None:
        limit_s = child.entry.start_timeout_s
        return f"sent no status within {limit_s:g} s of its start" if now - child.started_at > limit_s else ""
    limit_s = child.entry.hang_timeout_s
    return f"hung: no status for {limit_s:g} s" if now - child.status_at > limit_s else ""


def _lock_run(run_dir: Path) -> TextIO:
    run_dir.mkdir(parents=True, exist_ok=True)
    try:
        return hold(run_dir / "launch.lock")
    except HeldError as error:
        raise LaunchError(
            f"{run_dir} is in use by the launch of process {error.owner}, and two launches cannot share endpoints; stop it, or use "
            "another --folder"
        ) from None
