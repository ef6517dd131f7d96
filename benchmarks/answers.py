"""The six questions that a reader of results has, each answered in a sentence or two from published sets and measured rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.about import SetAbout, read_about
from advnerf_core.report.evidence.families import GRADIENT
from advnerf_core.report.evidence.hardness import with_titles
from advnerf_core.report.evidence.page import groups_of_searches, searched_apart
from advnerf_core.report.evidence.words import (
    NOT_DRIVEN,
    ends,
    excesses,
    place_of,
    row_of,
    sample_of,
    smaller_excess,
)
from advnerf_core.report.reference import DOMAINS
from benchmarks.strongest import strongest_random

# Worlds that this project did not write, or did not draw, by what the names of their sets contain.
_FOREIGN = {
    "metadrive": "in MetaDrive, with its renderer and car",
    "duckietown": "in Duckietown, with its renderer and robot",
    "filament": "in the room as Filament draws it",
}
_COLUMNS = (
    "registered set",
    "role",
    "victim",
    "learned scene: excess over plain object; over no object [m per tick]",
    "deployed: the same",
    "95 % of the smaller",
    "leaves the track",
    "gradient minus random",
    "p",
    "gradient minus random in the learned scene",
)


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
        Answer("Does it transfer?", "results/transfer.md", _transfers(sets, read_about(published))),
        Answer("Against which victims?", "results/hardened.md", _victims(sets, published)),
        Answer("Better than what?", "results/transfer.md", _better(sets)),
        Answer("How realistic is the learned scene?", "results/room.md", _realistic(rows)),
        Answer("In whose world?", "was_not_run.md", _worlds(sets)),
        Answer("How fast?", "performance.md", _fast(rows)),
    ]
    return [answer for answer in found if answer.text]


def table(found: Sequence[Answer]) -> str:
    """The answers as a Markdown table."""
    lines = [f"| [{each.question}]({each.page}) | {each.text} |\n" for each in found]
    return "| question | answer |\n|---|---|\n" + "".join(lines)


def sets_table(published: Path) -> str:
    """One line for each set, of the test that is told, as Markdown; empty without any."""
    sets, about = _sets(published), read_about(published)
    told = _told(sets)
    lines = [_line(found, test, about) for found, test in told]
    if not lines:
        return ""
    return f"| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}\n" + "".join(
        f"| {' | '.join(line)} |\n" for line in lines
    )


def _sets(published: Path) -> list[dict[str, Any]]:
    files = sorted(published.glob("*/set/set.json"))
    return [with_titles(file.parents[1], read_json(file)) for file in files]


def _told(sets: Sequence[Mapping[str, Any]]) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Sets with the tests that are told here: of conditions that share searches the last one, in which everything is the world's own."""
    # The gradient in coarse cells is on the page of the sets.
    tests = [
        (found, [test for test in found["primary"] if test["test"]["method"] == GRADIENT]) for found in sets
    ]
    return [(found, test) for found, each in tests if each for test in searched_apart(each)]


def _line(found: Mapping[str, Any], test: Mapping[str, Any], about: Mapping[str, SetAbout]) -> list[str]:
    here, there = (row_of(found["rows"], test, domain) for domain in DOMAINS)
    smaller, hit = smaller_excess(there), sum(there["collided"].values())
    said = about.get(found["name"])
    return [
        f"[{found['name']}](results/transfer.md#{found['name']}), {place_of(test['test'])}",
        said.role if said else "",
        test["test"]["victim"],
        _both(here),
        _both(there),
        ends(smaller.low_m, smaller.high_m),
        f"{there['off_track']} of {there['drives']}" + f"; {hit} run into something" * bool(hit),
        f"{test['difference_m']:+.3f} ({style_of(test['baseline']).title})",
        "not tested" if test["p_holm"] is None else f"{test['p_holm']:.4f}",
        f"{test['difference_surrogate_m']:+.3f}",
    ]


def _both(row: Mapping[str, Any]) -> str:
    """Excess over the plain object and over no object."""
    bare = NOT_DRIVEN if row["over_no_object_m"] is None else f"{row['over_no_object_m']:.3f}"
    return f"{row['excess_m']:.3f}; {bare}"


def _transfers(sets: Sequence[Mapping[str, Any]], about: Mapping[str, SetAbout]) -> str:
    pairs = [[row_of(found["rows"], test, domain) for domain in DOMAINS] for found, test in _told(sets)]
    if not pairs:
        return f"{_counts(sets, about)}{claimed}" if (claimed := _claimed(sets)) else ""
    smaller = [smaller_excess(there) for _, there in pairs]
    # Both domains over the same control.
    here = [
        next(each for each in excesses(row) if each.over == used.over)
        for (row, _), used in zip(pairs, smaller, strict=True)
    ]
    kept = [there.mean_m / learned.mean_m for there, learned in zip(smaller, here, strict=True)]
    moved = sum(excess.is_shown for excess in smaller)
    lacking = sum(there["over_no_object_m"] is None for _, there in pairs)
    return (
        f"{_counts(sets, about)} In {moved} of {len(pairs)} comparisons the deployed attack moves the car further from its path than controls "
        f"(95 % interval above zero), by {min(each.mean_m for each in smaller):.3f} to {max(each.mean_m for each in smaller):.3f} m per tick over the "
        f"stronger control; {lacking} lack drives with no object. Of this excess in the learned scene, {100 * min(kept):.0f} to "
        f"{100 * max(kept):.0f} % is left.{_claimed(sets)}"
    )


def _claimed(sets: Sequence[Mapping[str, Any]]) -> str:
    """What claims over places and victims say, also where the attack does nothing."""
    said = [
        f"{found['name']} {claim['difference_m']:+.3f} m (95 % {ends(claim['low_m'], claim['high_m'])}), {claim['off_track_points']:+.0f} "
        f"points ({sample_of(claim)})"
        for found in sets
        for claim in found.get("claims", ())
        if claim["difference_m"] is not None
    ]
    return (
        f" It adds to the strongest baseline, per tick and in drives off the track: {'; '.join(said)}."
        if said
        else ""
    )


def _counts(sets: Sequence[Mapping[str, Any]], about: Mapping[str, SetAbout]) -> str:
    """How many sets there are, and how many of them are independent."""
    groups = len(groups_of_searches({found["name"]: found for found in sets}))
    said = [about[found["name"]] for found in sets if found["name"] in about]
    if not said:
        return f"{len(sets)} registered sets, {groups} groups of searches."
    explored = sum(each.role == "exploration" for each in said)
    return (
        f"{len(sets)} registered sets are {groups} groups of searches in {len({each.world for each in said})} worlds: {explored} sets explore, "
        f"{len(said) - explored} confirm."
    )


def _better(sets: Sequence[Mapping[str, Any]]) -> str:
    tests = [test for _, test in _told(sets)]
    if not tests:
        return ""
    added = [test["difference_m"] for test in tests]
    shown = sum(test["p_holm"] is not None and test["p_holm"] < 0.05 for test in tests)
    single = sum(len(test["test"]["against"]) == 1 for test in tests)
    unshown = sum(test.get("p_surrogate") is not None and test["p_surrogate"] >= 0.05 for test in tests)
    return (
        f"Than random textures: deployed, the gradient adds {min(added):.2f} to {max(added):.2f} m per tick, with p < 0.05 in {shown} of {len(tests)} "
        f"comparisons. {single} ran one random family; the others take the strongest in the learned scene."
        + (
            f" In {unshown} it is not shown to be better in the learned scene, where it searches."
            if unshown
            else ""
        )
    )


def _victims(sets: Sequence[Mapping[str, Any]], published: Path) -> str:
    named = [(data["name"], each) for data in sets for each in strongest_random(published / data["name"])]
    found = [each for _, each in named]
    if not found:
        return ""
    titles = sorted({row["victim"] for data in sets for row in data["rows"]})
    worst = max(found, key=lambda each: each.deployed.best_m)
    off = max(found, key=lambda each: each.deployed.off_track / each.deployed.drives)
    place = next(name for name, each in named if each is off)
    whom = "them" if len(titles) == 1 else "those trained with textures"
    return (
        f"{len(titles)} victim{'s' * (len(titles) > 1)}. The best random search of each set moves {whom} {min(each.deployed.best_m for each in found):.3f} to "
        f"{worst.deployed.best_m:.3f} m per tick, deployed (set {place}: {off.deployed.off_track} of {off.deployed.drives} drives off the track, "
        f"{off.deployed.all_off_track} of {off.deployed.all_drives} of all searches), and up to "
        f"{max(each.surrogate.best_m for each in found):.3f} m in the learned scene."
    )


def _realistic(rows: Sequence[Mapping[str, Any]]) -> str:
    picture = _value(rows, "surrogate on held-out lab views, 200x66")
    steering = _value(rows, "surrogate on held-out lab views, steering")
    if picture is None or steering is None:
        return ""
    return (
        f"Held-out views of the room: {picture:.1f} dB PSNR at the policy's size. There the policy steers {steering:.3f} rad differently, "
        "in the mean. [Real photographs](results/learned_places.md)."
    )


def _worlds(sets: Sequence[Mapping[str, Any]]) -> str:
    through = sorted({each for found in sets for each in found["deployed_through"]})
    if not through:
        return ""
    words = {"nodes": "by the live nodes, against emulated devices", "world": "in the simulator itself"}
    driven = " and ".join(words.get(each, each) for each in through)
    names = [str(found["name"]) for found in sets]
    foreign = [each for key, each in _FOREIGN.items() if any(key in name for name in names)]
    elsewhere = f" Also {'; '.join(foreign)}." if foreign else ""
    return f"In simulated places, driven {driven}.{elsewhere}"


def _fast(rows: Sequence[Mapping[str, Any]]) -> str:
    search = _value(rows, "trained scene to an attack that predicts an excess of 0.15 m a tick")
    clone = _value(rows, "clean clone to report")
    if search is None or clone is None:
        return ""
    return f"On two cores without a GPU: {search:.0f} s from a trained scene to an attack, {clone:.1f} min from a clean clone to a report."


def _value(rows: Sequence[Mapping[str, Any]], line: str) -> float | None:
    return next((float(row["value"]) for row in rows if row["line"] == line), None)
