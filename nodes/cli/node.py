"""The commands ``advnerf car node ...`` and ``advnerf car top``."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import RunDir, print_table, table

if TYPE_CHECKING:
    from nodes.launching.watching_nodes import NodeRow

app = typer.Typer(no_args_is_help=True, help="Inspect the nodes of a running launch.")


@app.command("list")
def node_list(run_dir: RunDir = None) -> None:
    """List the nodes with state and status text. A node that does not report is listed as silent."""
    from nodes.launching.watching import find_run_dir, node_statuses
    from nodes.launching.watching_nodes import SILENT, describe_silence

    run = find_run_dir(run_dir)
    rows = table("node", "state", "process", "text")
    statuses = node_statuses(run)
    _require_nodes(bool(statuses), run)
    for name, status in sorted(statuses.items()):
        if status is None:
            silence = describe_silence(run, name)
            rows.add_row(name, SILENT, str(silence.pid or "-"), silence.text)
        else:
            rows.add_row(name, str(status.state), str(status.pid), str(status.text))
    print_table(rows)


def top(
    period_s: Annotated[float, typer.Option("--period", min=0.5, help="Time between two tables [s].")] = 2.0,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this many tables.")] = None,
    run_dir: RunDir = None,
) -> None:
    """Show the load of each node: CPU, memory, rate, dropped messages, missed ticks, queue, restarts."""
    from nodes.launching.watching import find_run_dir

    with contextlib.suppress(KeyboardInterrupt):  # the user stops this command with Ctrl-C
        _watch(find_run_dir(run_dir), period_s, count)


def _watch(run_dir: Path, period_s: float, count: int | None) -> None:
    from nodes.launching.watching_nodes import NodeWatch

    shown = 0
    with NodeWatch(run_dir) as watch:
        while count is None or shown < count:
            found = watch.rows(period_s)
            _require_nodes(bool(found), run_dir)
            _print(found)
            shown += 1


def _require_nodes(found: bool, run: Path) -> None:
    """Refuse the folder of a run that has no node: an empty table says nothing."""
    if not found:
        from nodes.runtime.errors import LaunchError

        raise LaunchError(
            f"expected nodes of a launch in {run}, found none; start one with advnerf launch FILE, or correct --folder"
        )


def _print(found: list[NodeRow]) -> None:
    rows = table(
        "node", "state", "CPU %", "MiB", "rate Hz", "dropped", "missed", "queue drops", "restarts", "text"
    )
    for row in found:
        cpu = "-" if row.cpu_percent is None else f"{row.cpu_percent:.0f}"
        memory = "-" if row.memory_mib is None else f"{row.memory_mib:.0f}"
        numbers = (
            cpu,
            memory,
            f"{row.rate_hz:.0f}",
            *map(str, (row.dropped, row.missed, row.queue, row.restarts)),
        )
        rows.add_row(row.name, row.state, *numbers, row.text)
    print_table(rows)
