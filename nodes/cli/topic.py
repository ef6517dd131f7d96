"""The commands ``advnerf car topic ...``."""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import RunDir, print_table, table

TopicName = Annotated[str, typer.Argument(help="Name of the topic, such as /vicon/car.")]

app = CommandGroup(no_args_is_help=True, help="Inspect the topics of a running launch.")


@app.command("list")
def topic_list(run_dir: RunDir = None) -> None:
    """List all topics with type, rate, publisher and number of subscribers."""
    from nodes.launching.watching import find_run_dir, list_topics
    from nodes.runtime.topics import topic

    rows = table("topic", "type", "rate", "publisher", "subscribers")
    for row in list_topics(find_run_dir(run_dir)):
        rate_hz = topic(row.name).rate_hz
        rows.add_row(
            row.name,
            row.type,
            f"{rate_hz:g} Hz" if rate_hz else "",
            row.publisher or "-",
            str(row.subscribers),
        )
    print_table(rows)


@app.command("hz")
def topic_hz(
    topic: TopicName,
    duration_s: Annotated[float, typer.Option("--duration", min=0.1, help="Time to listen [s].")] = 5.0,
    run_dir: RunDir = None,
) -> None:
    """Measure a topic: rate, gaps, lost messages, and its delays from capture to publication and to reception."""
    from nodes.launching.watching import find_run_dir, measure_rate

    report = measure_rate(find_run_dir(run_dir), topic, duration_s)
    print(f"{topic}: {report.rate_hz:.2f} Hz, {report.messages} messages, {report.lost} lost")
    print(f"gaps: {report.shortest_s * 1e3:.1f} to {report.longest_s * 1e3:.1f} ms")
    rows = table("way", "median", "99 %", "worst")
    for name in ("capture_to_publish", "publish_to_receive", "capture_to_receive"):
        if (delay := getattr(report, name)) is not None:
            times = (delay.median_s, delay.p99_s, delay.worst_s)
            rows.add_row(name.replace("_", " "), *(f"{value * 1e3:.2f} ms" for value in times))
    print_table(rows)


@app.command("echo")
def topic_echo(
    topic: TopicName,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this many messages.")] = None,
    duration_s: Annotated[
        float | None, typer.Option("--duration", min=0.1, help="Stop after this many seconds.")
    ] = None,
    run_dir: RunDir = None,
) -> None:
    """Print the messages of a topic."""
    from nodes.launching.watching import describe, find_run_dir, listen

    with contextlib.suppress(KeyboardInterrupt):  # the user stops this command with Ctrl-C
        for shown, received in enumerate(listen(find_run_dir(run_dir), topic, duration_s), start=1):
            print(f"{describe(received.message())}\n---", flush=True)
            if count is not None and shown >= count:
                return
