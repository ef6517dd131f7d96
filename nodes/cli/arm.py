"""The commands ``advnerf car arm``, which names the launch and asks, and ``advnerf disarm``, which stops all launches and never asks."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from nodes.cli.stop import stop
from nodes.runtime.terminal import FAILURE_EXIT, RunDir

Reason = Annotated[str, typer.Option("--reason", help="Reason to record.")]


def arm(run_dir: RunDir = None, reason: Reason = "") -> None:
    """Ask the safety node of a running launch to arm the car. Asks first if the launch was not started in this folder."""
    from nodes.launching.watching import require_running
    from nodes.runtime.arm_requests import ask_to_arm

    run = _run_to_arm(run_dir)
    require_running(run)
    answer = ask_to_arm(run, reason)
    if answer.granted and answer.armed:
        print(f"armed by {answer.text}")
        return
    print(f"armed, but stopped again since: {answer.text}" if answer.granted else f"not armed: {answer.text}")
    raise typer.Exit(FAILURE_EXIT)


def disarm(
    run_dir: Annotated[
        Path | None,
        typer.Option("--folder", help="Folder of the run.", show_default="all running launches"),
    ] = None,
    reason: Reason = "",
) -> None:
    """Stop the car of every running launch of this user, and keep it stopped."""
    raise typer.Exit(stop(run_dir, reason))


def _run_to_arm(given: Path | None) -> Path:
    """Return the run folder of the launch to arm, after it was named. A person confirms it unless it was started in this folder."""
    from nodes.launching.running import active_launches
    from nodes.launching.watching import describe_car, find_run_dir
    from nodes.runtime.errors import LaunchError

    if given is not None:
        run_dir = find_run_dir(given).resolve()
        print(f"{run_dir}: {describe_car(run_dir)}")
        return run_dir
    launches = active_launches()
    if not launches:
        return find_run_dir(None)  # raises the error about a missing one
    for number, launch in enumerate(launches, start=1):
        folder = Path(launch["run_dir"])
        mark = f"{number}: " if len(launches) > 1 else ""
        print(f"{mark}{launch['name']} in {folder}: {describe_car(folder)}")
    if len(launches) == 1 and launches[0].get("cwd") == os.getcwd():
        return Path(launches[0]["run_dir"])
    if not sys.stdin.isatty():
        why = (
            "it was not started in this folder"
            if len(launches) == 1
            else f"{len(launches)} launches are running"
        )
        raise LaunchError(
            f"expected a terminal to confirm which car to arm, because {why}; name it with --folder"
        )
    return Path(launches[_chosen(len(launches))]["run_dir"])


def _chosen(count: int) -> int:
    """Ask which of the launches to arm. Returns its index."""
    if count == 1:
        typer.confirm("It was not started in this folder. Arm it?", abort=True)
        return 0
    number = 0
    while not 1 <= number <= count:
        number = typer.prompt(f"Arm which one, 1 to {count}?", type=int)
    return number - 1
