"""A search in a separate process: its output goes to an inbox of the attack node, and it can be stopped at once."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.run_module import module_command
from nodes.launching.child import shim_command
from nodes.runtime.inbox import Inbox, ReaderThread

# Names that nodes.experiment.node.search shares; the node does not import that, because it would bring torch.
REQUEST, TOGETHER_STATE = "request.experiment.yaml", "together.state.safetensors"
_READ_S = 0.2
_PIECE = 1 << 16
_END_S = 2.0


def is_begun(folder: Path) -> bool:
    """Whether a search has written a state or a result into a folder. Until then another request may replace it."""
    return (folder / TOGETHER_STATE).exists() or any(folder.glob("seed_*.safetensors"))


@dataclass(frozen=True, eq=False)
class Said:
    """One output of a search.

    Attributes:
        kind: ``progress``, ``image``, ``done``, ``failed`` or ``ended``.
        pixels: Pixels of an image, ``height * width * 3`` bytes RGB.
    """

    job: Job
    kind: str
    data: dict[str, Any]
    pixels: bytes = b""


class Job:
    """A running search.

    Args:
        folder: Folder with the request; also for state, log and results.
        inbox: Inbox for its outputs.
        threads: Threads of its computations; 0 uses the libraries' defaults.
    """

    def __init__(self, folder: Path, inbox: Inbox[Said], threads: int = 0) -> None:
        self.folder = folder
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if threads:
            environment |= {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
        # It dies with the node, which then finds its state and resumes.
        with open(self.log, "ab") as log:
            self._process = subprocess.Popen(
                [*shim_command(), *module_command("nodes.experiment.node.worker", str(folder))],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        self._buffer = bytearray()
        self._ended = False
        self._reader: ReaderThread[Said] = ReaderThread(self._read, inbox, "attack-job")
        self._reader.start()

    @property
    def log(self) -> Path:
        """Log file of its errors."""
        return self.folder / "worker.log"

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def stop(self) -> None:
        """Stop it at once; its state file is always whole."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        # A process that hangs in the kernel dies when it returns; the node must not wait for that.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        self._reader.stop()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def why_it_failed(self) -> str:
        """Last log lines of a search that ended by itself."""
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return f"fell silent without ending (log: {self.log})"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}; send the request again to go on"
        lines = self.log.read_bytes()[-4000:].decode("utf-8", "replace").strip().splitlines()
        return f"{lines[-1] if lines else f'ended with exit code {code}'} (log: {self.log})"

    def _read(self) -> Said | None:
        """One output, if it comes within a moment."""
        if said := self._parsed():
            return said
        if not select.select([self._pipe], [], [], _READ_S)[0] or self._ended:
            return None
        piece = os.read(self._pipe, _PIECE)
        self._buffer += piece
        if piece:
            return self._parsed()
        self._ended = True
        return Said(self, "ended", {})

    def _parsed(self) -> Said | None:
        """A line of JSON, and the pixels that it announces."""
        line, newline, rest = bytes(self._buffer).partition(b"\n")
        if not newline:
            return None
        data = json.loads(line)
        length = int(data.get("bytes", 0))
        if len(rest) < length:
            return None
        self._buffer = bytearray(rest[length:])
        return Said(self, data.pop("kind"), data, rest[:length])
