"""Rows of the ledger that the full experiment answers: ``python -m benchmarks.experiment_rows runs/full``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from advnerf_core.documents import read_json
from benchmarks.results import record_row
from nodes.bags.parts import bag_parts

COMMAND = "make experiment"
Record = Callable[[str, float | str, str, str, bool | None, str], None]


def record_targets(report: dict[str, Any], record: Record) -> None:
    """One row for each target of the report that was measured."""
    drives = ", ".join(f"{row['method']} {row['domain']} {row['drives']}" for row in report["rows"])
    for target in report["targets"]:
        if target["value"] is not None:
            unit = target["measured"].partition(" ")[2]
            limit = target["target"].replace("≥", ">=").replace("≤", "<=")
            record(target["what"], target["value"], unit, limit, target["met"], f"drives: {drives}")


def record_bags(folder: Path, record: Record) -> None:
    """Open every bag of the run with two independent readers and decode every message."""
    bags = sorted(path for part in ("cells", "live") for path in (folder / part).glob("**/bag"))
    topics: set[str] = set()
    messages = 0
    for bag in bags:
        counted: list[str] = []
        for part in bag_parts(bag):
            with part.open("rb") as stream:
                decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
                counted += [channel.topic for _, channel, _, message in decoded if message is not None]
        with AnyReader([bag]) as other:
            decoded_again = [
                connection.topic
                for connection, _, raw in other.messages()
                if other.deserialize(raw, connection.msgtype) is not None
            ]
        if len(counted) != len(decoded_again):
            record(
                "the bag",
                len(counted),
                "messages",
                "every topic decodes in both",
                False,
                f"{bag}: {len(decoded_again)}",
            )
            return
        topics |= set(counted)
        messages += len(counted)
    note = f"{len(bags)} bags, {len(topics)} topics; mcap with mcap-ros2-support and rosbags decode the same messages"
    record("the bag", messages, "messages", "every topic decodes in both", bool(bags), note)


def main() -> None:
    """Read a finished full run and record its rows."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--command", default=COMMAND, help="the command that made the run")
    parser.add_argument(
        "--note", default="", help="what readers must know, such as a smaller number of seeds"
    )
    parser.add_argument("--wall-s", type=float, help="how long the command took [s]")
    arguments = parser.parse_args()
    folder = arguments.run_folder
    setting = read_json(folder / "manifest.json")["setting"]
    if setting != "full":
        raise SystemExit(
            f"expected a run of the full setting in {folder}, got {setting}: use make experiment"
        )

    def record(line: str, value: float | str, unit: str, target: str, met: bool | None, note: str) -> None:
        record_row(
            line, value, unit, target, met, arguments.command, "; ".join(filter(None, (note, arguments.note)))
        )
        print(
            f"{line}: {value if isinstance(value, str) else f'{value:.4g}'} {unit} (target {target}): {met}"
        )

    record_targets(read_json(folder / "report" / "table.json"), record)
    record_bags(folder, record)
    if arguments.wall_s is not None:
        record_time(folder, record, arguments.wall_s)


def record_time(folder: Path, record: Record, wall_s: float) -> None:
    """Minutes of a run that made everything; nothing if stages of it were there before."""
    stages = sorted(folder.glob("*/stage.json"))
    seconds = {path.parent.name: read_json(path)["seconds"] for path in stages}
    if wall_s < sum(seconds.values()):
        print(f"make experiment: no row for its time, as stages in {folder} were there before")
        return
    cells = len(list((folder / "cells").glob("*.json")))
    note = f"{len(stages)} stages in {sum(seconds.values()) / 60:.1f} min, and {cells} cells"
    record("make experiment", wall_s / 60, "min", "<= 30 min", wall_s <= 1800, note)


if __name__ == "__main__":
    main()
