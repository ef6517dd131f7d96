"""The commands ``advnerf bag ...``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.cli.replay import replay
from nodes.cli.trial import evaluate
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import FAILURE_EXIT, RunDir, Topics, fail_unless, print_table, say_error, table

if TYPE_CHECKING:
    from nodes.bags.info import BagInfo
    from nodes.bags.repair import Repaired

_DAMAGED_EXIT = 2  # as for every bag that cannot be read

app = CommandGroup(
    no_args_is_help=True,
    help="Record, inspect, play, replay, evaluate and repair bags (MCAP, as rosbag2 writes them).",
)
app.command("replay")(replay)
app.command("evaluate")(evaluate)


@app.command("info")
def bag_info(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    stamps: Annotated[
        bool, typer.Option("--stamps", help="Also read every message and show how late they arrived.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Trust the summary. Do not read the bag to verify its checksums.")
    ] = False,
) -> None:
    """Show what a bag contains, how many messages were lost during recording, and whether its checksums match."""
    from datetime import datetime

    from nodes.bags.check import diagnose
    from nodes.bags.parts import bag_parts, unread_files
    from nodes.bags.reader import read_info
    from nodes.bags.time_gaps import SET_BACK, read_gaps, read_steps_back, silence_s

    if not quick:
        for part in bag_parts(bag):
            if lines := diagnose(part):
                for line in lines[:-1]:
                    print(f"{part}: {line}")
                say_error(f"{part} is damaged; {lines[-1]}")
                raise typer.Exit(_DAMAGED_EXIT)
    info, gaps = read_info(bag), read_gaps(bag)
    span_s = info.duration_s - silence_s(gaps)
    start = datetime.fromtimestamp(info.start_ns / 1e9).isoformat(" ", "milliseconds")
    files = f" in {len(info.parts)} files" if len(info.parts) > 1 else ""
    print(
        f"{info.path}: {info.size_bytes / 1e6:.1f} MB{files}, {info.messages} messages in {span_s:.2f} s from {start}"
    )
    for gap in gaps:
        print(f"{gap}: the recorder's clock was set; replay, play and evaluate skip this time")
    for step in read_steps_back(bag):
        print(f"{step}: {SET_BACK}")
    if unread := unread_files(bag):
        print(unread)
    for key, value in info.metadata.items():
        print(f"{key}: {value}")
    print(f"attachments: {', '.join(info.attachments) or 'none'}")
    print(checked_line(info, quick))
    rows = table("topic", "type", "messages", "rate", "lost")
    for topic in info.topics:
        rate = f"{(topic.count - 1) / span_s:.1f} Hz" if topic.count > 1 and span_s > 0 else ""
        rows.add_row(
            topic.name, topic.type, str(topic.count), rate, "?" if topic.lost is None else str(topic.lost)
        )
    print_table(rows)
    if stamps:
        _print_delays(bag)


def checked_line(info: BagInfo, quick: bool) -> str:
    """Text that says whether the messages match the checksums of the recording."""
    if info.unchecked:
        return f"unchecked: {info.unchecked}, so damaged messages cannot be detected"
    return "checksums not verified (--quick)" if quick else "checked: all messages match their checksums"


def _print_delays(bag: Path) -> None:
    from nodes.bags.stamps import read_delays

    rows = table(
        "topic",
        "capture to publish [ms]",
        "worst",
        "to reception [ms]",
        "worst",
        "stamps that go back",
        "in future",
    )
    for topic, delays in sorted(read_delays(bag).items()):
        times = delays.publish_ms, delays.publish_worst_ms, delays.receive_ms, delays.receive_worst_ms
        counts = delays.backwards, delays.future
        rows.add_row(
            topic,
            *("-" if value is None else f"{value:.1f}" for value in times),
            *("-" if count is None else str(count) for count in counts),
        )
    print_table(rows)


@app.command("extract")
def bag_extract(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    names: Annotated[
        list[str] | None, typer.Argument(help="Attachments to extract.", show_default="all")
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the extracted files.")] = Path(),
) -> None:
    """Extract the attachments of a bag: the launch file of the run, the calibration and the attack."""
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
            "--max-bag-duration",
            metavar="S",
            min=0.1,
            help="Start a new file after this many seconds.",
            show_default="600",
        ),
    ] = None,
    max_bag_size_mb: Annotated[
        float | None,
        typer.Option(
            "--max-bag-size",
            metavar="MIB",
            min=0.1,
            help="Start a new file after this many MiB.",
            show_default="256",
        ),
    ] = None,
    run_dir: RunDir = None,
) -> None:
    """Record the topics of a running launch until Ctrl-C."""
    from nodes.bags.reader import read_info
    from nodes.launching.watching import find_run_dir, node_names
    from nodes.recorder import RecorderConfig, RecorderNode
    from nodes.runtime.paths import require_new
    from nodes.runtime.process import run_node

    folder = output if output.name else Path(f"bag-{time.strftime('%Y%m%d-%H%M%S')}")
    require_new(folder)
    run = find_run_dir(run_dir)
    statuses = [] if topics else node_names(run)
    config = RecorderConfig(output=folder.resolve(), topics=topics, statuses_of=statuses)
    limits = {"max_bag_duration_s": max_bag_duration_s, "max_bag_size_mb": max_bag_size_mb}
    config = config.model_copy(update={key: value for key, value in limits.items() if value is not None})
    print(f"recording to {folder}; press Ctrl-C to stop", flush=True)
    code = run_node(lambda context: RecorderNode.build(config, context), "bag_record", run)
    if code == 0 and read_info(folder).messages == 0:
        say_error(f"recorded 0 messages in {folder}: no node has published a topic to record")
        code = FAILURE_EXIT
    raise typer.Exit(code)


@app.command("play")
def bag_play(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    rate: Annotated[
        float, typer.Option(min=0.001, max=1000.0, help="Speed relative to the recording.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start over at the end.")] = False,
    offset_s: Annotated[
        float,
        typer.Option("--offset", "--start-offset", min=0.0, help="Skip this many seconds at the start."),
    ] = 0.0,
    duration_s: Annotated[
        float | None, typer.Option("--duration", min=0.001, help="Play this many seconds of the recording.")
    ] = None,
    topics: Topics = None,
    remap: Annotated[
        list[str] | None,
        typer.Option(metavar="OLD:=NEW", help="Play a topic under another name. May be repeated."),
    ] = None,
    paused: Annotated[bool, typer.Option("--paused", help="Start paused.")] = False,
    clock_hz: Annotated[
        float | None,
        typer.Option(
            "--clock", metavar="HZ", min=0.1, max=200.0, help="Publish the recorded time on /clock."
        ),
    ] = None,
    wait_for: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TOPIC", help="Wait until this topic has a subscriber.", show_default="any topic"
        ),
    ] = None,
    no_wait: Annotated[
        bool, typer.Option("--no-wait", help="Start at once, with or without subscribers.")
    ] = False,
    run_dir: RunDir = None,
) -> None:
    """Play a bag to the nodes of a run folder. What moves or arms a car is never played.

    Keys in the terminal: space pauses and resumes, right arrow or s steps, + and - change the speed, q quits.
    From another terminal: advnerf bag control pause|resume|toggle|step [N]|rate X|stop.
    """
    import shutil
    import sys

    from nodes.bags.keys import HELP
    from nodes.launching.watching import find_run_dir
    from nodes.player import PlayerConfig, PlayerNode
    from nodes.runtime.process import WRONG_REQUEST, run_node

    waiting = [] if no_wait else wait_for or None
    config = PlayerConfig(
        bag=bag,
        rate=rate,
        loop=loop,
        start_offset_s=offset_s,
        duration_s=duration_s,
        topics=topics or None,
        remap=_pairs(remap or []),
        paused=paused,
        clock_hz=clock_hz,
        wait_for=waiting,
    )
    is_new = run_dir is not None and not run_dir.exists()
    if run_dir is not None:
        run_dir.mkdir(parents=True, exist_ok=True)
    run = run_dir or find_run_dir(None)
    terminal = sys.stdin.fileno() if sys.stdin.isatty() else None
    if terminal is not None:
        print(HELP, flush=True)
    code = run_node(lambda context: PlayerNode(config, context.subscribers, terminal), "bag_play", run)
    if code == WRONG_REQUEST and is_new:
        shutil.rmtree(run, ignore_errors=True)
    raise typer.Exit(code)


def _pairs(texts: list[str]) -> dict[str, str]:
    from nodes.runtime.config import key_and_value
    from nodes.runtime.errors import BagError

    pairs: dict[str, str] = {}
    for text in texts:
        example = "/camera/image_raw:=/compositor/image"
        old, new = key_and_value("--remap", text, example, "OLD:=NEW", ":=", needs_value=True)
        if old in pairs:
            raise BagError(
                f"--remap {text}: expected one new name per topic; {old} is already remapped to {pairs[old]}. Remove one of the two"
            )
        pairs[old] = new
    return pairs


@app.command("control")
def bag_control(
    words: Annotated[list[str], typer.Argument(help="pause, resume, toggle, step [N], rate X, or stop.")],
    run_dir: RunDir = None,
) -> None:
    """Control a running player: pause, resume, step, change the speed, or stop."""
    from nodes.bags.play import PlayerCommand
    from nodes.bags.player_requests import ask_player
    from nodes.launching.watching import find_run_dir

    text = " ".join(words)
    PlayerCommand.parse(text)
    granted, answer = ask_player(find_run_dir(run_dir), text)
    print(answer if granted else f"not done: {answer}")
    fail_unless(granted)


@app.command("repair")
def bag_repair(
    bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.", exists=True)],
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Repair even if this loses messages that are not at the end of an unfinished file.",
        ),
    ] = False,
    discard_original: Annotated[
        bool, typer.Option("--discard-original", help="Do not keep the damaged file as NAME.mcap.damaged.")
    ] = False,
) -> None:
    """Repair a damaged bag, or the bag of a recorder that was killed. The damaged file is kept next to the repaired one."""
    from nodes.bags.repair_parts import repair_bag

    for result in repair_bag(bag, force, not discard_original):
        _print_repair(result)


def _print_repair(result: Repaired) -> None:
    unchecked = f"; unchecked: {result.unchecked}" if result.unchecked else ""
    if result.was_whole:
        print(f"{result.path} is intact: {result.messages} messages{unchecked}; nothing was changed")
        return
    for loss in result.losses:
        print(f"lost: {loss}")
    for fix in result.fixes:
        print(f"repaired: {fix}")
    rows = table("topic", "messages before", "after")
    for topic in result.topics:
        rows.add_row(topic.name, "?" if topic.before is None else str(topic.before), str(topic.after))
    print_table(rows)
    print(f"{result.path}: kept {result.messages} messages, left out {result.cut_bytes} bytes{unchecked}")
    print("the damaged file was not kept" if result.kept is None else f"damaged file: {result.kept}")
