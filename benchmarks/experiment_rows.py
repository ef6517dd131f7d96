"""Rows of the ledger that the full experiment answers: ``python -m benchmarks.experiment_rows runs/full``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import drives
from advnerf_core.report.data import ReportData
from advnerf_core.report.results import read_results
from advnerf_core.report.tables import TransferRow, find_row, transfer_rows
from benchmarks.results import record_row
from nodes.bags.parts import bag_parts

COMMAND = "make experiment"
Record = Callable[[str, float | str, str, str, bool | None, str], None]


def record_fidelity(data: ReportData, record: Record) -> None:
    assert data.fidelity is not None
    views = f"{len(data.fidelity.views)} held-out views of the driving camera"
    for name, key in (("336x188", "psnr_full_db"), ("200x66", "psnr_policy_db")):
        value = data.fidelity.mean(key)
        assert value is not None
        record(f"surrogate on held-out lab views, {name}", value, "dB PSNR", ">= 27 dB", value >= 27.0, views)
    difference = data.fidelity.steering_difference_rad
    assert difference is not None
    record(
        "surrogate on held-out lab views, steering",
        difference,
        "rad mean abs",
        "<= 0.03 rad",
        difference <= 0.03,
        views,
    )


def record_transfer(data: ReportData, record: Record) -> None:
    rows = transfer_rows(data)
    live = data.select(domain="deployed", condition="gradient", victim="hardened")
    off = sum(run.off_track for run in live)
    mean_abs = float(np.mean([run.mean_abs_cte_m for run in live]))
    gradient = _row(rows, "surrogate", "gradient")
    record(
        "total CTE, gradient, surrogate",
        gradient.ratio or 0.0,
        "x no attack",
        ">= 3.3 x",
        (gradient.ratio or 0.0) >= 3.3,
        _spread(gradient),
    )
    gradient = _row(rows, "deployed", "gradient")
    met = (gradient.ratio or 0.0) >= 3.0 and mean_abs >= 0.25 and off >= 2
    record(
        "total CTE, gradient, live green screen",
        gradient.ratio or 0.0,
        "x no attack",
        ">= 3.0 x, mean |CTE| >= 0.25 m, off-track in >= 2 of 3",
        met,
        f"mean |CTE| {mean_abs:.3f} m, off-track in {off} of {len(live)}; {_spread(gradient)}",
    )
    for domain in ("surrogate", "deployed"):
        random = _row(rows, domain, "random")
        met = (random.ratio or 0.0) <= 1.5 and (domain == "surrogate" or random.off_track == 0)
        target = "<= 1.5 x" + ("" if domain == "surrogate" else ", never off-track")
        plain = _row(rows, domain, "none")
        note = f"best of {data.settings.random_evaluations}; off-track in {random.off_track} of {random.runs}; {_spread(random)}"
        note += f"; no attack {plain.total_cte_mean_m:.2f} m"
        if not met:
            ticks = data.settings.horizon_steps
            more_mm = 1e3 * (random.total_cte_mean_m - plain.total_cte_mean_m) / ticks
            note += f": over {ticks} ticks the difference is {more_mm:.0f} mm a tick of a drive that is exact to {1e3 * plain.total_cte_mean_m / ticks:.0f} mm"
        record(f"total CTE, best random, {domain}", random.ratio or 0.0, "x no attack", target, met, note)


def record_live(data: ReportData, record: Record) -> None:
    if data.laps is not None:
        met = drives(data.laps.mean_abs_cte_m, data.laps.off_track, data.settings.off_track_m)
        record(
            "policy, no attack, laps live",
            data.laps.mean_abs_cte_m,
            "m mean |CTE|",
            "<= 0.08 m, never off-track",
            met,
            f"{data.laps.laps} laps, off-track: {data.laps.off_track}, worst {np.abs(data.laps.cte_m).max():.3f} m",
        )
    assert data.latency is not None
    overall = data.latency.overall
    met = overall.p99_ms <= data.latency.camera_period_ms and data.latency.missed_ticks == 0
    record(
        "capture to serial write, live",
        overall.p99_ms,
        "ms p99",
        "<= 100 ms, no tick missed",
        met,
        f"{overall.count} frames, p50 {overall.p50_ms:.1f} ms, worst {overall.max_ms:.1f} ms, {data.latency.missed_ticks} ticks missed",
    )


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


def _row(rows: tuple[TransferRow, ...], domain: str, condition: str) -> TransferRow:
    row = find_row(rows, domain, condition)  # type: ignore[arg-type]
    if row is None:
        raise SystemExit(
            f"expected {domain} {condition} runs in the report, got none: run make experiment to its end"
        )
    return row


def _spread(row: TransferRow) -> str:
    return f"{row.runs} runs, total CTE {row.total_cte_mean_m:.1f} +- {row.total_cte_std_m or 0.0:.1f} m"


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
    data = read_results(folder / "report" / "results.json")
    if data.settings.name != "full":
        raise SystemExit(
            f"expected a run of the full setting in {folder}, got {data.settings.name}: use make experiment"
        )

    def record(line: str, value: float | str, unit: str, target: str, met: bool | None, note: str) -> None:
        record_row(
            line, value, unit, target, met, arguments.command, "; ".join(filter(None, (note, arguments.note)))
        )
        print(
            f"{line}: {value if isinstance(value, str) else f'{value:.4g}'} {unit} (target {target}): {met}"
        )

    record_fidelity(data, record)
    record_transfer(data, record)
    record_live(data, record)
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
