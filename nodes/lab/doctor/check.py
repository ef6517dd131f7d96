"""Checks with deadlines, so that a hanging driver, library or disk delays only its own check."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.run_module import module_command

OK, ABSENT, WARNING, FAILURE = "ok", "absent", "warning", "failure"
STATES = (OK, ABSENT, WARNING, FAILURE)
# Number of parallel checks. Third-party libraries are slow to import, and with more at once they would miss their deadlines.
_AT_ONCE = 3
CHILD_S = 60.0


@dataclass(frozen=True)
class CheckResult:
    """The result of a check, printed as one line.

    Attributes:
        state: ``ok``; ``absent`` (missing, but only some users need it); ``warning`` (something will not work as it should);
            ``failure`` (the requested function cannot work).
        do: Action to take; empty if none is needed.
    """

    check: str
    state: str
    found: str
    do: str = ""


def report(check: str, state: str, found: str, do: str = "") -> list[CheckResult]:
    """Return one result, as a check does that has no more to say; see `CheckResult`."""
    return [CheckResult(check, state, found, do)]


@dataclass(frozen=True)
class DoctorCheck:
    """A check to run.

    Attributes:
        run: Runs the check; may hang.
        deadline_s: Time after which the check counts as hung [s].
        cure: Action to take if it hangs.
    """

    name: str
    run: Callable[[], Sequence[CheckResult]]
    deadline_s: float = 10.0
    cure: str = (
        "look for a process in state D (ps aux), unplug the device it waits for, or restart the computer"
    )


@dataclass(frozen=True)
class ProbeResult:
    """The answer of a probe in a separate process.

    Attributes:
        data: The result; None if the probe failed.
        trouble: Reason for a failed probe.
        late: Whether it gave no answer in time, which does not show what is installed.
    """

    data: Any
    trouble: str = ""
    late: bool = False

    def cure(self, of_failure: str) -> str:
        """Action to take: the failure's, or to wait if the computer is only slow."""
        return "run advnerf doctor again when this computer has less to do" if self.late else of_failure


def examine(checks: Sequence[DoctorCheck]) -> Iterator[CheckResult]:
    """Run checks, a few in parallel. Yields their findings in the order of the checks."""
    with ThreadPoolExecutor(_AT_ONCE, "doctor") as pool:
        try:
            for findings in pool.map(_within_deadline, checks):
                yield from findings
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def worst(findings: Sequence[CheckResult]) -> str:
    """Return the worst state of the findings; ``ok`` without findings."""
    return STATES[max((STATES.index(finding.state) for finding in findings), default=0)]


def in_child(probe: str, *arguments: Any, timeout_s: float = CHILD_S) -> ProbeResult:
    """Run a probe of `nodes.lab.doctor.probes` in a separate process, because a broken library may crash, hang, or use all memory.

    Args:
        timeout_s: Time after which the process is killed [s].
    """
    command = module_command("nodes.lab.doctor.probes", probe, json.dumps(arguments))
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return ProbeResult(None, f"no answer within {timeout_s:g} s", late=True)
    if done.returncode < 0:
        return ProbeResult(None, f"its process was ended by signal {-done.returncode}")
    lines = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    if done.returncode or not lines:
        return ProbeResult(
            None, lines[-1] if lines else f"its process ended with exit code {done.returncode}"
        )
    return ProbeResult(json.loads(lines[-1]))


def _within_deadline(check: DoctorCheck) -> Sequence[CheckResult]:
    """Run a check in a daemon thread and return its findings, or a failure after the deadline."""
    found: list[Sequence[CheckResult]] = []
    thread = threading.Thread(
        target=lambda: found.append(_run(check)), name=f"doctor {check.name}", daemon=True
    )
    thread.start()
    thread.join(check.deadline_s)
    return (
        found[0]
        if found
        else report(check.name, FAILURE, f"no answer within {check.deadline_s:g} s", check.cure)
    )


def _run(check: DoctorCheck) -> Sequence[CheckResult]:
    try:
        return check.run()
    except (AdvnerfError, OSError, ValueError) as error:
        return report(check.name, FAILURE, str(error) or type(error).__name__)
    except Exception as error:  # a bug in one check must not prevent the others
        do = "report it"
        return report(check.name, WARNING, f"the check itself failed: {type(error).__name__}: {error}", do)
