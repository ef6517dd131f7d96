"""The command ``advnerf car top``."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import RunDir, print_table, table

if TYPE_CHECKING:
    from nodes.launching.watching_nodes import NodeRow


def top(
    period_s: Annotated[float, typer.Option("--period", min=0.5, help="Time between two tables [s].")] = 2.0,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this many tables.")] = None,
    run_dir: RunDir = None,
) -> None:
    """Show each node again and again: state and status text, process, CPU, memory, rate, dropped messages, missed ticks, queue, restarts.

    A node that does not report is listed as silent.
    """
    from nodes.launching.watching import find_run_dir
    from nodes.launching.watching_nodes import NodeWatch
    from nodes.runtime.errors import LaunchError

    run, shown = find_run_dir(run_dir), 0
    # The user stops this command with Ctrl-C.
    with contextlib.suppress(KeyboardInterrupt), NodeWatch(run) as watch:
        while count is None or shown < count:
            found = watch.rows(period_s)
            if not found:  # an empty table says nothing
                raise LaunchError(
                    f"expected nodes of a launch in {run}, found none; start one with advnerf launch FILE, or correct --folder"
                )
            _print(found)
            shown += 1


def _print(found: list[NodeRow]) -> None:
    rows = table(
        "node",
        "state",
        "process",
        "CPU %",
        "MiB",
        "rate Hz",
        "dropped",
        "missed",
        "queue drops",
        "restarts",
        "text",
    )
    for row in found:
        cpu = "-" if row.cpu_percent is None else f"{row.cpu_percent:.0f}"
        memory = "-" if row.memory_mib is None else f"{row.memory_mib:.0f}"
        numbers = (
            str(row.pid or "-"),
            cpu,
            memory,
            f"{row.rate_hz:.0f}",
            *map(str, (row.dropped, row.missed, row.queue, row.restarts)),
        )
        rows.add_row(row.name, row.state, *numbers, row.text)
    print_table(rows)
