"""Queries about the nodes of a running launch: their state and their load."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from nodes.launching.launch_hosts import GATEWAY
from nodes.launching.launched import read_launched
from nodes.launching.running import is_alive
from nodes.launching.watching import node_names
from nodes.runtime.bus import Bus
from nodes.runtime.paths import lock_path, socket_path
from nodes.runtime.topics import STATUS_PREFIX, status_topic

_SILENT = "silent"
_MIB = 2**20
_QUEUE_WORDS = ("inbox_dropped",)


@dataclass(frozen=True)
class NodeRow:
    """State and load of a node over a period.

    Attributes:
        name: Name in the launch file.
        pid: Process id; 0 for a node on another host.
        state: Reported state, or ``silent``.
        text: Reported status text.
        cpu_percent: CPU load in percent of one core; None for a process on another host.
        memory_mib: Resident memory [MiB]; None for a process on another host.
        rate_hz: Handled messages and ticks per second.
        dropped: Messages skipped for newer ones, lost or refused since the node started.
        missed: Ticks missed since the node started.
        restarts: Number of restarts during the observation.
        queue: Messages dropped from the queue of its drivers since it started.
    """

    name: str
    pid: int
    state: str
    text: str
    cpu_percent: float | None
    memory_mib: float | None
    rate_hz: float
    dropped: int
    missed: int
    restarts: int
    queue: int


def _describe_silence(run_dir: Path, name: str) -> tuple[int, str]:
    """Describe how long a node has not reported, from the lock file that its publisher touches at every status.

    Returns:
        Process id, 0 for a process that has ended or runs on another host; and time since the last status, and state of the process.
    """
    lock = lock_path(socket_path(run_dir, status_topic(name)))
    try:
        age_s = max(0.0, time.time() - lock.stat().st_mtime)
        owner = int(lock.read_text(encoding="ascii").strip() or 0)
    except (FileNotFoundError, ValueError):
        return 0, "has never reported"
    process = _process_of(name, owner)
    if process is None:
        return 0, f"last status {age_s:.1f} s ago; its process has ended"
    try:
        stopped = process.status() == psutil.STATUS_STOPPED
    except psutil.Error:
        stopped = False
    state = "stopped by a signal" if stopped else "alive"
    return owner, f"last status {age_s:.1f} s ago; its process is {state}"


def _describe_unheard(run_dir: Path, name: str) -> str:
    """Describe how long nothing was heard of a node on another host. The lock of its status belongs to this host's gateway."""
    if not is_alive(run_dir, GATEWAY):
        return "not known, this host's gateway has ended"
    lock = lock_path(socket_path(run_dir, status_topic(name)))
    return f"not heard for {max(0.0, time.time() - lock.stat().st_mtime):.1f} s; it runs on another host"


def _process_of(name: str, pid: int) -> psutil.Process | None:
    """Process of a node, if it runs on this host. The pid of a node on another host may belong to an unrelated process."""
    try:
        process = psutil.Process(pid)
        command = process.cmdline()
        return process if "--name" in command and command[command.index("--name") + 1] == name else None
    except (psutil.Error, IndexError):
        return None


class NodeWatch:
    """Observes all nodes of a run folder repeatedly.

    Args:
        run_dir: Folder of the run.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._bus = Bus(run_dir)
        self._first: dict[str, tuple[float, Any]] = {}
        self._last: dict[str, tuple[float, Any]] = {}
        self._restarts: dict[str, int] = {}
        self._processes: dict[int, psutil.Process] = {}
        self._relayed: frozenset[str] = frozenset()

    def __enter__(self) -> NodeWatch:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bus.close()

    def rows(self, duration_s: float) -> list[NodeRow]:
        """Observe for ``duration_s`` [s] and return a row for each node."""
        names = node_names(self._run_dir)
        self._relayed = frozenset(read_launched(self._run_dir).relayed)
        for name in names:
            self._bus.subscribe(status_topic(name))
        self._first.clear()
        deadline = time.monotonic() + duration_s
        while (left := deadline - time.monotonic()) > 0:
            self._bus.wait(left)
            for received in self._bus.receive():
                name = received.topic.removeprefix(STATUS_PREFIX)
                self._note(name, received.message())
        return [
            self._row(name) if name in self._first else self._silent(name)
            for name in sorted({*names, *self._first})
        ]

    def _note(self, name: str, status: Any) -> None:
        now, pid = time.monotonic(), int(status.pid)
        if name in self._last and int(self._last[name][1].pid) != pid:
            self._restarts[name] = self._restarts.get(name, 0) + 1
            self._first[name] = (now, status)  # its counters begin again
        self._first.setdefault(name, (now, status))
        self._last[name] = (now, status)
        self._process(name, pid)

    def _process(self, name: str, pid: int) -> psutil.Process | None:
        if pid not in self._processes:
            process = _process_of(name, pid)
            if process is None:
                return None
            process.cpu_percent()  # the first call starts the measurement
            self._processes[pid] = process
        return self._processes[pid]

    def _usage(self, process: psutil.Process | None) -> tuple[float | None, float | None]:
        """CPU load [% of one core] and memory [MiB]; None for a process on another host."""
        try:
            return (
                (None, None) if process is None else (process.cpu_percent(), process.memory_info().rss / _MIB)
            )
        except psutil.Error:
            return None, None

    def _silent(self, name: str) -> NodeRow:
        if status_topic(name) in self._relayed:
            pid, text = 0, _describe_unheard(self._run_dir, name)
        else:
            pid, text = _describe_silence(self._run_dir, name)
        cpu, memory = self._usage(self._process(name, pid) if pid else None)
        restarts = self._restarts.get(name, 0)
        return NodeRow(name, pid, _SILENT, text, cpu, memory, 0.0, 0, 0, restarts, 0)

    def _row(self, name: str) -> NodeRow:
        (began, first), (ended, last) = self._first[name], self._last[name]
        before, after = _counters(first), _counters(last)
        work = sum(
            after[key] - before.get(key, 0.0)
            for key in after
            if key == "ticks" or key.startswith("received ")
        )
        process = self._process(name, int(last.pid))
        cpu, memory = self._usage(process)
        return NodeRow(
            name,
            0 if memory is None else int(last.pid),
            str(last.state),
            str(last.text),
            cpu,
            memory,
            work / (ended - began) if ended > began else 0.0,
            int(
                sum(
                    v
                    for k, v in after.items()
                    if k.split(" ")[0] in ("dropped", "lost", "refused") and " " in k
                )
            ),
            int(after.get("ticks_missed", 0)),
            self._restarts.get(name, 0),
            int(sum(after.get(word, 0) for word in _QUEUE_WORDS)),
        )


def _counters(status: Any) -> dict[str, float]:
    return dict(zip(status.counter_names, map(float, status.counter_values), strict=True))
