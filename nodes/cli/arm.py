"""The commands ``advnerf arm``, which names the launch and asks, and ``advnerf disarm``, which stops all launches and never asks."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import typer

from nodes.runtime.terminal import RunDir, say_error

if TYPE_CHECKING:
    from nodes.runtime.stopping import StopReport

Reason = Annotated[str, typer.Option("--reason", help="Reason to record.")]
_FAILURE_EXIT, _ERROR_EXIT = 1, 2
_STILL = "Use the e-stop or cut the power. Still asking (Ctrl-C gives up)"
# The process has this long to import its code and to ask, before it says that nothing is confirmed.
_FIRST_WORD_S = 0.9


def arm(run_dir: RunDir = None, reason: Reason = "") -> None:
    """Ask the safety node of a running launch to arm the car. Asks first if the launch was not started in this folder."""
    from nodes.runtime.arm_requests import ask_to_arm

    answer = ask_to_arm(_run_to_arm(run_dir), reason)
    if answer.granted and answer.armed:
        print(f"armed by {answer.text}")
        return
    print(f"armed, but stopped again since: {answer.text}" if answer.granted else f"not armed: {answer.text}")
    raise typer.Exit(_FAILURE_EXIT)


def disarm(
    run_dir: Annotated[
        Path | None,
        typer.Option("--run-dir", help="Folder of the run.", show_default="all running launches"),
    ] = None,
    reason: Reason = "",
) -> None:
    """Stop the car of every running launch of this user, and keep it stopped."""
    first_word = _FirstWord()
    try:
        stopped = _stop(run_dir, reason, first_word)
    except Exception as error:  # whatever went wrong, the car may be driving
        first_word.spoken()
        say_error(f"NOT CONFIRMED: {error or type(error).__name__}. The car may be driving. Use the e-stop")
        raise typer.Exit(_ERROR_EXIT) from None
    if not stopped:
        raise typer.Exit(_FAILURE_EXIT)


def _run_to_arm(given: Path | None) -> Path:
    """Return the run folder of the launch to arm, after it was named. A person confirms it unless it was started in this folder."""
    from nodes.launching.launch import active_launches
    from nodes.launching.launched import read_launched
    from nodes.launching.watching import find_run_dir
    from nodes.runtime.errors import LaunchError

    if given is not None:
        run_dir = find_run_dir(given).resolve()
        print(f"{run_dir}: {read_launched(run_dir).car(run_dir)}")
        return run_dir
    launches = active_launches()
    if not launches:
        return find_run_dir(None)  # says that there is none
    for number, launch in enumerate(launches, start=1):
        folder = Path(launch["run_dir"])
        mark = f"{number}: " if len(launches) > 1 else ""
        print(f"{mark}{launch['name']} in {folder}: {read_launched(folder).car(folder)}")
    if len(launches) == 1 and launches[0].get("cwd") == os.getcwd():
        return Path(launches[0]["run_dir"])
    if not sys.stdin.isatty():
        why = (
            "it was not started in this folder"
            if len(launches) == 1
            else f"{len(launches)} launches are running"
        )
        raise LaunchError(
            f"expected a terminal to confirm which car to arm, because {why}; name it with --run-dir"
        )
    return Path(launches[_chosen(len(launches))]["run_dir"])


def _chosen(count: int) -> int:
    """Ask which of the launches to arm. Returns its index."""
    if count == 1:
        typer.confirm("It was not started in this folder. Arm it?", abort=True)
        return 0
    return int(typer.prompt(f"Arm which one, 1 to {count}?", type=click.IntRange(1, count))) - 1


def _stop(run_dir: Path | None, reason: str, first_word: _FirstWord) -> bool:
    """Stop one run, or all. Returns whether every stop is confirmed."""
    from nodes.launching.launch import active_launches
    from nodes.launching.watching import find_run_dir
    from nodes.runtime.errors import LaunchError
    from nodes.runtime.stopping import stop_runs

    if run_dir is not None:
        names = {find_run_dir(run_dir): ""}
    else:
        names = {
            Path(launch["run_dir"]): f"{launch['name']} in {launch['run_dir']}: "
            for launch in active_launches()
        }
    if not names:
        raise LaunchError(
            f"found no running launch of user {os.getuid()} on this computer; name its folder with --run-dir"
        )
    confirmed = True

    def tell(report: StopReport) -> None:
        nonlocal confirmed
        first_word.spoken()
        text, well = _outcome(report)
        if report.answer is not None or report.trouble:  # the last word of this run
            confirmed &= well
        if well:
            print(names[report.run_dir] + text, flush=True)
        else:
            say_error(names[report.run_dir] + text)

    stop_runs(list(names), reason, tell)
    return confirmed


def _outcome(report: StopReport) -> tuple[str, bool]:
    """Describe what is known about a stop. Returns whether it is confirmed, too."""
    from nodes.runtime.arm_requests import BRAKE_WAIT_S

    answer = report.answer
    if report.trouble:
        return f"NOT CONFIRMED: {report.trouble}. The car may be driving. Use the e-stop", False
    if answer is None:
        silence = f"no answer from the safety node for {report.waited_s:.1f} s, and the car may be driving"
        return f"NOT CONFIRMED: {silence}. {_STILL}", False
    if answer.armed:
        return "NOT CONFIRMED: disarmed, but another request has armed the car again since", False
    if answer.braked:
        return f"CONFIRMED: not armed: {answer.text}", True
    return (
        f"NOT CONFIRMED: not armed: {answer.text}, but the motor node did not report within {BRAKE_WAIT_S:g} s that it brakes. "
        "Watch the car. If the motor node is down, the motor controller brakes after its own timeout",
        False,
    )


class _FirstWord:
    """Says NOT CONFIRMED if the command has said nothing by 0.9 s after the start of its process, however slow the computer is."""

    def __init__(self) -> None:
        self._timer = threading.Timer(max(0.0, _FIRST_WORD_S - _process_age_s()), self._say)
        self._timer.daemon = True
        self._timer.start()

    def spoken(self) -> None:
        """Note that the command has said something."""
        self._timer.cancel()

    @staticmethod
    def _say() -> None:
        say_error(f"NOT CONFIRMED: nothing is known yet, and the car may be driving. {_STILL}")


def _process_age_s() -> float:
    """Time since this process was started [s]. Source: proc(5), field 22 of ``/proc/self/stat``."""
    try:
        fields = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return 0.0


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("arm")(arm)
    app.command("disarm")(disarm)
