"""The six questions that a reader of results has, each answered in a sentence or two from published sets and measured rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.report.conditions import style_of

# Published sets from worlds that this project did not write, or did not draw.
_FOREIGN = {
    "gap_metadrive": "MetaDrive, with its own renderer and its own car",
    "gap_filament": "the room as MuJoCo 4's renderer Filament draws it",
    "gap_duckietown": "Duckietown, with its own renderer and its own robot",
}
_HARDENED = "python -m benchmarks.hardening"


@dataclass(frozen=True)
class Answer:
    """One question and its answer.

    Attributes:
        question: What a reader asks.
        page: Where more is, relative to ``docs/``.
        text: The answer; empty where nothing was measured.
    """

    question: str
    page: str
    text: str


def answers(rows: Sequence[Mapping[str, Any]], published: Path) -> list[Answer]:
    """Answers that can be given.

    Args:
        rows: Of the ledger.
        published: Folder of the published sets.
    """
    sets = [json.loads(file.read_text()) for file in sorted(published.glob("*/set/set.json"))]
    found = [
        Answer("Does it transfer?", "results/transfer.md", _joined(_transfers, sets)),
        Answer("Against which victims?", "results/hardened.md", _victims(rows)),
        Answer("Better than what?", "results/transfer.md", _joined(_better, sets)),
        Answer("How realistic is the learned copy?", "results/room.md", _realistic(rows)),
        Answer("In whose world?", "was_not_run.md", _worlds(sets)),
        Answer("How fast?", "performance.md", _fast(rows)),
    ]
    return [answer for answer in found if answer.text]


def table(found: Sequence[Answer]) -> str:
    """The answers as a Markdown table."""
    lines = [f"| [{each.question}]({each.page}) | {each.text} |\n" for each in found]
    return "| question | answer |\n|---|---|\n" + "".join(lines)


def _joined(answer: Any, sets: Sequence[Mapping[str, Any]]) -> str:
    return " ".join(answer(each["name"], test, each["rows"]) for each in sets for test in _told(each))


def _told(found: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """The tests that are told here: of a set with contrasts that under its last condition, in which everything is the world's own."""
    tests: Sequence[Mapping[str, Any]] = found["primary"]
    return tests[-1:] if found.get("contrasts") else tests


def _where(name: str, test: Mapping[str, Any]) -> str:
    return f"{name}, {test['test']['scenario']}".replace("_", " ")


def _row(rows: Sequence[Mapping[str, Any]], test: Mapping[str, Any], domain: str) -> Mapping[str, Any]:
    keys = ("scenario", "placement", "victim", "method")
    wanted = [test["test"][key] for key in keys]
    return next(r for r in rows if [r[key] for key in keys] == wanted and r["domain"] == domain)


def _transfers(name: str, test: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    there, here = _row(rows, test, "deployed"), _row(rows, test, "surrogate")
    band = (
        "" if there["low_m"] is None else f" (95 % interval {there['low_m']:.2f} to {there['high_m']:.2f} m)"
    )
    return (
        f"{_where(name, test)}: attacks move the car {there['excess_m']:.2f} m per tick further from its path where they are "
        f"deployed{band}, {here['excess_m']:.2f} m in the learned copy; {there['off_track']} of {there['drives']} deployed drives leave the track."
    )


def _better(name: str, test: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    del rows
    p = "no test is claimed" if test["p_holm"] is None else f"p = {test['p_holm']:.4f}"
    others = "; ".join(style_of(each).title for each in test["test"]["against"])
    return (
        f"{_where(name, test)}: the gradient adds {test['difference_m']:.2f} m per tick to "
        f"*{style_of(test['baseline']).title}* ({p}), the strongest of these in the learned copy: {others}."
    )


def _victims(rows: Sequence[Mapping[str, Any]]) -> str:
    found = [abs(row["value"]) for row in rows if row["command"].startswith(_HARDENED)]
    if not found:
        return ""
    return (
        f"A policy trained on random textures. Of {len(found)} families of random textures none moves it by more than {max(found):.3f} m per tick. "
        "Results with a policy that never saw one are of the [first build](results/first_build.md)."
    )


def _realistic(rows: Sequence[Mapping[str, Any]]) -> str:
    picture = _value(rows, "surrogate on held-out lab views, 200x66")
    steering = _value(rows, "surrogate on held-out lab views, steering")
    if picture is None or steering is None:
        return ""
    return (
        f"Held-out views of the room: {picture:.1f} dB PSNR at the policy's size. On them the policy steers {steering:.3f} rad differently, "
        "in the mean. Real photographs are in [learned places](results/learned_places.md)."
    )


def _worlds(sets: Sequence[Mapping[str, Any]]) -> str:
    through = sorted({each for found in sets for each in found["deployed_through"]})
    if not through:
        return ""
    words = {"nodes": "by the live nodes, against emulated devices", "world": "in the simulator itself"}
    driven = " and ".join(words.get(each, each) for each in through)
    foreign = [_FOREIGN[found["name"]] for found in sets if found["name"] in _FOREIGN]
    elsewhere = f" Also in {' and in '.join(foreign)}." if foreign else ""
    return f"In this project's own simulated places, driven {driven}.{elsewhere} No real car was driven."


def _fast(rows: Sequence[Mapping[str, Any]]) -> str:
    search = _value(rows, "trained scene to an attack that predicts an excess of 0.15 m a tick")
    clone = _value(rows, "clean clone to report")
    if search is None or clone is None:
        return ""
    return f"On two cores without a GPU: {search:.0f} s from a trained scene to an attack, {clone:.1f} min from a clean clone to a report."


def _value(rows: Sequence[Mapping[str, Any]], line: str) -> float | None:
    return next((float(row["value"]) for row in rows if row["line"] == line), None)
