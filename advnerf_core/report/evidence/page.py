"""The page of registered results: for each set a picture, a claim, the tables in metres, and how to run it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.intervals import MEASURED_COVERAGE
from advnerf_core.report.evidence.luck import luck_sentences
from advnerf_core.report.evidence.registration import launch_file
from advnerf_core.report.evidence.words import (
    DOMAIN_TITLES,
    claim,
    collisions,
    ends,
    excess_cells,
    p_text,
    place_of,
    sample_of,
)
from advnerf_core.report.text_table import Table

_HEAD = """# Does it transfer?

An attack is found in the *learned scene* of a place. Then it is *deployed*: driven in the simulator
of the place. No real car was driven ([what was and was not run](../was_not_run.md)).

*Excess* is the mean |CTE| per tick of a drive past the attack, minus that of a control from the same
start. There are two controls: the *plain object*, in its own colours, and *no object*. Claims use
the smaller excess. Each set was registered before its cells were run, and `advnerf verify` computes
all numbers again from the kept drives. [Evidence](../evidence.md) explains the method. Conditions of
one set that share their searches share the drives in the learned scene, which stand once. Films
and stills show the first search from the first start. Tests are exact permutation tests over
searches, adjusted by Holm over the set. *What each difference costs* compares the same attacks under
two conditions: excess over the plain object, after minus before, paired by search and start.

Intervals are nominal 95 % intervals. On simulated drives with a known truth they cover {:.0f} to {:.0f} %,
least where a few searches differ strongly from the rest: [statistics](statistics.md). *Decided after*
is when a test that may be read after every pair of searches would have ended; it claims nothing.
""".format(*MEASURED_COVERAGE)
# Columns that are left out if they are equal in all lines.
_OPTIONAL = ("condition", "collided")


def results_page(sets: Mapping[str, Mapping[str, Any]]) -> str:
    """The page in Markdown.

    Args:
        sets: Content of each ``set.json`` by name, with the registration under ``registered``, its entry of `ABOUT` under ``about`` (None
            without one), under ``filmed`` whether there is a film, and under ``notes`` paragraphs about its baselines and stored files.
    """
    return "\n".join([_HEAD, *_overview(sets), *(_section(name, sets) for name in sorted(sets))])


def groups_of_searches(sets: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Names of sets, grouped by shared searches."""
    groups: list[tuple[set[str], list[str]]] = []
    for name, data in sorted(sets.items()):
        attacks, names = {each["attack_id"] for each in data["searches"]}, [name]
        for group in [each for each in groups if each[0] & attacks]:
            groups.remove(group)
            attacks, names = attacks | group[0], group[1] + names
        groups.append((attacks, names))
    return sorted(names for _, names in groups)


def above_of(name: str) -> str:
    """File name of the picture of all drives of a set, beside the page."""
    return f"{name}_above.webp"


def picture_of(name: str) -> str:
    """File name of the picture of the excess of a set, beside the page."""
    return f"{name}_excess.png"


def film_of(name: str) -> str:
    """File name of the film of a set, beside the page."""
    return f"{name}_drives.webp"


def _overview(sets: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The list of sets, how many of them are independent, and the purpose of each."""
    said = {name: data["about"] for name, data in sets.items() if data.get("about")}
    if not said:
        return []
    count, worlds = len(groups_of_searches(sets)), len({about["world"] for about in said.values()})
    lines = [
        {
            "set": f"[{name}](#{name})",
            "world": about["world"],
            "role": about["role"],
            "searches": str(len(sets[name]["searches"])),
            "shares searches with": _shared(name, sets),
        }
        for name, about in sorted(said.items())
    ]
    sentence = f"The {len(sets)} sets are {count} groups of searches in {worlds} worlds. Sets that share searches are not independent.\n"
    return [sentence, _lines(lines)]


def _shared(name: str, sets: Mapping[str, Mapping[str, Any]]) -> str:
    """Other sets with the same searches, and how many of them; empty without any."""
    own = {each["attack_id"] for each in sets[name]["searches"]}
    counts = {
        other: len(own & {each["attack_id"] for each in data["searches"]})
        for other, data in sorted(sets.items())
        if other != name
    }
    return ", ".join(f"{other} ({count} of {len(own)})" for other, count in counts.items() if count)


def _section(name: str, sets: Mapping[str, Mapping[str, Any]]) -> str:
    data = sets[name]
    registered, explored = (
        [row for row in data["rows"] if row["registered"] is wanted] for wanted in (True, False)
    )
    parts = [
        f"## {name}\n",
        *_picture(name, data),
        *_role(name, sets),
        _where(data["deployed_through"]),
        *data.get("notes", ()),
        *_withdrawn(data),
        *_drives_badly(data),
    ]
    if data["primary"]:
        apart = searched_apart(data["primary"])
        told = apart if len(apart) > 1 else data["primary"][-1:]
        said = [text for test in told for text in (claim(test, data["rows"]), luck_sentences(test)) if text]
        parts += [*(f"{each}\n" for each in said), _tests(data["primary"])]
    parts += [_table(registered), f"![Excess of every drive, by method and domain]({picture_of(name)})\n"]
    if data["filmed"]:
        baseline = ["the strongest baseline"] if filmed_of(data)["baseline"] else []
        parts.append(
            f"![Drives past {', '.join(['the plain object', *baseline])} and the attack]({film_of(name)})\n\n"
            f"*Film: {_filmed(data)}.*\n"
        )
    if data.get("contrasts"):
        parts += ["### What each difference costs\n", _contrasts(data["contrasts"])]
    if data.get("claims"):
        parts += ["### Over places and victims\n", *map(_place_claim, data["claims"])]
    if explored:
        parts += ["### Not registered\n", "Run, and not registered before.\n", _table(explored)]
    parts += ["### How to run it\n", _commands(name, data)]
    return "\n".join(parts)


def searched_apart(primary: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Primary tests from ``set.json`` whose picture has a map each: of the first one's method, the last of those with the same searches."""
    method = primary[0]["test"]["method"]
    of_method = [each for each in primary if each["test"]["method"] == method]
    # Conditions that share searches share the drives in the learned scene.
    return list(
        {tuple(s["surrogate_m"] for s in each["searches"][method]): each for each in of_method}.values()
    )


def maps_of(data: Mapping[str, Any]) -> list[list[Mapping[str, Any]]]:
    """The maps in the picture of a set by its ``set.json``, each with the tests whose drives it shows: one for each of `searched_apart`; without tests
    one for each place of a claim, of all victims; without claims one for each condition of a contrast, which has no baseline."""
    if data["primary"]:
        return [[test] for test in searched_apart(data["primary"])]
    if not data.get("claims"):
        return [[condition] for condition in _conditions(data)]
    maps = dict[str, list[Mapping[str, Any]]]()
    for claimed in data.get("claims", ()):
        for each in claimed["each"]:
            test = {"scenario": each["scenario"], "victim": each["victim"], "method": claimed["method"]}
            maps.setdefault(each["scenario"], []).append({**each, "test": test})
    return list(maps.values())


def has_stills(data: Mapping[str, Any]) -> bool:
    """Whether the picture of a set has one map beside stills of its film, instead of each of `maps_of`: its tests share their searches."""
    return bool(data["primary"]) and len(maps_of(data)) == 1


def _conditions(data: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The conditions that contrasts compare, in the form of tests, each with the difference to the one before."""
    found = dict[str, Mapping[str, Any]]()
    for row in data.get("contrasts", ()):
        of_row = {"victim": row["victim"], "method": row["method"]}
        for end, difference_m in (("before", 0.0), ("after", row["difference_m"])):
            test = {"scenario": row[end], **of_row}
            found.setdefault(row[end], {"test": test, "baseline": None, "difference_m": difference_m})
    return list(found.values())


def filmed_of(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The test from ``set.json`` whose drives are filmed: the first one; of scenarios with searches of their own the one with the largest difference."""
    apart = [test for tests in maps_of(data) for test in tests]
    if len(apart) > 1:
        return max(apart, key=lambda test: test["difference_m"] or 0.0)
    return (data["primary"] or apart)[0]


def _filmed(data: Mapping[str, Any]) -> str:
    test = filmed_of(data)["test"]
    return place_of(test) + ("" if data["primary"] else f", victim {test['victim']}")


def _picture(name: str, data: Mapping[str, Any]) -> list[str]:
    if not maps_of(data):
        return []
    if not has_stills(data):
        return [f"![All deployed drives of each scenario from above]({above_of(name)})\n"]
    shown, filmed = (place_of(each["test"]) for each in (data["primary"][-1], filmed_of(data)))
    stills = f" Stills: {filmed}." if data["filmed"] else ""
    place = (data.get("about") or {}).get("object")
    stands = (
        f" Place of the object: {place['source']}." if place else " The place of the object was not kept."
    )
    return [
        f"![All deployed drives from above, and what the camera saw]({above_of(name)})\n",
        f"*Drives: {shown}.{stills}{stands}*\n",
    ]


def _role(name: str, sets: Mapping[str, Mapping[str, Any]]) -> list[str]:
    about = sets[name].get("about")
    if not about:
        return []
    after = f", registered after {about['after']}" if about["after"] else ""
    shared = _shared(name, sets)
    return [
        f"**{about['role'].capitalize()}**{after}. What changed: {about['changed']}"
        + (f" Searches shared with {shared}." if shared else "")
        + "\n"
    ]


def _where(through: Sequence[str]) -> str:
    """The deployment, so that no simulation passes for a real car."""
    known = {
        "nodes": "the simulated lab, driven by the live nodes",
        "world": "the simulator, with its own car unless the condition says ideal",
        "nothing": "nowhere",
    }
    return f"*Deployed* here: {' and '.join(known.get(each, each) for each in through) or 'nowhere'}.\n"


def _withdrawn(data: Mapping[str, Any]) -> list[str]:
    """Sentences about withdrawn scenarios."""
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
    """Sentences about victims that break the registered rule of driving well."""
    return [
        f"**Does not drive well:** past the plain object, the victim {row['victim']} has a mean abs. CTE of {row['mean_cte_m']:.4f} m {row['domain']} in "
        f"{place_of(row)}, and {row['off_track']} drives leave the track. Registered were at most {row['limit_m']:.4f} m, and none. {row['reason']}\n"
        for row in data.get("does_not_drive_well", [])
    ]


def _tests(tests: Sequence[Mapping[str, Any]]) -> str:
    """The primary tests: deployed excess of the attack minus the baseline's."""
    return _lines(
        [
            {
                "condition": place_of(test["test"]),
                "victim": test["test"]["victim"],
                "attack": style_of(test["test"]["method"]).title,
                "minus": style_of(test["baseline"]).title,
                "difference [m per tick]": f"{test['difference_m']:.3f}",
                "95 %": ends(test["low_m"], test["high_m"]),
                "p deployed, after Holm": "not tested" if test["p"] is None else p_text(test["p_holm"]),
                "in the learned scene": f"{test['difference_surrogate_m']:+.3f}",
                "p there, not adjusted": _optional_p(test["p_surrogate"]),
                "decided after": _decided(test["anytime"]),
            }
            for test in tests
        ]
    )


def _decided(found: Mapping[str, Any]) -> str:
    """Number of search pairs after which the anytime-valid test would have decided."""
    return f"{found['pairs'] or '-'} of {found['of_pairs']} pairs" if found["of_pairs"] else ""


def _optional_p(value: float | None) -> str:
    return "" if value is None else p_text(value)


def _contrasts(found: Sequence[Mapping[str, Any]]) -> str:
    return _lines(
        [
            {
                "what differs": row["name"] + ("" if row["registered"] else " (not registered)"),
                "victim": row["victim"],
                "attack": style_of(row["method"]).title,
                "searches x starts": f"{row['searches']} x {row['drives'] // row['searches']}"
                + (f" ({row['other_attacks']} with another attack left out)" if row["other_attacks"] else ""),
                "before [m per tick]": f"{row['before_m']:.3f}",
                "after": f"{row['after_m']:.3f}",
                "difference": f"{row['difference_m']:+.3f}",
                "95 %": ends(row["low_m"], row["high_m"]),
            }
            for row in found
        ]
    )


def _place_claim(row: Mapping[str, Any]) -> str:
    """A claim about a kind of place or victim: one sentence, and what it is the mean of."""
    places = row["places"]
    title = (
        f"**{row['name']}**, {style_of(row['method']).title} minus the strongest baseline, {sample_of(row)}"
    )
    if row["difference_m"] is None:
        return f"{title}: no claim, as {row['reason']}.\n"
    low = row["low_off_track_points"]
    said = (
        f"{title}: {row['difference_m']:+.3f} m per tick ({ends(row['low_m'], row['high_m'])} for new {'places and ' * (places > 1)}victims), off track "
        f"{row['off_track_points']:+.0f} points ({'no bound, as all are equal' if low is None else f'lower bound {low:+.0f}'}), "
        f"at least {row['least_off_track_points']:+.0f} {'at each place' if places > 1 else 'for each victim'}.\n"
    )
    return f"{said}\n" + _lines(
        [
            {
                "place": each["scenario"].replace("_", " "),
                "victim": each["victim"],
                "minus": style_of(each["baseline"]).title,
                "difference [m per tick]": f"{each['difference_m']:+.3f}",
                "off track [points]": f"{each['off_track_points']:+.0f}",
            }
            for each in row["each"]
        ]
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line for each method and domain. Conditions of the same searches share their drives in the learned scene, which appear once."""
    shown: list[dict[str, str]] = []
    for cells in map(_cells, rows):
        before = [
            {**other, "condition": ""}
            for other in shown
            if other["driven in"] == cells["driven in"] != DOMAIN_TITLES["deployed"]
        ]
        if {**cells, "condition": ""} not in before:
            shown.append(cells)
    return _lines(shown)


def _lines(lines: Sequence[Mapping[str, str]]) -> str:
    """A table of lines by column, without columns of `_OPTIONAL` that are equal in all lines."""
    columns = tuple(
        name
        for name in (lines[0] if lines else {})
        if name not in _OPTIONAL or len({line[name] for line in lines}) > 1
    )
    cells = tuple(tuple(line[name] for name in columns) for line in lines)
    return Table("", columns, cells, (False,) * len(columns), drops_empty=False).markdown()


def _cells(row: Mapping[str, Any]) -> dict[str, str]:
    plain, plain_ends, bare, bare_ends = excess_cells(row)
    return {
        "condition": place_of(row),
        "victim": row["victim"],
        "object": style_of(row["method"]).title,
        "driven in": DOMAIN_TITLES[row["domain"]],
        "searches x starts": f"{row['searches']} x {row['drives'] // row['searches']}",
        "excess over plain object [m per tick]": plain,
        "95 %": plain_ends,
        "over no object": bare,
        "95 % of it": bare_ends,
        "off track": f"{row['off_track']} of {row['drives']}",
        "collided": collisions(row["collided"]),
        "ticks off lane": f"{100 * row['off_lane_share']:.0f} %",
        "leaves after [s]": "" if row["leaving_s"] is None else f"{row['leaving_s']:.1f}",
    }


def _commands(name: str, data: Mapping[str, Any]) -> str:
    registration = data["registered"]
    setting = f" --setting {registration['setting']}" if registration["setting"] else ""
    changes = "".join(f" --set {text}" for text in registration["overrides"])
    # A registration keeps the name of its file alone. Sets of this project, which have facts in `about`, are in its folder launch.
    folder = "launch/" if data.get("about") else ""
    what = f"{folder}{launch_file(registration['file'])}{setting}{changes}"
    return "\n".join(
        [
            f"    advnerf experiment run {what}",
            f"    advnerf experiment publish {what}",
            f"    advnerf verify {name}\n",
            f"Registered on {registration['date'][:10]}, digest `{registration['digest'][:12]}`: {len(registration['cells'])} cells, "
            f"{len(registration['primary'])} primary tests.\n",
        ]
    )
