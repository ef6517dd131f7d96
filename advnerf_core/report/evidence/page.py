"""The page of registered results: for each set a picture, two sentences, the table in metres, and how to run it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.tables import Table

_HEAD = """# Does it transfer?

Attacks are found in a learned copy of a place, then driven where they are deployed. The numbers
are metres: excess |CTE| per tick is the mean |CTE| of a drive with the attack minus that of the
drive without it from the same start. All of it was registered before it was run, and
`advnerf verify` computes it again from the drives that are kept. What is registered, kept and
tested is explained in [evidence.md](../evidence.md).
"""
_MOST_SENTENCES = 4
_TESTS_SAY = """Primary tests: the deployed excess of the attack minus that of the baseline that is strongest in the
surrogate, under each condition; exact permutation tests over searches, adjusted by Holm over this
table.
"""
_CONTRASTS_SAY = """The same attacks, driven under two conditions that differ in one thing: excess after minus before,
paired by search and start.
"""
_COLUMNS = (
    "victim",
    "object shows",
    "driven in",
    "searches x starts",
    "excess [m per tick]",
    "95 %",
    "off track",
    "collided",
    "ticks off lane",
    "leaves after [s]",
)


def results_page(sets: Mapping[str, Mapping[str, Any]]) -> str:
    """The page in Markdown.

    Args:
        sets: By name, what is in each ``set.json``, with the registration under ``registered``, and under ``filmed`` whether there is a film.
    """
    return "\n".join([_HEAD, *(_section(name, data) for name, data in sorted(sets.items()))])


def _section(name: str, data: Mapping[str, Any]) -> str:
    registered, explored = (
        [row for row in data["rows"] if row["registered"] is wanted] for wanted in (True, False)
    )
    parts = [
        f"## {name}\n",
        *(
            [f"![Drives without attack, past the strongest baseline, past the attack]({film_of(name)})\n"]
            * data["filmed"]
        ),
        f"![Excess of every drive, by method and domain]({picture_of(name)})\n",
        _where(data["deployed_through"]) + "\n",
        *_withdrawn(data),
        *_drives_badly(data),
        *_tests(data),
        _table(registered),
    ]
    if data.get("contrasts"):
        parts += ["### What each difference costs\n", _CONTRASTS_SAY, _contrasts(data["contrasts"])]
    if explored:
        parts += ["### Exploration\n", "Run, and not registered before.\n", _table(explored)]
    parts += ["### How to run it\n", _commands(name, data["registered"])]
    return "\n".join(parts)


def _withdrawn(data: Mapping[str, Any]) -> list[str]:
    """Sentences about what was registered and given up."""
    sentences = []
    for scenario, reason in data.get("withdrawn", {}).items():
        cells, tests = (
            sum(each["scenario"] == scenario for each in data["registered"][part])
            for part in ("cells", "primary")
        )
        sentences.append(
            f"**Registered, and not run:** {scenario.replace('_', ' ')}, with {cells} cells and {tests} of the primary tests, which count as "
            f"p = 1 in Holm's adjustment. {reason}\n"
        )
    return sentences


def _drives_badly(data: Mapping[str, Any]) -> list[str]:
    """Sentences about victims that break the registered rule of what drives well."""
    return [
        f"**Does not drive well:** without attack, the {row['victim']} victim has a mean abs. CTE of {row['mean_cte_m']:.4f} m {row['domain']} in "
        f"{_place(row)}, and {row['off_track']} drives leave the track. Registered were at most {row['limit_m']:.4f} m, and none. {row['reason']}\n"
        for row in data.get("does_not_drive_well", [])
    ]


def _tests(data: Mapping[str, Any]) -> list[str]:
    """Sentences about the primary tests; a table where there are many."""
    if len(data["primary"]) <= _MOST_SENTENCES:
        return [_sentences(test, data["rows"]) + "\n" for test in data["primary"]]
    columns = ("condition", "victim", "method", "against", "difference [m per tick]", "95 %", "p after Holm")
    rows = tuple(
        (
            _place(test["test"]),
            test["test"]["victim"],
            style_of(test["test"]["method"]).title,
            style_of(test["baseline"]).title,
            f"{test['difference_m']:.3f}",
            _ends(test),
            test["reason"] if test["p"] is None else _p(test["p_holm"]),
        )
        for test in data["primary"]
    )
    return [_TESTS_SAY, Table("", columns, rows, (False,) * len(columns)).markdown()]


def _contrasts(found: Sequence[Mapping[str, Any]]) -> str:
    columns = (
        "what differs",
        "victim",
        "attack",
        "searches x starts",
        "before [m per tick]",
        "after",
        "difference",
        "95 %",
    )
    rows = tuple(
        (
            row["name"] + ("" if row["registered"] else " (exploration)"),
            row["victim"],
            style_of(row["method"]).title,
            f"{row['searches']} x {row['drives'] // row['searches']}",
            f"{row['before_m']:.3f}",
            f"{row['after_m']:.3f}",
            f"{row['difference_m']:+.3f}",
            _ends(row),
        )
        for row in found
    )
    return Table("", columns, rows, (False,) * len(columns)).markdown()


def _ends(row: Mapping[str, Any]) -> str:
    return "" if row["low_m"] is None else f"{row['low_m']:.3f} to {row['high_m']:.3f}"


def _place(row: Mapping[str, Any]) -> str:
    """A condition as readers see it."""
    return f"{row['scenario']} {row['placement']}".strip().replace("_", " ")


def picture_of(name: str) -> str:
    """File name of the picture of a set, beside the page."""
    return f"{name}_excess.png"


def film_of(name: str) -> str:
    """File name of the film of a set, beside the page."""
    return f"{name}_drives.webp"


def _where(through: Sequence[str]) -> str:
    """Where it was deployed, so that no simulation passes for a real car."""
    known = {
        "nodes": "the simulated lab, driven in real time by the live nodes",
        "world": "the simulator of the place, with its own car where the condition names no other",
        "nothing": "nowhere",
    }
    return f"*Deployed* is {' and '.join(known.get(each, each) for each in through) or 'nowhere'}. No real car was driven."


def _sentences(test: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    which = test["test"]
    key = {name: which[name] for name in ("scenario", "placement", "victim", "method")}
    row = next(
        each
        for each in rows
        if each["domain"] == "deployed" and all(each[name] == value for name, value in key.items())
    )
    place = _place(which)
    first = (
        f"**{place}, {which['victim']} victim.** Where it is deployed, the {style_of(which['method']).title} attack moves the car "
        f"{row['excess_m']:.3f} m per tick further from its path{_between(row)}, and {row['off_track']} of {row['drives']} drives leave the "
        "track."
    )
    baseline = f"{style_of(test['baseline']).title}, the strongest baseline in the surrogate"
    between = "" if test["low_m"] is None else f", 95 % interval {_ends(test)} m"
    difference = f"{first} The difference to {baseline}, is {test['difference_m']:.3f} m per tick{between}"
    if test["p"] is None:
        return f"{difference}. {test['reason']}."
    return f"{difference} (exact permutation test over searches, p = {_p(test['p_holm'])} after Holm's adjustment)."


def _between(row: Mapping[str, Any]) -> str:
    return "" if row["low_m"] is None else f" (95 % interval {row['low_m']:.3f} to {row['high_m']:.3f} m)"


def _p(value: float) -> str:
    return f"{value:.4f}" if value >= 0.001 else f"{value:.1e}"


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    several = len({_place(row) for row in rows}) > 1
    columns = ("condition", *_COLUMNS) if several else _COLUMNS
    cells = tuple(((_place(row),) if several else ()) + tuple(_cells(row)) for row in rows)
    return Table("", columns, cells, (False,) * len(columns)).markdown()


def _cells(row: Mapping[str, Any]) -> list[str]:
    excess = f"{row['excess_m']:.3f}" if row["method"] != NONE else f"(mean abs. CTE {row['excess_m']:.3f})"
    return [
        row["victim"],
        style_of(row["method"]).title,
        row["domain"],
        f"{row['searches']} x {row['drives'] // row['searches']}",
        excess,
        _ends(row),
        f"{row['off_track']} of {row['drives']}",
        _collisions(row["collided"]),
        f"{100 * row['off_lane_share']:.0f} %",
        "" if row["leaving_s"] is None else f"{row['leaving_s']:.1f}",
    ]


def _collisions(counts: Mapping[str, int]) -> str:
    """How many drives ended against something, and against what: ``3 (2 board, 1 wall)``."""
    what = ", ".join(f"{count} {name}" for name, count in counts.items())
    return f"{sum(counts.values())} ({what})" if counts else "0"


def _commands(name: str, registration: Mapping[str, Any]) -> str:
    setting = f" --setting {registration['setting']}" if registration["setting"] else ""
    changes = "".join(f" --set {text}" for text in registration["overrides"])
    what = f"launch/{registration['file']}{setting}{changes}"
    return "\n".join(
        [
            f"    advnerf experiment {what}",
            f"    advnerf publish {what}",
            f"    advnerf verify {name}\n",
            f"Registered on {registration['date'][:10]}, digest `{registration['digest'][:12]}`: {len(registration['cells'])} cells, "
            f"{len(registration['primary'])} primary tests.\n",
        ]
    )
