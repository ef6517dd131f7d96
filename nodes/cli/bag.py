"""The commands ``advnerf bag ...``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import RunDir, Topics, print_table, say_error, table

if TYPE_CHECKING:
    from nodes.bags.reader import BagInfo
    from nodes.bags.repair import Repaired

_DAMAGED_EXIT = 2  # as for every bag that cannot be read

app = typer.Typer(no_args_is_help=True, help="Record, look into, play and repair bags (MCAP, as rosbag2 writes them).")


@app.command("info")
def bag_info(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    stamps: Annotated[
        bool, typer.Option("--stamps", help="Also read every message and say how late they came.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Believe the summary; do not read the bag to compare it with its checksums.")
    ] = False,
) -> None:
    """Say what is in a bag, what was lost on the way into it, and whether it is as it was recorded."""
    from datetime import datetime

    from nodes.bags.check import diagnose
    from nodes.bags.parts import bag_parts
    from nodes.bags.reader import read_info

    if not quick:
        for found in map(diagnose, bag_parts(bag)):
            if not found.whole:
                for line in found.lines[:-1]:
                    print(f"{found.path}: {line}")
                say_error(f"{found.path} is not whole; {found.lines[-1]}")
                raise typer.Exit(_DAMAGED_EXIT)
    info = read_info(bag)
    start = datetime.fromtimestamp(info.start_ns / 1e9).isoformat(" ", "milliseconds")
    files = f" in {len(info.parts)} files" if len(info.parts) > 1 else ""
    print(
        f"{info.path}: {info.size_bytes / 1e6:.1f} MB{files}, {info.messages} messages in {info.duration_s:.2f} s from {start}"
    )
    for key, value in info.metadata.items():
        print(f"{key}: {value}")
    print(f"attachments: {', '.join(info.attachments) or 'none'}")
    print(checked_line(info, quick))
    rows = table("topic", "type", "messages", "rate", "lost")
    for topic in info.topics:
        rate = f"{(topic.count - 1) / info.duration_s:.1f} Hz" if topic.count > 1 and info.duration_s > 0 else ""
        rows.add_row(topic.name, topic.type, str(topic.count), rate, "?" if topic.lost is None else str(topic.lost))
    print_table(rows)
    if stamps:
        _print_delays(bag)


def checked_line(info: BagInfo, quick: bool) -> str:
    """Whether the messages are those that were recorded, as far as can be told."""
    if info.unchecked:
        return f"unchecked: {info.unchecked}, so a damaged message in it cannot be told from a good one"
    return "not compared with its checksums (--quick)" if quick else "checked: all messages agree with their checksums"


def _print_delays(bag: Path) -> None:
    from nodes.bags.stamps import read_delays

    rows = table(
        "topic", "capture to publish [ms]", "worst", "to reception [ms]", "worst", "stamps that go back", "in future"
    )
    for topic, delays in sorted(read_delays(bag).items()):
        published, worst = (
            "-" if value is None else f"{value:.1f}" for value in (delays.publish_ms, delays.publish_worst_ms)
        )
        received = f"{delays.receive_ms:.1f}", f"{delays.receive_worst_ms:.1f}"
        rows.add_row(topic, published, worst, *received, str(delays.backwards), str(delays.future))
    print_table(rows)


@app.command("extract")
def bag_extract(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    names: Annotated[list[str] | None, typer.Argument(help="Attachments to take out.", show_default="all")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to put them in.")] = Path(),
) -> None:
    """Take out the files that ride along in a bag: the launch file as it was run, calibration, the attack."""
    from nodes.bags.reader import extract_attachments

    for path in extract_attachments(bag, output, names or ()):
        print(path)


@app.command("record")
def bag_record(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="New folder for the bag.", show_default="bag-<time>")
    ] = Path(""),
    topics: Topics = None,
    max_bag_duration_s: Annotated[
        float | None,
        typer.Option(
            "--max-bag-duration", metavar="S", min=0.1, help="New file after so many seconds.", show_default="600"
        ),
    ] = None,
    max_bag_size_mb: Annotated[
        float | None,
        typer.Option("--max-bag-size", metavar="MIB", min=0.1, help="New file after so many MiB.", show_default="256"),
    ] = None,
    run_dir: RunDir = None,
) -> None:
    """Record what a running launch says, until Ctrl-C."""
    from nodes.launching.watching import find_run_dir, node_names
    from nodes.recorder import RecorderConfig, RecorderNode
    from nodes.runtime.process import run_node

    folder = output if output.name else Path(f"bag-{time.strftime('%Y%m%d-%H%M%S')}")
    run = find_run_dir(run_dir)
    statuses = [] if topics else node_names(run)
    config = RecorderConfig(output=folder.resolve(), topics=topics, statuses_of=statuses)
    limits = {"max_bag_duration_s": max_bag_duration_s, "max_bag_size_mb": max_bag_size_mb}
    config = config.model_copy(update={key: value for key, value in limits.items() if value is not None})
    print(f"recording to {folder}, Ctrl-C ends it", flush=True)
    raise typer.Exit(run_node(lambda context: RecorderNode.build(config, context), "bag_record", run))


@app.command("play")
def bag_play(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    rate: Annotated[float, typer.Option("--rate", min=0.001, help="Speed relative to the recording.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    offset_s: Annotated[
        float, typer.Option("--offset", "--start-offset", min=0.0, help="Leave out so many seconds.")
    ] = 0.0,
    duration_s: Annotated[
        float | None, typer.Option("--duration", min=0.001, help="Play so many seconds of the recording.")
    ] = None,
    topics: Topics = None,
    remap: Annotated[
        list[str] | None,
        typer.Option("--remap", metavar="OLD:=NEW", help="Play a topic under another name; may be repeated."),
    ] = None,
    paused: Annotated[bool, typer.Option("--paused", help="Begin standing still.")] = False,
    clock_hz: Annotated[
        float | None, typer.Option("--clock", metavar="HZ", min=0.1, max=200.0, help="Say the recorded time on /clock.")
    ] = None,
    wait_for: Annotated[
        list[str] | None,
        typer.Option("--wait-for", metavar="TOPIC", help="Wait for a subscriber of it.", show_default="any topic"),
    ] = None,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Begin at once, whether anybody listens or not.")] = False,
    run_dir: RunDir = None,
) -> None:
    """Play a bag to the nodes of a run folder; statuses and requests only when named by --topics.

    In a terminal: space pauses and goes on, right arrow or s steps, + and - change the speed, q ends.
    From elsewhere: advnerf bag control pause|resume|toggle|step [N]|rate X|stop.
    """
    import sys

    from nodes.bags.keys import HELP
    from nodes.launching.watching import find_run_dir
    from nodes.player import PlayerConfig, PlayerNode
    from nodes.runtime.process import run_node

    waiting = [] if no_wait else wait_for or None
    config = PlayerConfig(
        bag=bag, rate=rate, loop=loop, start_offset_s=offset_s, duration_s=duration_s, topics=topics or None,
        remap=_pairs(remap or []), paused=paused, clock_hz=clock_hz, wait_for=waiting,
    )  # fmt: skip
    if run_dir is not None:
        run_dir.mkdir(parents=True, exist_ok=True)
    run = find_run_dir(run_dir)
    terminal = sys.stdin.fileno() if sys.stdin.isatty() else None
    if terminal is not None:
        print(HELP, flush=True)
    raise typer.Exit(run_node(lambda context: PlayerNode(config, context.subscribers, terminal), "bag_play", run))


def _pairs(texts: list[str]) -> dict[str, str]:
    from nodes.runtime.errors import BagError

    pairs: dict[str, str] = {}
    for text in texts:
        old, separator, new = text.partition(":=")
        if not separator or not old or not new:
            raise BagError(f"--remap {text}: expected OLD:=NEW, e.g. /camera/image_raw:=/compositor/image")
        if old in pairs:
            raise BagError(f"--remap {text}: {old} has another name already, {pairs[old]}")
        pairs[old] = new
    return pairs


@app.command("control")
def bag_control(
    words: Annotated[list[str], typer.Argument(help="pause, resume, toggle, step [N], rate X, or stop.")],
    run_dir: RunDir = None,
) -> None:
    """Tell a player that is at work to pause, go on, step, change its speed, or end."""
    from nodes.bags.play import Command
    from nodes.bags.player_requests import ask_player
    from nodes.launching.watching import find_run_dir

    text = " ".join(words)
    Command.parse(text)
    granted, answer = ask_player(find_run_dir(run_dir), text)
    print(answer if granted else f"not done: {answer}")
    if not granted:
        raise typer.Exit(1)


@app.command("repair")
def bag_repair(
    bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.", exists=True)],
    force: Annotated[
        bool, typer.Option("--force", help="Also if messages are lost that are not at the end of an unfinished file.")
    ] = False,
    discard_original: Annotated[
        bool, typer.Option("--discard-original", help="Do not keep the file as it was, as NAME.mcap.damaged.")
    ] = False,
) -> None:
    """Make the bag of a killed recorder, or a damaged one, whole; the file as it was is kept beside it."""
    from nodes.bags.repair_parts import repair_bag

    for result in repair_bag(bag, force, not discard_original):
        _print_repair(result)


def _print_repair(result: Repaired) -> None:
    unchecked = f"; unchecked: {result.unchecked}" if result.unchecked else ""
    if result.was_whole:
        print(f"{result.path} is whole: {result.messages} messages{unchecked}; nothing was changed")
        return
    for loss in result.losses:
        print(f"lost: {loss}")
    for fix in result.fixes:
        print(f"mended: {fix}")
    rows = table("topic", "messages before", "after")
    for topic in result.topics:
        rows.add_row(topic.name, "?" if topic.before is None else str(topic.before), str(topic.after))
    print_table(rows)
    print(f"{result.path}: kept {result.messages} messages, left out {result.cut_bytes} bytes{unchecked}")
    print("the file as it was is gone" if result.kept is None else f"the file as it was: {result.kept}")
