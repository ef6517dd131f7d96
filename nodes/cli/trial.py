"""The commands ``advnerf car trial`` and ``advnerf bag evaluate``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.terminal import LaunchFile, Overrides, pose_of, print_table, table

if TYPE_CHECKING:
    from nodes.lab.trials.plan import PlannedDrive


def trial(
    file: LaunchFile,
    attack: Annotated[
        list[str] | None,
        typer.Option(metavar="CONDITION=FILE", help="Attack file of a condition. May be repeated."),
    ] = None,
    folder: Annotated[
        Path, typer.Option(help="Folder of plan, results and bags. The same folder resumes the trial.")
    ] = Path("runs/trials"),
    repeats: Annotated[int, typer.Option(min=1, help="Number of runs per condition.")] = 5,
    seed: Annotated[int, typer.Option(help="Random seed of the order of runs.")] = 0,
    ticks: Annotated[int, typer.Option(min=1, help="Control ticks per drive, at 10 Hz.")] = 60,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y,YAW", help="Start pose [m, rad].", show_default="the room's")
    ] = None,
    ready_timeout_s: Annotated[
        float,
        typer.Option("--ready-timeout", min=1.0, help="Time in which all nodes must be ready [s]."),
    ] = 60.0,
    host: Annotated[
        str | None,
        typer.Option(
            help="Host of the launch file that this computer is, or all. The other host must be running."
        ),
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="Only print the order of runs and which are done.")
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Drive the conditions none, random and gradient in balanced order from the same start. Resumes a stopped trial."""
    from advnerf_core.files import write_json
    from nodes.lab.trials.series import drive_series, prepare_series, summarise

    attacks = _attacks(attack or [])
    series = prepare_series(
        file,
        overrides or [],
        folder,
        attacks,
        repeats,
        seed,
        ticks,
        pose_of("--start", start, "-1.1,-2.0,0"),
        host,
    )
    count = len(series.plan.runs)
    if show:
        done = series.results
        for run in series.plan.runs:
            print(
                f"{run.number:3d}  {run.condition:12s} {run.attack_id or '-':14s} {'done' if run.name in done else ''}"
            )
    else:

        def begin(run: PlannedDrive) -> None:
            print(f"run {run.number} of {count}: {run.condition} {run.attack_id}".rstrip(), flush=True)

        drive_series(series, ready_timeout_s, begin, lambda text: print(f"  {text}", flush=True))
    results = list(series.results.values())
    if results:
        rows = summarise(results)
        _print_summary(rows)
        write_json(folder / "summary.json", rows)


def evaluate(
    bags: Annotated[
        list[Path], typer.Argument(help="Bag folders, or .mcap, .db3 or .bag files.", exists=True)
    ],
    room: Annotated[
        Path | None, typer.Option(help="Room file.", show_default="the one in the bag", exists=True)
    ] = None,
    ticks: Annotated[int, typer.Option(min=1, help="Number of control ticks to evaluate, at 10 Hz.")] = 60,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print everything as JSON, one line per drive.")
    ] = False,
) -> None:
    """Compute how far the car left its path in a bag, with the metrics of a trial."""
    from advnerf_core.errors import AdvnerfError
    from nodes.lab.trials.bags import evaluate_bag
    from nodes.runtime.errors import BagError

    rows = table(
        "bag",
        "attack",
        "total CTE [m]",
        "mean [m]",
        "max [m]",
        "off track",
        "left after",
        "attack adds",
        "stopped early",
        "checksums",
    )
    refused = list[Exception]()
    for bag in bags:
        try:
            drives = evaluate_bag(bag, room, ticks)
        except (AdvnerfError, OSError) as error:
            if len(bags) == 1:
                raise
            refused.append(error)
            continue
        for found in drives:
            if as_json:
                print(json.dumps(found))
                continue
            rows.add_row(
                str(bag),
                " ".join(found["attack_ids"]) or "none",
                *_totals(found),
                _added(found.get("counterfactual")),
                _stopped(found),
                "unchecked" if found["unchecked"] else "agree",
            )
    if not as_json and len(refused) < len(bags):
        print_table(rows)
    if refused:
        raise BagError(
            f"{len(refused)} of {len(bags)} bags were not evaluated: {'; '.join(map(str, refused))}"
        )


def _totals(found: dict[str, Any]) -> tuple[str, ...]:
    """Texts of the totals of a drive; dashes for one that does not count."""
    if not found["counts"]:
        return ("-",) * 5
    leaving = found["time_to_leave_s"]
    return (
        *(f"{found[name]:.3f}" for name in ("total_cte_m", "mean_abs_cte_m", "max_abs_cte_m")),
        "yes" if found["off_track"] else "no",
        "" if leaving is None else f"{leaving:.1f} s",
    )


def _stopped(found: dict[str, Any]) -> str:
    """Text with the end of a drive before the horizon's; empty if it was driven to the end."""
    if not (why := found["stopped_early"]):
        return ""
    return f"{'' if found['counts'] else 'no result: '}{why}, after {found['driven_ticks']} ticks"


def _added(compared: dict[str, Any] | None) -> str:
    """Text with the steering that the attack added [deg]; empty if the bag has no counterfactual."""
    if compared is None:
        return ""
    mean, largest = compared["mean_abs_delta_rad"], math.degrees(compared["max_abs_delta_rad"])
    seen = f"mean {math.degrees(mean):.2f}" if mean is not None else "attack never in view"
    return f"{seen}, max {largest:.2f} deg ({compared['frames_drawn']} of {compared['frames']} images)"


def _attacks(texts: list[str]) -> dict[str, list[Path]]:
    from nodes.lab.trials.plan import NONE, CampaignError
    from nodes.runtime.config import key_and_value

    attacks: dict[str, list[Path]] = {}
    for text in texts:
        condition, file = key_and_value(
            "--attack", text, "gradient=runs/g.safetensors", "CONDITION=FILE", needs_value=True
        )
        if not condition.replace("_", "").isalnum() or condition == NONE:
            raise CampaignError(
                f"--attack {text}: expected a condition of letters and digits other than {NONE}, got {condition!r}; name it"
                " as in gradient=runs/g.safetensors"
            )
        attacks.setdefault(condition, []).append(Path(file).resolve())
    return attacks


def _print_summary(summary: list[dict[str, Any]]) -> None:
    rows = table(
        "condition",
        "runs",
        "total CTE [m]",
        "ratio",
        "off track",
        "stopped early",
        "spoiled tries",
        "capture to serial p50",
        "checksums",
    )
    for row in summary:
        spread = "" if row["std_m"] is None else f" +- {row['std_m']:.3f}"
        rows.add_row(
            row["condition"],
            str(row["runs"]),
            f"{row['mean_m']:.3f}{spread}",
            "" if row["ratio"] is None else f"{row['ratio']:.2f}",
            f"{row['off_track']} of {row['runs']}",
            str(row["stopped_early"]),
            str(row["spoiled_tries"]),
            "" if row["latency_p50_ms"] is None else f"{row['latency_p50_ms']:.1f} ms",
            f"unchecked in {row['unchecked']}" if row["unchecked"] else "agree",
        )
    print_table(rows)
