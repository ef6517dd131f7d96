"""The commands ``advnerf scene carla ...``: list junctions, free a server. Experiments photograph and drive them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import print_table, table

app = CommandGroup(
    no_args_is_help=True, help="CARLA as a deployment scene; docs/carla.md says how to start a server."
)

Host = Annotated[str, typer.Argument(help="Computer of the server.")]
Port = Annotated[int, typer.Option("--port", min=1, max=65534, help="TCP port of the server.")]
_HOST, _PORT = "127.0.0.1", 2000


@app.command("junctions")
def carla_junctions(
    host: Host = _HOST,
    port: Port = _PORT,
    opendrive: Annotated[
        Path | None,
        typer.Option(help="Read this OpenDRIVE file (.xodr) instead of asking a server.", exists=True),
    ] = None,
) -> None:
    """List a map's junctions: id, place, roads, and how many sets of drives straight, right and left they have."""
    from hardware.worlds.carla.config import ServerConfig
    from hardware.worlds.carla.connection import connect
    from hardware.worlds.carla.junction import list_junctions
    from hardware.worlds.carla.library import load_carla, read_opendrive, server_answers

    library = load_carla()
    if opendrive is not None:
        carla_map = read_opendrive(opendrive, library)
    else:
        with server_answers("its map"):
            carla_map = connect(ServerConfig(host=host, port=port), library).get_world().get_map()
    rows = table("id", "x [m]", "y [m]", "roads", "sets of drives")
    for junction in list_junctions(carla_map, library):
        place = f"{junction.x_m:.1f}", f"{junction.y_m:.1f}"
        rows.add_row(str(junction.id), *place, str(junction.arms), str(junction.drives))
    print_table(rows)


@app.command("release")
def carla_release(host: Host = _HOST, port: Port = _PORT) -> None:
    """Free a server whose client was killed: its world waits for ticks that never come."""
    from hardware.worlds.carla.config import ServerConfig
    from hardware.worlds.carla.release import release

    freed = release(ServerConfig(host=host, port=port))
    print("the world ticks by itself again" if freed else "nothing to do: the world ticks by itself")
