"""The work of ``advnerf disarm``. It stops all launches and never asks, and imports no more than it needs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from advnerf_core.errors import AdvnerfError
from nodes.cli.first_word import promise_first_word, spoken

if TYPE_CHECKING:
    from nodes.runtime.stopping import StopReport

_FAILURE_EXIT, _ERROR_EXIT = 1, 2
_STILL = "Use the e-stop or cut the power. Still asking (Ctrl-C gives up)"


def stop(run_dir: Path | None, reason: str) -> int:
    """Stop one run, or every running launch, and print what is known about each. Returns the exit code."""
    promise_first_word()
    try:
        return 0 if _stop(run_dir, reason) else _FAILURE_EXIT
    except Exception as error:  # after any error, the car may still be driving
        spoken()
        _say_error(f"NOT CONFIRMED: {error or type(error).__name__}. The car may be driving. Use the e-stop")
        return _ERROR_EXIT


def _stop(run_dir: Path | None, reason: str) -> bool:
    """Stop one run, or all. Returns whether every stop is confirmed."""
    from nodes.launching.running import active_launches
    from nodes.runtime.errors import LaunchError
    from nodes.runtime.stopping import stop_runs

    if run_dir is not None:
        if not run_dir.is_dir():
            raise LaunchError(f"expected a run folder at {run_dir}, found none; correct --folder")
        names = {run_dir: ""}
    else:
        names = {
            Path(launch["run_dir"]): f"{launch['name']} in {launch['run_dir']}: "
            for launch in active_launches()
        }
    if not names:
        raise LaunchError(
            f"found no running launch of user {os.getuid()} on this computer; name its folder with --folder"
        )
    confirmed = True

    def tell(report: StopReport) -> None:
        nonlocal confirmed
        spoken()
        text, well = _outcome(report)
        if report.answer is not None or report.trouble:  # the last word of this run
            confirmed &= well
        if well:
            print(names[report.run_dir] + text, flush=True)
        else:
            _say_error(names[report.run_dir] + text)

    stop_runs(list(names), reason, tell, _why_unreachable)
    return confirmed


def _why_unreachable(run_dir: Path) -> str:
    """Why no request reaches a run any more; empty if one may, or if that cannot be found out."""
    from nodes.launching.running import is_running

    if is_running(run_dir):
        return ""
    from nodes.launching.launched import why_unreachable  # takes a while, in which other runs are not asked

    try:
        return why_unreachable(run_dir)
    except (AdvnerfError, OSError):  # such as a damaged file of the run: what is asked must still be asked
        return ""


def _outcome(report: StopReport) -> tuple[str, bool]:
    """Describe what is known about a stop. Returns whether it is confirmed, too."""
    from nodes.runtime.arm_requests import BRAKE_WAIT_S

    answer = report.answer
    if report.trouble:
        return f"NOT CONFIRMED: {report.trouble}. The car may be driving. Use the e-stop", False
    if answer is None:
        silence = f"no answer from the safety node for {report.waited_s:.1f} s, and the car may be driving"
        return ". ".join(filter(None, (f"NOT CONFIRMED: {silence}", _STILL, report.gateway))), False
    if answer.armed:
        return "NOT CONFIRMED: disarmed, but another request has armed the car again since", False
    if answer.braked:
        return f"CONFIRMED: not armed: {answer.text}", True
    return (
        f"NOT CONFIRMED: not armed: {answer.text}, but the motor node did not report within {BRAKE_WAIT_S:g} s that it brakes. "
        "Watch the car. If the motor node is down, the motor controller brakes after its own timeout",
        False,
    )


def _say_error(text: str) -> None:
    print(f"error: {' '.join(text.split())}", file=sys.stderr, flush=True)
