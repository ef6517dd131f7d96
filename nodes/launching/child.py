"""A supervised process."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any

from advnerf_core.run_module import module_command
from nodes.launching.launch_schema import NodeEntry

_SHIM = Path(__file__).with_name("shim.py")
# A recorder moves nothing, and its bag is finished if it may end in order.
_ENDS_IN_ORDER = ("nodes.recorder",)


def shim_command(supervisor_gone: signal.Signals = signal.SIGKILL) -> list[str]:
    """Command before that of a program, which then gets this signal when the calling thread ends."""
    return [sys.executable, "-I", "-S", str(_SHIM), str(os.getpid()), str(int(supervisor_gone))]


class Child:
    """The process of a node, in its own process group. It is killed when the thread that started it ends; a recorder gets SIGTERM.

    Args:
        name: Name of the node.
        entry: Entry of the node in the launch file.
        run_dir: Folder of the run.
    """

    def __init__(self, name: str, entry: NodeEntry, run_dir: Path) -> None:
        self.name = name
        self.entry = entry
        self.log = run_dir / "logs" / f"{name}.log"
        self.config = run_dir / "config" / f"{name}.yaml"
        self._run_dir = run_dir
        self._process: subprocess.Popen[bytes] | None = None
        self.restarts: list[float] = []
        self.restart_at: float | None = None
        self.started_at = 0.0
        self.status: Any = None
        self.status_at: float | None = None
        self.given_up = False

    @property
    def pid(self) -> int:
        """Process id; 0 before the first start."""
        return self._process.pid if self._process is not None else 0

    @property
    def running(self) -> bool:
        """Whether the process is running."""
        if self._process is None or self._process.returncode is not None:
            return False
        if os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return True
        # Until the process is reaped, its group id cannot be reused. So the processes that it left behind can be killed safely.
        self.signal(signal.SIGKILL)
        self._process.wait()
        return False

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while the process is running."""
        return None if self.running or self._process is None else self._process.returncode

    def start(self) -> None:
        """Start the process. Call it from a thread that outlives the process, because PDEATHSIG is sent when this thread ends."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        gone = signal.SIGTERM if self.entry.module in _ENDS_IN_ORDER else signal.SIGKILL
        command = [
            *shim_command(gone),
            *module_command(self.entry.module, "--config", str(self.config)),
            *("--folder", str(self._run_dir), "--name", self.name),
        ]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **self.entry.env}
        with open(self.log, "ab") as log:
            self._process = self._spawn(command, environment, log)
        self.started_at, self.status, self.status_at, self.restart_at = time.monotonic(), None, None, None

    def excuse(self, pause_s: float) -> None:
        """Leave a time [s] in which nobody listened out of the time since the start and the last status."""
        self.started_at += pause_s
        if self.status_at is not None:
            self.status_at += pause_s

    @staticmethod
    def _spawn(command: list[str], environment: dict[str, str], log: IO[bytes]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, start_new_session=True
        )

    def signal(self, number: int) -> None:
        """Send a signal to the whole process group."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)

    def wait_or_kill(self, wait_s: float) -> None:
        """Wait for a process that was asked to end; kill its group if it does not end within this time [s]."""
        deadline = time.monotonic() + wait_s
        while self.running and time.monotonic() < deadline:
            time.sleep(0.05)
        self.signal(signal.SIGKILL)

    def how_it_ended(self) -> str:
        """Describe how the process ended."""
        code = self.exit_code
        if code is None:
            return "still runs"
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        last = self.last_line() if code > 0 else ""
        return f"{how}{': ' + last if last else ''} (log: {self.log})"

    def last_line(self) -> str:
        """Last line of the log that starts with the node's name, as errors do, or else the last line; without the name."""
        try:
            lines = self.log.read_bytes()[-4000:].decode("utf-8", "replace").strip().splitlines()
        except OSError:
            return ""
        own = [line for line in lines if line.startswith(f"{self.name}: ")]
        return (own or lines or [""])[-1].removeprefix(f"{self.name}: ")[:500]
