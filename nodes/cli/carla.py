"""The commands ``advnerf scene carla ...``: look at a server, list junctions, free a server. Experiments photograph and drive them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import Overrides, fail_unless, print_findings, print_table, table
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from hardware.worlds.carla.config import CarlaConfig

app = typer.Typer(
    no_args_is_help=True, help="CARLA as a deployment scene; docs/carla.md says how to start a server."
)

Host = Annotated[
    str | None, typer.Argument(help="Computer of the server.", show_default="of the configuration: 127.0.0.1")
]
Port = Annotated[
    int | None,
    typer.Option(
        "--port",
        min=1,
        max=65534,
        help="TCP port of the server.",
        show_default="of the configuration: 2000",
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config", help="YAML file of a CarlaConfig; values not in it have their defaults.", exists=True
    ),
]


@app.command("check")
def carla_check(
    host: Host = None,
    port: Port = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    pictures: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for what the driving camera sees: look at it."),
    ] = None,
) -> None:
    """Hold a server's junction against the contract of a world, as `advnerf scene world check carla`; its settings are put back.

    Exit code 1 if a part of it is not met.
    """
    from hardware.worlds.carla.scene import CarlaScene
    from nodes.lab.worlds.check import check_world
    from nodes.lab.worlds.named import NamedWorld

    named = NamedWorld("carla", CarlaScene, _config(config, overrides, host, port), "")
    with ends_in_order():
        findings = check_world(named, pictures)
    fail_unless(print_findings(findings))


@app.command("junctions")
def carla_junctions(
    host: Host = None,
    port: Port = None,
    opendrive: Annotated[
        Path | None,
        typer.Option(help="Read this OpenDRIVE file (.xodr) instead of asking a server.", exists=True),
    ] = None,
) -> None:
    """List a map's junctions: id, place, roads, and how many sets of drives straight, right and left they have."""
    from hardware.worlds.carla.connection import connect
    from hardware.worlds.carla.junction import list_junctions
    from hardware.worlds.carla.library import load_carla, read_opendrive, server_answers

    library = load_carla()
    if opendrive is not None:
        carla_map = read_opendrive(opendrive, library)
    else:
        server = _config(None, None, host, port).server
        with server_answers("its map"):
            carla_map = connect(server, library).get_world().get_map()
    rows = table("id", "x [m]", "y [m]", "roads", "sets of drives")
    for junction in list_junctions(carla_map, library):
        place = f"{junction.x_m:.1f}", f"{junction.y_m:.1f}"
        rows.add_row(str(junction.id), *place, str(junction.arms), str(junction.drives))
    print_table(rows)


@app.command("release")
def carla_release(host: Host = None, port: Port = None) -> None:
    """Free a server whose client was killed: its world waits for ticks that never come."""
    from hardware.worlds.carla.release import release

    freed = release(_config(None, None, host, port).server)
    print("the world ticks by itself again" if freed else "nothing to do: the world ticks by itself")


def _config(
    file: Path | None, overrides: list[str] | None, host: str | None, port: int | None
) -> CarlaConfig:
    from advnerf_core.documents import Document, read_yaml
    from advnerf_core.strict import validate
    from hardware.worlds.carla.config import CarlaConfig
    from nodes.runtime.config import apply_overrides

    document = Document({}, "command line") if file is None else read_yaml(file)
    named = ([f"server.host={host}"] if host is not None else []) + (
        [f"server.port={port}"] if port is not None else []
    )
    apply_overrides(document, [*named, *(overrides or [])])
    return validate(CarlaConfig, document)
