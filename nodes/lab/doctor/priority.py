"""Check of the processor shares: what a safety node would get, and what the nodes of running launches have."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from nodes.lab.doctor.check import OK, WARNING, CheckResult, report
from nodes.launching.running import active_launches
from nodes.runtime.paths import lock_path, socket_path
from nodes.runtime.priority import FIRST, Share, share_of
from nodes.runtime.topics import status_topic

_PROBE_S = 20.0
DEADLINE_S = _PROBE_S + 5.0
_DO = "allow it: add the line '<user> - nice -10' to /etc/security/limits.conf and log in again"


def shares() -> list[CheckResult]:
    """Check whether safety and motor run before other processes."""
    program = (
        "import dataclasses, json; from nodes.runtime.priority import *; "
        "print(json.dumps(dataclasses.astuple(take_share(FIRST))))"
    )
    # A separate session, as each node of a launch has.
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=_PROBE_S,
        start_new_session=True,
        check=False,
    )
    if done.returncode:
        return report("priority", WARNING, (done.stderr.strip().splitlines() or ["no answer"])[-1])
    share = Share(*json.loads(done.stdout))
    if share.reaches(FIRST):
        rows = report("priority", OK, f"safety and motor run before all other nodes: {share}")
    else:
        text = f"safety and motor get {share}, expected nice {FIRST}: on a busy computer they stop the car too early"
        rows = report("priority", WARNING, text, _DO)
    return rows + [CheckResult("priority", OK, line) for line in _running()]


def _running() -> list[str]:
    """Describe the shares of safety and motor in running launches."""
    lines = []
    for launch in active_launches():
        found = []
        for name in ("safety", "motor"):
            try:
                # The publisher of the status holds this lock and has written its process id into it.
                lock = lock_path(socket_path(Path(launch["run_dir"]), status_topic(name)))
                found.append(f"{name} {share_of(int(lock.read_text(encoding='ascii')))}")
            except (OSError, ValueError):
                continue  # on another host, or just ended
        if found:
            lines.append(f"{launch['name']}: {'; '.join(found)}")
    return lines
