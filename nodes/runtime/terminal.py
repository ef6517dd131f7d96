"""Helpers that the commands share: options, tables, one-line errors."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from nodes.runtime.errors import ConfigError
from nodes.runtime.paths import named_file

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from nodes.runtime.findings import CheckFinding

FAILURE_EXIT = 1
"""Exit code of a command whose answer is no: something is not met, not granted or not equal."""

_ADDRESS = re.compile(r"(\[[0-9a-f:]+\]|[^:/\s]+):(\d{1,5})")
_LAST_PORT = 65535
_COLOURS = {"warning": "yellow", "met, but look": "yellow", "failure": "red", "not met": "red"}
_POLICY_FILES = (".safetensors", ".onnx", ".pt2")
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a value of the file. May be repeated."),
]
Device = Annotated[
    Literal["cpu", "cuda"] | None,
    typer.Option(
        "--device",
        help="Where searches compute; cuda is an NVIDIA GPU.",
        show_default="ADVNERF_DEVICE, or cpu",
    ),
]


def launch_argument(text: str | Path) -> Path:
    """Launch file of an argument."""
    return named_file(text, "launch")


def experiment_argument(text: str | Path) -> Path:
    """Experiment file of an argument."""
    return named_file(text, "experiment")


def policy_argument(text: str) -> str:
    """Name of a policy: a file, which must be there, or a factory. It is checked here, as loading one takes seconds."""
    if not (Path(text).is_file() if text.endswith(_POLICY_FILES) else ":" in text):
        from advnerf_core.policies.load import wrong_policy

        raise typer.BadParameter(wrong_policy(text))
    return text


def scene_argument(path: Path) -> Path:
    """A scene file; for a folder, an error that names its scene file, or the command that makes one."""
    from advnerf_core.data.scan_folder import DATA_SET, from_scan_advice, scan_of

    if not path.is_dir():
        return path
    scene = "scene.safetensors"
    learned = next((each for pattern in (scene, f"*/{scene}") for each in sorted(path.glob(pattern))), None)
    advice = from_scan_advice(
        path, "give a scene.safetensors, which 'advnerf scene train' and 'from-splat' write"
    )
    if learned is not None:
        advice = f"give {learned}"
    elif (found := scan_of(path)) is not None and found.name == DATA_SET:
        advice = f"it holds images, so run: advnerf scene train {path} -o {path / 'learned'}"
    raise typer.BadParameter(f"expected a scene file, got the folder {path}; {advice}")


PolicyName = Annotated[
    str,
    typer.Argument(
        metavar="POLICY",
        help="Policy: a .safetensors, .onnx or .pt2 file, or package.module:factory.",
        callback=policy_argument,
    ),
]
LaunchFile = Annotated[
    Path,
    typer.Argument(
        metavar="FILE|NAME", help="A *.launch.yaml file, or the name of one.", parser=launch_argument
    ),
]
RunDir = Annotated[
    Path | None, typer.Option("--folder", help="Folder of the run.", show_default="the only running launch")
]
Topics = Annotated[
    list[str] | None, typer.Option("--topics", metavar="TOPIC", help="Use only this topic. May be repeated.")
]


def listen_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; an IPv6 host keeps its brackets. Anything else raises `ConfigError`."""
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found[2]) > _LAST_PORT:
        raise ConfigError(
            f"expected HOST:PORT to listen on, got {text}; write a port of at most {_LAST_PORT}"
        )
    return found[1], int(found[2])


def numbers_of(option: str, text: str, count: int, form: str, example: str) -> tuple[float, ...]:
    """The finite numbers of a text such as ``X,Y,YAW``; anything else raises `ConfigError`."""
    try:
        values = tuple(map(float, text.split(",")))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ConfigError(
            f"{option} {text}: expected {count} finite numbers {form}, for example {option} {example}"
        )
    return values


def pose_of(option: str, text: str | None, example: str) -> tuple[float, float, float] | None:
    """The pose of a text ``X,Y,YAW`` in metres and radians; None for None. Anything else, as degrees are, raises `ConfigError`."""
    from advnerf_core.strict import within_a_turn

    if text is None:
        return None
    x_m, y_m, yaw_rad = numbers_of(option, text, 3, "X,Y,YAW in metres and radians", example)
    try:
        return x_m, y_m, within_a_turn(yaw_rad)
    except ValueError as error:
        raise ConfigError(f"{option} {text}: {error}") from None


def table(*columns: str) -> Table:
    """Make an empty table without lines."""
    from rich.table import Table

    empty = Table(box=None, pad_edge=False)
    for column in columns:
        empty.add_column(column, overflow="fold")
    return empty


def coloured(text: str, colour: str) -> Text:
    """Make a cell of a table in a colour."""
    from rich.text import Text

    return Text(text, style=colour)


def print_table(full: Table) -> None:
    """Print a table as it is, see `plain_console`. In a pipe, its lines are not wrapped."""
    from nodes.runtime.console import plain_console

    plain_console(width=None if sys.stdout.isatty() else 240).print(full)


def fail_unless(met: bool) -> None:
    """Exit with `FAILURE_EXIT` if what a command examined is not as it should be."""
    if not met:
        raise typer.Exit(FAILURE_EXIT)


def say_error(text: str) -> None:
    """Print an error as one line, or as one for each of its problems, which are in lines that are indented by two spaces."""
    lines = [" ".join(line.split()) for line in re.split(r"\n  (?=\S)", text)]
    print("error:", "\n  ".join(lines), file=sys.stderr, flush=True)


def print_findings(findings: Sequence[CheckFinding], what: str = "part") -> bool:
    """Print what a check found, a line for each part that ``what`` names. Returns whether all of it is met."""
    rows = table(what, "state", "found")
    for finding in findings:
        colour = _COLOURS.get(finding.state, "green")
        rows.add_row(finding.name, coloured(finding.state, colour), finding.text)
    print_table(rows)
    return all(finding.met for finding in findings)
