"""The six questions that a reader of results has, each answered in a sentence or two from published sets and measured rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.families import GRADIENT
from advnerf_core.report.evidence.hardness import with_titles
from advnerf_core.report.evidence.strongest import strongest_random

# Worlds that this project did not write, or did not draw, by what the names of their sets contain.
_FOREIGN = {
    "metadrive": "in MetaDrive, with its own renderer and car",
    "duckietown": "in Duckietown, with its own renderer and robot",
    "filament": "in the lab's room as MuJoCo 4's renderer Filament draws it",
}


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
    sets = _sets(published)
    found = [
        Answer("Does it transfer?", "results/transfer.md", _transfers(sets)),
        Answer("Against which victims?", "results/hardened.md", _victims(sets, published)),
        Answer("Better than what?", "results/transfer.md", _better(sets)),
        Answer("How realistic is the learned copy?", "results/room.md", _realistic(rows)),
        Answer("In whose world?", "was_not_run.md", _worlds(sets)),
        Answer("How fast?", "performance.md", _fast(rows)),
    ]
    return [answer for answer in found if answer.text]


def table(found: Sequence[Answer]) -> str:
    """The answers as a Markdown table."""
    lines = [f"| [{each.question}]({each.page}) | {each.text} |\n" for each in found]
    return "| question | answer |\n|---|---|\n" + "".join(lines)


def sets_table(published: Path) -> str:
    """One line for each test of the published sets, as Markdown; empty without any."""
    lines = [_line(found, test) for found, test in _told(_sets(published))]
    if not lines:
        return ""
    head = (
        "| registered set | victim | learned copy [m per tick] | deployed | 95 % | leaves the track | gradient - strongest random | p | learned copy, gradient - random | p there |\n"
        "|---|---|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(lines)


def _sets(published: Path) -> list[dict[str, Any]]:
    files = sorted(published.glob("*/set/set.json"))
    return [with_titles(file.parents[1], read_json(file)) for file in files]


def _told(sets: Sequence[Mapping[str, Any]]) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Sets with their tests that are told here: of one with contrasts that under its last condition, in which everything is the world's own."""
    told = []
    for found in sets:
        # The gradient in coarse cells is on the page of the sets.
        tests = [test for test in found["primary"] if test["test"]["method"] == GRADIENT]
        told += [(found, test) for test in (tests[-1:] if found.get("contrasts") else tests)]
    return told


def _row(rows: Sequence[Mapping[str, Any]], test: Mapping[str, Any], domain: str) -> Mapping[str, Any]:
    keys = ("scenario", "placement", "victim", "method")
    wanted = [test["test"][key] for key in keys]
    return next(r for r in rows if [r[key] for key in keys] == wanted and r["domain"] == domain)


def _line(found: Mapping[str, Any], test: Mapping[str, Any]) -> str:
    here, there = (_row(found["rows"], test, domain) for domain in ("surrogate", "deployed"))
    band = "" if there["low_m"] is None else f"{there['low_m']:.3f} to {there['high_m']:.3f}"
    cells = [
        f"[{found['name']}](results/transfer.md#{found['name']}), {test['test']['scenario']}",
        test["test"]["victim"],
        f"{here['excess_m']:.3f}",
        f"{there['excess_m']:.3f}",
        band,
        f"{there['off_track']} of {there['drives']}",
        f"{test['difference_m']:+.3f} ({style_of(test['baseline']).title})",
        "not tested" if test["p_holm"] is None else f"{test['p_holm']:.4f}",
        f"{test['difference_surrogate_m']:+.3f}",
        "not tested" if test["p_surrogate"] is None else f"{test['p_surrogate']:.4f}",
    ]
    return f"| {' | '.join(cells)} |\n"


def _transfers(sets: Sequence[Mapping[str, Any]]) -> str:
    pairs = [
        [_row(found["rows"], test, domain) for domain in ("surrogate", "deployed")]
        for found, test in _told(sets)
    ]
    if not pairs:
        return ""
    above = sum(there["low_m"] is not None and there["low_m"] > 0.0 for _, there in pairs)
    kept = [there["excess_m"] / here["excess_m"] for here, there in pairs]
    return (
        f"In {above} of {len(pairs)} registered sets the attack moves the car where it is deployed (95 % interval above zero). "
        f"It keeps {100 * min(kept):.0f} to {100 * max(kept):.0f} % of its excess in the learned copy. The next table has a line for each."
    )


def _better(sets: Sequence[Mapping[str, Any]]) -> str:
    tests = [test for _, test in _told(sets)]
    if not tests:
        return ""
    added = [test["difference_m"] for test in tests]
    shown, there = (
        sum(test[name] is not None and test[name] < 0.05 for test in tests)
        for name in ("p_holm", "p_surrogate")
    )
    return (
        f"Than the strongest family of random textures in the learned copy: the gradient adds {min(added):.2f} to {max(added):.2f} m per tick, "
        f"with p < 0.05 in {shown} of {len(tests)} sets. In the learned copy itself, where both search, p < 0.05 in {there} of them."
    )


def _victims(sets: Sequence[Mapping[str, Any]], published: Path) -> str:
    # The last scenario of a set is the one in which everything is the world's own.
    named = [
        (data["name"], each[-1]) for data in sets if (each := strongest_random(published / data["name"]))
    ]
    found = [each for _, each in named]
    if not found:
        return ""
    titles = sorted({row["victim"] for data in sets for row in data["rows"]})
    worst = max(found, key=lambda each: each.deployed.best_m)
    off = max(found, key=lambda each: each.deployed.off_track / each.deployed.drives)
    place = next(name for name, each in named if each is off)
    return (
        f"Policies {' or '.join(titles)}. The best random search of each set moves them {min(each.deployed.best_m for each in found):.3f} to "
        f"{worst.deployed.best_m:.3f} m per tick where it is deployed (set {place}: {off.deployed.off_track} of {off.deployed.drives} drives off the track, "
        f"{off.deployed.all_off_track} of {off.deployed.all_drives} of all {off.searches} searches), and up to "
        f"{max(each.surrogate.best_m for each in found):.3f} m in the learned copy. Results with a policy that never saw a texture are of the "
        "[first build](results/first_build.md)."
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
    names = [str(found["name"]) for found in sets]
    foreign = [each for key, each in _FOREIGN.items() if any(key in name for name in names)]
    elsewhere = (
        f" Also {'; '.join(foreign[:-1])}{'; and ' if foreign[1:] else ''}{foreign[-1]}." if foreign else ""
    )
    return f"In this project's own simulated places, driven {driven}.{elsewhere} No real car was driven."


def _fast(rows: Sequence[Mapping[str, Any]]) -> str:
    search = _value(rows, "trained scene to an attack that predicts an excess of 0.15 m a tick")
    clone = _value(rows, "clean clone to report")
    if search is None or clone is None:
        return ""
    return f"On two cores without a GPU: {search:.0f} s from a trained scene to an attack, {clone:.1f} min from a clean clone to a report."


def _value(rows: Sequence[Mapping[str, Any]], line: str) -> float | None:
    return next((float(row["value"]) for row in rows if row["line"] == line), None)
