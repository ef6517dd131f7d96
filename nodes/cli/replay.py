"""The command ``advnerf bag replay``."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import FAILURE_EXIT, Overrides, Topics, print_table, say_error, table

if TYPE_CHECKING:
    from nodes.replaying.attack import RetroAttack
    from nodes.replaying.nodes import Choice
    from nodes.replaying.replay import Replay

_DEG = 57.29577951308232
_RETRO_NODES = "compositor,policy"


def replay(
    bag: Annotated[Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True)],
    nodes: Annotated[
        str, typer.Option(metavar="NAME,...", help="Nodes of the recorded launch to run, comma-separated.")
    ] = "",
    replace: Annotated[
        list[str] | None,
        typer.Option(metavar="NODE=MODULE[:CLASS]", help="Run a node with other code. May be repeated."),
    ] = None,
    launch: Annotated[
        Path | None, typer.Option(help="Launch file to use instead of the one in the bag.", exists=True)
    ] = None,
    overrides: Overrides = None,
    attack: Annotated[
        Path | None, typer.Option(help="Attack file to apply to the recording.", exists=True, dir_okay=False)
    ] = None,
    policy: Annotated[str, typer.Option(help="Policy to use instead of the recorded one.")] = "",
    golden: Annotated[Path | None, typer.Option(help="Golden bag (.mcap) to compare with.")] = None,
    update_golden: Annotated[
        bool, typer.Option("--update-golden", help="Write the golden bag instead of comparing with it.")
    ] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="[TOPIC:FIELD=]VALUE", help="Allow differences up to VALUE. May be repeated."),
    ] = None,
    topics: Topics = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the replay to a new bag.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="With --attack: write the result as JSON.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="With --attack: plot the steering (.png).")] = None,
) -> None:
    """Replay a bag through nodes in lockstep. The same bag gives the same bytes. With --attack, compare the steering."""
    from advnerf_core.files import refuse_overwriting
    from nodes.runtime.errors import BagError

    if attack is None and (json_file or plot):
        raise BagError("expected --json and --plot only with --attack FILE; add --attack or remove them")
    if update_golden and golden is None:
        raise BagError(
            "expected --golden FILE.mcap with --update-golden, got none; name the golden bag to write"
        )
    if [golden is not None, output is not None, attack is not None].count(True) > 1:
        raise BagError(
            "expected one of --golden, --output and --attack, got several; run the replay once for each"
        )
    if (topics or tolerance) and golden is None:
        raise BagError(
            "expected --topics and --tolerance only with --golden FILE; add --golden or remove them"
        )
    written = (json_file, plot, golden if update_golden else None)
    refuse_overwriting(
        (bag, launch, attack, Path(policy) if policy else None),
        [each for each in written if each is not None],
    )
    choice = _choice(
        nodes or (_RETRO_NODES if attack else ""), replace or [], launch, policy, overrides or []
    )
    if attack is not None:
        _retro(bag, attack, choice, json_file, plot)
    elif golden is not None:
        _against(bag, choice, golden, update_golden, tolerance or [], topics)
    else:
        _plain(bag, choice, output)


def _choice(nodes: str, replace: list[str], launch: Path | None, policy: str, overrides: list[str]) -> Choice:
    from nodes.replaying.nodes import Choice
    from nodes.runtime.config import key_and_value
    from nodes.runtime.errors import BagError

    names = tuple(dict.fromkeys(name.strip() for name in nodes.split(",") if name.strip()))
    replacements = {}
    for text in replace:
        name, module = key_and_value(
            "--replace", text, "policy=my_policy:Node", "NODE=MODULE or NODE=MODULE:CLASS", needs_value=True
        )
        replacements[name] = module.strip()
    if policy:
        if "policy" not in names:
            raise BagError(
                f"expected the node policy among --nodes, because --policy is given; got {', '.join(names) or 'none'}. Add it"
            )
        # The recorded node may be one that knows no policies; the recorded hash belongs to the recorded policy.
        replacements.setdefault("policy", "nodes.policy")
        overrides = [f"policy.policy={json.dumps(policy)}", 'policy.sha256=""', *overrides]
    return Choice(names, replacements, launch, tuple(overrides))


def _plain(bag: Path, choice: Choice, output: Path | None) -> None:
    from nodes.replaying.replay import Replay, write_replay

    with Replay(bag, choice, whole=output is not None) as run:
        start = time.perf_counter()
        if output is not None:
            write_replay(run, output)
        else:
            for _ in run:
                pass
        _say(run, time.perf_counter() - start)
    if output is not None:
        left_out = f", without {', '.join(run.left_out)} (not in the topic table)" if run.left_out else ""
        print(f"wrote {output}{left_out}")


def _against(
    bag: Path, choice: Choice, golden: Path, update: bool, tolerance: list[str], topics: list[str] | None
) -> None:
    from nodes.replaying.golden import Golden, Tolerances, update_golden
    from nodes.replaying.replay import Replay
    from nodes.runtime.errors import BagError

    allowed = Tolerances.parse(tolerance)
    if not update and not golden.exists():
        raise BagError(f"expected a golden bag at {golden}, found none; write it with --update-golden")
    with Replay(bag, choice) as run:
        start = time.perf_counter()
        if update:
            count = update_golden(golden, run, topics)
            _say(run, time.perf_counter() - start)
            print(f"wrote {golden}: {count} messages")
            return
        comparison = Golden(golden, allowed, topics)
        for message in run:
            comparison.take(message)
        difference = comparison.finish()
        _say(run, time.perf_counter() - start)
        if difference is not None:
            say_error(f"differs from {golden}: {difference.text(run.info.start_ns)}")
            raise typer.Exit(FAILURE_EXIT)
        print(f"equal to {golden}: {comparison.compared} messages compared")


def _retro(bag: Path, attack: Path, choice: Choice, json_file: Path | None, plot: Path | None) -> None:
    from nodes.replaying.attack import plot_retro_attack, retro_attack

    result = retro_attack(bag, attack, choice)
    _print_steering(result)
    print(result.verdict())
    if (changed := result.numbers()["clean_against_recorded_rad"]) is not None:
        print(
            f"clean against recorded: {changed * _DEG:.3f} degrees mean difference; 0 if the code did not change since the recording"
        )
    if json_file is not None:
        result.write_json(json_file)
        print(f"wrote {json_file}")
    if plot is not None:
        plot_retro_attack(result, plot)
        print(f"wrote {plot}")


def _print_steering(result: RetroAttack) -> None:
    rows = table("time [s]", "recorded [deg]", "clean [deg]", "attacked [deg]", "delta [deg]", "face")
    for row in result.rows():
        angles = [row[key] for key in ("recorded_rad", "clean_rad", "attacked_rad", "delta_rad")]
        words = ["-" if angle is None else f"{angle * _DEG:.2f}" for angle in angles]
        rows.add_row(f"{row['time_s']:.2f}", *words, "in view" if row["drawn"] else "")
    print_table(rows)


def _say(run: Replay, wall_s: float) -> None:
    summary = run.summary
    made = ", ".join(f"{count} {topic}" for topic, count in sorted(summary.made.items())) or "nothing"
    print(f"published {made} from {summary.messages} messages")
    for topic, reason in summary.refused.items():
        say_error(f"refused messages on {topic}: {reason}")
    speed = f", {summary.duration_s / wall_s:.0f} x real time" if wall_s > 0 else ""
    print(f"{summary.duration_s:.2f} s of recording in {wall_s:.2f} s{speed}")
    print(f"digest {summary.digest}" + (f" (unchecked: {run.info.unchecked})" if run.info.unchecked else ""))
