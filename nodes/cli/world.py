"""The commands ``advnerf scene world ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import FAILURE_EXIT, Overrides, fail_unless, print_findings
from nodes.runtime.termination import ends_in_order

app = CommandGroup(
    no_args_is_help=True,
    help="Places that are driven: installing those of other people, and whether one keeps the contract.",
)
Name = Annotated[
    str,
    typer.Argument(
        metavar="WORLD", help="A world of `advnerf experiment list worlds`, or file.py:Class of your own."
    ),
]


@app.command("check")
def world_check(
    world: Name,
    overrides: Overrides = None,
    pictures: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for what the cameras see: look at it.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="PART", help="A part to look at alone; again for another.")
    ] = None,
) -> None:
    """Hold a world against the contract: handedness, metric depth, colour order, lateness, determinism, its car and its paths.

    Exit code 1 if a part of it is not met.
    """
    from advnerf_core.documents import Document
    from nodes.lab.plugin_tables import say_code
    from nodes.lab.worlds.check import check_world
    from nodes.lab.worlds.named import read_world
    from nodes.runtime.config import apply_overrides

    document = Document({"kind": world}, "command line")
    apply_overrides(document, overrides or [])
    say_code({"world": document.data}, Path.cwd())
    with ends_in_order():
        findings = check_world(read_world(document, Path.cwd()), pictures, only or [])
    fail_unless(print_findings(findings))


@app.command("install")
def world_install(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A world of `advnerf experiment list worlds`.")],
    yes: Annotated[bool, typer.Option("--yes", help="Accept the licence without being asked.")] = False,
    python: Annotated[
        Path | None,
        typer.Option(
            help="Interpreter to make it with.", show_default="one of a fitting version on the path"
        ),
    ] = None,
) -> None:
    """Make the environment of a simulator of other people, apart from this one, from its lock file. Its licence is shown first."""
    from advnerf_core.plugins import PluginError, unknown
    from hardware.worlds.environments import ENVIRONMENTS
    from nodes.lab.worlds.install import install

    if name not in ENVIRONMENTS:
        raise PluginError(unknown(name, "world that is installed", ENVIRONMENTS))
    environment = ENVIRONMENTS[name]
    if environment.state != "installed":
        print(f"{environment.title}\n{environment.licence}")
        if environment.system:
            print(f"It needs these Debian packages, or what others call them: {' '.join(environment.system)}")
        if not yes and not typer.confirm(f"Install it into {environment.folder}?"):
            raise typer.Exit(FAILURE_EXIT)
    made = install(environment, lambda text: print(text, flush=True), python)
    print(f"{'installed' if made else 'it is installed already'}: advnerf scene world check {name}")
