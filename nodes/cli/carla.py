"""The commands ``advnerf scene carla ...``: look at a server, list junctions, photograph one, drive it, free a server."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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
    """Say what is right and what is wrong with a server; the world is left unchanged."""
    from nodes.lab.carla.check import check_server

    with ends_in_order():
        checks = check_server(_config(config, overrides, host, port), pictures=pictures)
    fail_unless(print_findings(checks, "check"))


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
    from hardware.worlds.carla.config import ServerConfig
    from hardware.worlds.carla.connection import connect
    from hardware.worlds.carla.junction import list_junctions
    from hardware.worlds.carla.library import load_carla, read_opendrive, server_answers

    library = load_carla()
    if opendrive is not None:
        carla_map = read_opendrive(opendrive, library)
    else:
        server = _config(None, None, host, port).server
        with server_answers("its map"):
            carla_map = connect(ServerConfig.model_validate(server), library).get_world().get_map()
    rows = table("id", "x [m]", "y [m]", "roads", "sets of drives")
    for junction in list_junctions(carla_map, library):
        place = f"{junction.x_m:.1f}", f"{junction.y_m:.1f}"
        rows.add_row(str(junction.id), *place, str(junction.arms), str(junction.drives))
    print_table(rows)


@app.command("capture")
def carla_capture(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the pictures; a stopped capture goes on there.")
    ],
    host: Host = None,
    port: Port = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    photos: Annotated[int, typer.Option(min=1, help="Photographs to learn from.")] = 1800,
    held_out: Annotated[int, typer.Option(min=0, help="Views that nothing learns from.")] = 60,
    seed: Annotated[int, typer.Option(help="Random seed of the views.")] = 0,
) -> None:
    """Photograph a junction along its lanes: transforms.json for `advnerf scene train --open`, and the reference paths."""
    from nodes.lab.carla.capture import CaptureRequest, capture
    from nodes.runtime.progress import ProgressDisplay

    request = CaptureRequest(photos, held_out, seed)
    with ends_in_order(), ProgressDisplay() as display:
        taken, there = capture(
            _config(config, overrides, host, port), request, output, display.start("capture")
        )
    print(f"{taken} pictures taken, {there} were there: {output}")


@app.command("drive")
def carla_drive(
    host: Host = None,
    port: Port = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    path: Annotated[
        Literal["straight", "right", "left"], typer.Option(help="Reference path of the junction.")
    ] = "straight",
    seconds: Annotated[float, typer.Option(min=0.1, help="How long to drive.")] = 6.0,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="JSON file for states, turn rates and cross-track errors."),
    ] = None,
) -> None:
    """Let the expert, who knows the true state, follow a reference path; says how well it did."""
    import json

    from advnerf_core.files import write_atomically
    from hardware.worlds.carla.scene import CarlaScene
    from nodes.lab.worlds.expert_drive import as_path, drive_expert, lane_expert

    wanted = _config(config, overrides, host, port)
    dt_s = wanted.render.fixed_delta_s
    with ends_in_order(), CarlaScene(wanted) as scene:
        reference = scene.paths[path]
        expert = lane_expert(as_path(reference), wanted.car.description, dt_s)
        drive = drive_expert(scene, expert, reference.start_pose, max(round(seconds / dt_s), 1), dt_s)
    worst, mean = abs(drive.cte_m).max(), abs(drive.cte_m).mean()
    print(
        f"{path}: |CTE| {mean:.3f} m on average, {worst:.3f} m at worst, over {len(drive.controls)} ticks of {dt_s:g} s"
    )
    if drive.blocked_tick is not None:
        print(f"the car ran into something, or left the scene, at tick {drive.blocked_tick}")
    if output is not None:
        arrays = {"states": drive.states, "controls": drive.controls, "cte_m": drive.cte_m}
        content = {
            "path": path,
            "blocked_tick": drive.blocked_tick,
            **{name: rows.tolist() for name, rows in arrays.items()},
        }
        write_atomically(output, json.dumps(content) + "\n")


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
