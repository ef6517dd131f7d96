"""The command ``advnerf doctor``."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from nodes.runtime.terminal import Overrides, fail_unless, launch_argument

if TYPE_CHECKING:
    from nodes.lab.doctor.check import CheckResult, DoctorCheck

_COLOURS = {"ok": "green", "absent": "bright_black", "warning": "yellow", "failure": "red"}


def doctor(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE|NAME]", help="Check only what this *.launch.yaml needs.", parser=launch_argument
        ),
    ] = None,
    folder: Annotated[Path, typer.Option(help="Folder of runs, whose disk is checked.")] = Path("runs"),
    host: Annotated[
        str | None, typer.Option(help="Host of the launch file that this computer is, or all.")
    ] = None,
    gpu: Annotated[
        bool,
        typer.Option(
            "--gpu", help="Only compare the GPU with the processor; prints text to paste into an issue."
        ),
    ] = False,
    gpu_device: Annotated[
        Literal["cuda", "cpu"],
        typer.Option(
            hidden=True, help="What --gpu compares with the processor; cpu tries the comparison itself."
        ),
    ] = "cuda",
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    overrides: Overrides = None,
) -> None:
    """Check what this computer has and lacks, and how to fix it. With a launch file, check only what that file needs.

    Exit code 0: no failure found. 1: something will not work. 2: the launch file or an option is wrong.
    """
    if gpu:
        from nodes.lab.doctor.gpu import compare_gpu

        fail_unless(compare_gpu(gpu_device, typer.echo))
        return
    from nodes.lab.doctor.check import FAILURE, examine, worst

    findings = []
    for finding in examine(_checks(file, folder, host, overrides or [])):
        findings.append(finding)
        if not as_json:
            _print(finding)
    state = worst(findings)
    if as_json:
        print(json.dumps({"state": state, "findings": [asdict(finding) for finding in findings]}, indent=1))
    else:
        counts = {word: sum(finding.state == word for finding in findings) for word in ("failure", "warning")}
        print(", ".join(f"{count} {word}{'s' * (count != 1)}" for word, count in counts.items()))
    fail_unless(state != FAILURE)


def _checks(file: Path | None, folder: Path, host: str | None, overrides: list[str]) -> list[DoctorCheck]:
    if file is None:
        from nodes.lab.doctor.general import checks

        if overrides or host:
            raise typer.BadParameter("--set and --host need a launch file; give one")
        return checks(folder)
    from nodes.lab.doctor.launch import checks_of
    from nodes.launching.launch_file import load_launch

    return checks_of(load_launch(file, overrides, host=host), folder)


def _print(finding: CheckResult) -> None:
    cure = f" -> {finding.do}" if finding.do else ""
    state = typer.style(f"{finding.state:8}", fg=_COLOURS[finding.state])
    typer.echo(f"{state} {finding.check:13} {' '.join(finding.found.split())}{cure}")
