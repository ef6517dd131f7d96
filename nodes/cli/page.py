"""The command ``advnerf car page``: the address of the running page, or a recording on the page without a car."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.terminal import RunDir

if TYPE_CHECKING:
    from nodes.launching.child import Child
    from nodes.page import PageConfig

_REQUESTS = ("/arm", "/attack/request", "/attack/cancel", "/player/control", "/player/state", "/clock")
_END_S = 5.0


def page(
    bag: Annotated[
        Path | None,
        typer.Argument(
            help="Show this recording instead of a running launch.", exists=True, show_default=False
        ),
    ] = None,
    run_dir: RunDir = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port of a recording's page; 0 selects a free one.")
    ] = 8090,
    rate: Annotated[float, typer.Option(min=0.001, help="Speed relative to the recording.")] = 1.0,
) -> None:
    """Show the address of the running operator page, and the code for a phone. With a bag: show the recording on a page."""
    if bag is None:
        _say_address(run_dir)
    else:
        _show_recording(bag, run_dir, port, rate)


def _say_address(run_dir: Path | None) -> None:
    from advnerf_core.documents import read_json
    from nodes.launching.watching import find_run_dir
    from nodes.page import DOOR
    from nodes.runtime.errors import LaunchError

    folder = find_run_dir(run_dir)
    try:
        door = read_json(folder / DOOR)
    except FileNotFoundError:
        raise LaunchError(
            f"expected a page node in {folder}, found none; launch launch/page.launch.yaml, or add a node with module nodes.page"
        ) from None
    print(door["url"])
    if door["code"]:
        until = time.strftime("%H:%M:%S", time.localtime(door["valid_until_s"]))
        print(f"code {door['code'][:4]}-{door['code'][4:]}, valid once, until {until}")
        print(f"SHA-256 fingerprint of the certificate: {door['fingerprint']}")


def _show_recording(bag: Path, run_dir: Path | None, port: int, rate: float) -> None:
    from tempfile import TemporaryDirectory

    from nodes.page import PageNode
    from nodes.runtime.node import NodeContext
    from nodes.runtime.process import run_node

    with TemporaryDirectory(prefix="advnerf-page-") as temporary:
        folder = Path(temporary) if run_dir is None else run_dir
        folder.mkdir(parents=True, exist_ok=True)
        config, player = _recording(bag, folder, port, rate)

        def build(context: NodeContext) -> PageNode:
            node = PageNode.build(config, context)
            player.start()
            print(f"{node.url} shows {bag}; press Ctrl-C to stop", flush=True)
            return node

        try:
            code = run_node(build, "page", folder)
        finally:
            player.signal(signal.SIGINT)
            player.wait_or_kill(_END_S)
        raise typer.Exit(code)


def _recording(bag: Path, folder: Path, port: int, rate: float) -> tuple[PageConfig, Child]:
    """Prepare a page that only watches, and the player of the bag."""
    from advnerf_core.files import write_atomically
    from nodes.bags.reader import read_attachments, read_info
    from nodes.launching.child import Child
    from nodes.launching.launch_schema import NodeEntry
    from nodes.page import PageConfig
    from nodes.runtime.topics import STATUS_PREFIX, type_of_topic

    recorded = [topic.name for topic in read_info(bag).topics]
    names = [name.removeprefix(STATUS_PREFIX) for name in recorded if name.startswith(STATUS_PREFIX)]
    nodes = [name for name in names if name not in ("page", "player")]
    left_out = (*_REQUESTS, f"{STATUS_PREFIX}page", f"{STATUS_PREFIX}player")
    topics = [name for name in recorded if type_of_topic(name) is not None and name not in left_out]
    attached = read_attachments(bag)
    kept = {
        name: data for name, data in attached.items() if name == "room.yaml" or name.endswith(".safetensors")
    }
    for name, data in kept.items():
        write_atomically(folder / "recorded" / Path(name).name, data)
    camera = "/camera/image_raw" if "/camera/image_raw" in topics else "/camera/image_raw/compressed"
    values: dict[str, Any] = {
        "port": port,
        "role": "watch",
        "room": folder / "recorded" / "room.yaml" if "room.yaml" in kept else None,
        "attacks": [folder / "recorded" / Path(name).name for name in kept if name.endswith(".safetensors")],
        "camera_topic": camera,
        "nodes": nodes,
    }
    player = Child("player", NodeEntry(module="nodes.player"), folder)
    playing = {"bag": str(bag.resolve()), "rate": rate, "loop": True, "topics": topics, "wait_for": []}
    write_atomically(player.config, json.dumps(playing))
    return PageConfig.model_validate(values), player
