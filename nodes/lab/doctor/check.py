"""Checks with a deadline each: whatever hangs - a driver, a vendor's library, a dead disk - costs its own time and no more."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from advnerf_core.errors import AdvnerfError

OK, ABSENT, WARNING, FAILURE = "ok", "absent", "warning", "failure"
STATES = (OK, ABSENT, WARNING, FAILURE)
# Foreign libraries are slow to import; more at once would only make each of them later than its deadline.
_AT_ONCE = 3
CHILD_S = 60.0


@dataclass(frozen=True)
class Finding:
    """One line.

    Attributes:
        check: What was looked at.
        state: ``ok``; ``absent`` (not here, and only some need it); ``warning`` (something will not work as it should);
            ``failure`` (what was asked for cannot work).
        found: What was found.
        do: What to do about it; empty where nothing has to be done.
    """

    check: str
    state: str
    found: str
    do: str = ""

    def to_dict(self) -> dict[str, str]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class Check:
    """Something to look at.

    Attributes:
        name: What is looked at.
        run: Looks; may hang.
        deadline_s: Time after which it counts as hung [s].
        cure: What to do when it hangs.
    """

    name: str
    run: Callable[[], Sequence[Finding]]
    deadline_s: float = 10.0
    cure: str = "look for a process in state D (ps aux), unplug what it waits for, or start the computer again"


@dataclass(frozen=True)
class Answer:
    """What a probe in a process of its own said.

    Attributes:
        data: Its result; None if it has none.
        trouble: Why it has none.
    """

    data: Any
    trouble: str = ""


def examine(checks: Sequence[Check]) -> Iterator[Finding]:
    """Run checks, a few at once; their findings in the order of the checks, as they become known."""
    with ThreadPoolExecutor(_AT_ONCE, "doctor") as pool:
        try:
            for findings in pool.map(_within_deadline, checks):
                yield from findings
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def worst(findings: Sequence[Finding]) -> str:
    """The worst state among findings; ``ok`` without any."""
    return STATES[max((STATES.index(finding.state) for finding in findings), default=0)]


def in_child(probe: str, *arguments: Any, timeout_s: float = CHILD_S) -> Answer:
    """Run a probe of `nodes.lab.doctor.probes` in a process of its own: a broken library may end it, hang it, or fill its memory.

    Args:
        probe: Name of the probe.
        arguments: What it gets; must be plain data.
        timeout_s: Time after which the process is killed [s].
    """
    command = [sys.executable, "-m", "nodes.lab.doctor.probes", probe, json.dumps(arguments)]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return Answer(None, f"no answer within {timeout_s:g} s")
    if done.returncode < 0:
        return Answer(None, f"its process was ended by signal {-done.returncode}")
    lines = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    if done.returncode or not lines:
        return Answer(None, lines[-1] if lines else f"its process ended with exit code {done.returncode}")
    return Answer(json.loads(lines[-1]))


def _within_deadline(check: Check) -> Sequence[Finding]:
    """Findings of a check; it runs in a thread that nobody waits for beyond the deadline, nor at the end of the process."""
    found: list[Sequence[Finding]] = []
    thread = threading.Thread(target=lambda: found.append(_run(check)), name=f"doctor {check.name}", daemon=True)
    thread.start()
    thread.join(check.deadline_s)
    return found[0] if found else [Finding(check.name, FAILURE, f"no answer within {check.deadline_s:g} s", check.cure)]


def _run(check: Check) -> Sequence[Finding]:
    try:
        return check.run()
    except (AdvnerfError, OSError, ValueError) as error:
        return [Finding(check.name, FAILURE, str(error) or type(error).__name__)]
    except Exception as error:  # one check with a defect must not take the others with it
        return [Finding(check.name, WARNING, f"the check itself failed: {type(error).__name__}: {error}", "report it")]
