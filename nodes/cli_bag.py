"""The commands ``advnerf bag ...``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.terminal import RunDir, Topics, print_table, table

app = typer.Typer(no_args_is_help=True, help="Record, look into, play and repair bags (MCAP, as rosbag2 writes them).")


@app.command("info")
def bag_info(bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.", exists=True)]) -> None:
    """Say what is in a bag."""
    from datetime import datetime

    from nodes.runtime.bag_read import read_info

    info = read_info(bag)
    start = datetime.fromtimestamp(info.start_ns / 1e9).isoformat(" ", "milliseconds")
    print(
        f"{info.path}: {info.size_bytes / 1e6:.1f} MB, {info.messages} messages in {info.duration_s:.2f} s from {start}"
    )
    for key, value in info.metadata.items():
        print(f"{key}: {value}")
    print(f"attachments: {', '.join(info.attachments) or 'none'}")
    rows = table("topic", "type", "messages", "rate", "lost")
    for topic in info.topics:
        rate = f"{(topic.count - 1) / info.duration_s:.1f} Hz" if topic.count > 1 and info.duration_s > 0 else ""
        rows.add_row(topic.name, topic.type, str(topic.count), rate, "?" if topic.lost is None else str(topic.lost))
    print_table(rows)


@app.command("record")
def bag_record(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="New folder for the bag.", show_default="bag-<time>")
    ] = Path(""),
    topics: Topics = None,
    run_dir: RunDir = None,
) -> None:
    """Record what a running launch says, until Ctrl-C."""
    from nodes.recorder import RecorderConfig, RecorderNode
    from nodes.runtime.node import run_node
    from nodes.runtime.watching import find_run_dir, node_names

    folder = output if output.name else Path(f"bag-{time.strftime('%Y%m%d-%H%M%S')}")
    run = find_run_dir(run_dir)
    statuses = [] if topics else node_names(run)
    config = RecorderConfig(output=folder.resolve(), topics=topics, statuses_of=statuses)
    print(f"recording to {folder}, Ctrl-C ends it", flush=True)
    raise typer.Exit(run_node(lambda context: RecorderNode.build(config, context), "bag_record", run))


@app.command("play")
def bag_play(
    bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.", exists=True)],
    rate: Annotated[float, typer.Option("--rate", min=0.001, help="Speed relative to the recording.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    start_offset_s: Annotated[float, typer.Option("--start-offset", min=0.0, help="Leave out so many seconds.")] = 0.0,
    topics: Topics = None,
    wait_for: Annotated[
        list[str] | None,
        typer.Option("--wait-for", metavar="TOPIC", help="Wait for a subscriber of it.", show_default="any topic"),
    ] = None,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Begin at once, whether anybody listens or not.")] = False,
    run_dir: RunDir = None,
) -> None:
    """Play a bag to the nodes of a run folder; statuses and requests only when named by --topics."""
    from nodes.player import PlayerConfig, PlayerNode
    from nodes.runtime.node import run_node
    from nodes.runtime.watching import find_run_dir

    waiting = [] if no_wait else wait_for or None
    config = PlayerConfig(
        bag=bag, rate=rate, loop=loop, start_offset_s=start_offset_s, topics=topics or None, wait_for=waiting
    )  # fmt: skip
    if run_dir is not None:
        run_dir.mkdir(parents=True, exist_ok=True)
    run = find_run_dir(run_dir)
    raise typer.Exit(run_node(lambda context: PlayerNode.build(config, context), "bag_play", run))


@app.command("repair")
def bag_repair(bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.", exists=True)]) -> None:
    """Make the bag of a killed recorder whole, in place."""
    from nodes.runtime.bag_repair import repair

    result = repair(bag)
    if result.was_whole:
        print(f"{result.path} is whole: {result.messages} messages")
    else:
        print(f"{result.path}: kept {result.messages} messages, cut off {result.cut_bytes} bytes")
