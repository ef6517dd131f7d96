"""The commands ``advnerf policy log ...``: drives that other cars and other software recorded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.cli.log_options import LogOptions, Logs, OneLog
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import coloured, print_table, table

if TYPE_CHECKING:
    from nodes.lab.policy_data.log_facts import LogFacts

app = CommandGroup(
    no_args_is_help=True,
    help="Read drives of other cars and other software: Donkeycar, Udacity, CSV, LeRobot, ROS.",
)


@app.command("info")
def log_info(logs: Logs, log_options: LogOptions) -> None:
    """Show what logs contain, and what they allow: learning a policy, learning a scene, evaluating a policy."""
    from nodes.lab.policy_data.log_facts import read_facts
    from nodes.lab.policy_data.logs import open_logs

    for request in logs:
        (opened,) = open_logs([request], log_options.choice())
        _print_facts(opened.name, read_facts(opened.log))


@app.command("export")
def log_export(
    log: OneLog,
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder of the data set.")],
    log_options: LogOptions,
    rate_hz: Annotated[
        int | None,
        typer.Option("--rate", min=1, help="Images per second.", show_default="the log's"),
    ] = None,
) -> None:
    """Write a log, for example a bag, as a LeRobot data set (version 3). Steering is in radians, left positive."""
    from advnerf_core.data.logs.lerobot_write import write_lerobot
    from nodes.lab.policy_data.logs import open_log
    from nodes.runtime.progress import ProgressDisplay

    found = open_log(log.path, log.choice(log_options.choice()))
    print("".join(f"note: {note}\n" for note in found.notes), end="")
    with ProgressDisplay() as display:
        report = display.start("export")
        done = write_lerobot(
            found, output, rate_hz, lambda count: report(count / max(found.count, 1), f"frame {count}")
        )
    print(
        f"{output}: {done.frames} frames in {done.episodes} episodes at {done.rate_hz} Hz; {done.left_out} images left out"
        + ("" if found.rate_hz else f"; the log has {found.rate_in_words}")
    )


def _print_facts(name: str, facts: LogFacts) -> None:
    log, (width, height) = facts.log, facts.size
    rows = table("", "")
    rows.add_row("format", log.format)
    rows.add_row("images", f"{log.count} of {width} x {height}, {log.rate_in_words}, {log.images}")
    if len(log.cameras) > 1:
        rows.add_row("cameras", ", ".join(log.cameras))
    rows.add_row("steering", "none" if log.unit is None else str(log.unit))
    if len(facts.steering):
        spread = f"{facts.steering.min():.3g} to {facts.steering.max():.3g}, standard deviation {facts.steering.std():.3g}"
        rows.add_row("", spread + (f", {facts.missing} missing" if facts.missing else ""))
    rows.add_row("poses", str(log.poses) if log.poses else "none")
    if left_out := ", ".join(f"{count} {why}" for why, count in log.left_out.items()):
        rows.add_row("left out", left_out)
    for note in log.notes:
        rows.add_row("note", note)
    if log.unchecked:
        rows.add_row("unchecked", log.unchecked)
    for verdict in facts.verdicts():
        answer = coloured("yes", "green") if verdict.possible else coloured("no", "red")
        rows.add_row(f"{verdict.use}?", answer + f": {verdict.why}")
    print(name)
    print_table(rows)
