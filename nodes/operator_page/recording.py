"""A recorder that the operator starts and stops. The launch's own recorder is not affected."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import time
from pathlib import Path
from typing import Any

from advnerf_core.files import write_atomically
from nodes.launching.child import Child
from nodes.launching.launch_schema import NodeEntry

RECORDER, LAUNCH_RECORDER, TELEOP = "page_recorder", "recorder", "/teleop/state"
# Names the folder of a recording until its end is known to the page: one that starts beside it knows that an earlier one died.
_RUNNING = Path("page/recording.txt")
_SIGNAL_AFTER_S, _KILL_AFTER_S = 2.0, 10.0


class RecorderControl:
    """Starts and stops a recorder process.

    Args:
        nodes: Nodes whose status is recorded too.
        operates: Whether this page records; else it does not tell of another page's recording.
    """

    def __init__(self, run_dir: Path, nodes: tuple[str, ...], operates: bool = True) -> None:
        self._run_dir, self._nodes = run_dir, nodes
        self._child: Child | None = None
        self._asked_s: float | None = None
        self._folder, self._trouble = _left_behind(run_dir) if operates else ("", "")
        self._connected = False

    @property
    def records(self) -> bool:
        """Whether a recorder runs and has received messages of this page."""
        return self._connected and self._child is not None and self._asked_s is None

    @property
    def starting(self) -> bool:
        """Whether a recorder was started that does not record yet."""
        return self._child is not None and self._asked_s is None and not self._connected

    def heard(self, status: Any) -> None:
        """Note a status of the recorder. Only a recorder that received something from this page also receives labels."""
        if self._child is not None and int(status.pid) == self._child.pid:
            received = dict(zip(status.counter_names, status.counter_values, strict=True))
            self._connected |= bool(received.get(f"received {TELEOP}", 0.0) > 0.0)  # the counters are numpy's

    def start(self) -> str:
        """Start a recorder into a new folder. Returns why not; empty if it was started."""
        if self._child is not None and self._child.running:
            return f"already recording to {self._folder}"
        self._folder = f"bags/{time.strftime('%Y%m%d-%H%M%S')}"
        if (self._run_dir / self._folder).exists():
            return f"{self._folder} exists; try again in a second"
        config = {"output": self._folder, "statuses_of": list(self._nodes), "until_page_stops": True}
        child = Child(RECORDER, NodeEntry(module="nodes.recorder"), self._run_dir)
        try:
            write_atomically(child.config, json.dumps(config))
            write_atomically(self._run_dir / _RUNNING, self._folder)
            child.start()
        except OSError as error:  # a full disk must not end the page
            self._forget()
            return f"cannot start a recorder: {error.strerror or error}"
        self._child, self._asked_s, self._trouble, self._connected = child, None, "", False
        return ""

    def stop(self) -> str:
        """Let the recorder finish its bag. Returns why not; empty if it will.

        It ends with the act that this call belongs to, which reaches it after all labels; one that does not hear the page is sent a signal.
        """
        if self._child is None or not self._child.running:
            return "not recording"
        self._asked_s = time.monotonic()
        if not self._connected:
            self._child.signal(signal.SIGINT)
        return ""

    def check(self) -> None:
        """Notice a recorder that has ended, and kill one that does not end."""
        child = self._child
        if child is None:
            return
        if child.running:
            waited_s = 0.0 if self._asked_s is None else time.monotonic() - self._asked_s
            if waited_s > _SIGNAL_AFTER_S:
                child.signal(signal.SIGINT if waited_s < _KILL_AFTER_S else signal.SIGKILL)
            return
        if self._asked_s is None or child.exit_code:
            self._trouble = f"the recorder {child.how_it_ended()}"
        self._child = None
        self._forget()

    def state(self) -> dict[str, object]:
        """Describe the recording and the space left on its disk, for the page."""
        return {
            "on": self._child is not None,
            "records": self.records,
            "stopping": self._child is not None and self._asked_s is not None,
            "folder": self._folder,
            "trouble": self._trouble,
            "disk_left_gb": self._disk_left_gb(),
        }

    def _disk_left_gb(self) -> float:
        try:
            return round(shutil.disk_usage(self._run_dir).free / 1e9, 1)
        except OSError:
            return 0.0

    def close(self) -> None:
        """Finish the bag, and wait for it."""
        if self._child is None or not self._child.running:
            return
        self._child.signal(signal.SIGINT)
        self._child.wait_or_kill(_KILL_AFTER_S)
        self._forget()

    def _forget(self) -> None:
        """Note that the end of the recording is known."""
        with contextlib.suppress(OSError):
            (self._run_dir / _RUNNING).unlink(missing_ok=True)


def _left_behind(run_dir: Path) -> tuple[str, str]:
    """Folder of the recording of an earlier page, and what to say about it; both empty if that page knew how it ended."""
    try:
        folder = (run_dir / _RUNNING).read_text("utf-8")
    except (OSError, UnicodeDecodeError):
        return "", ""
    return folder, (
        f"The recording to {folder} ended with an earlier page; start recording again. If its bag is unfinished, advnerf bag repair "
        f"{run_dir / folder} completes it."
    )
