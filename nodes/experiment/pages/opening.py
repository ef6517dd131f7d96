"""Opening of a page of results: a sentence for readers who know nothing of the experiment, the film, and the drives from above."""

from __future__ import annotations

from dataclasses import dataclass, replace

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.report.conditions import CONTROLS, NONE, compared
from advnerf_core.report.data import ReportData
from advnerf_core.report.evidence.words import DOMAIN_TITLES
from advnerf_core.report.pages import FirstScreen, fits
from advnerf_core.report.reference import Domain
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.text_table import count

Condition = tuple[str, str]  # scenario, victim


@dataclass(frozen=True)
class Wording:
    """Words and limits of an experiment for the sentences about it.

    Attributes:
        thing: Name of the attacked object.
        deployed: Place of the deployment, as the beginning of a sentence.
        off_track_m: |CTE| beyond which the car is off the track [m]; None if it is unknown.
    """

    thing: str = "object"
    deployed: str = "Deployed,"
    off_track_m: float | None = None


def first_screen(data: ReportData, table: ResultTable, victim: str, wording: Wording) -> FirstScreen:
    """Opening of the page: sentence, film and map of the first scenario, with the drives past the plain, random and attacked object."""
    from advnerf_core.report.maps import Arm, drives_from_above  # matplotlib
    from advnerf_core.report.plots import svg

    driven = data.drives[0]
    said = opening(table, wording, (driven.scenario, victim))
    deployed = bool(driven.select(victim=victim, domain="deployed"))
    domain: Domain = "deployed" if deployed else "surrogate"
    methods = dict.fromkeys(run.condition for run in driven.runs)
    if not set(methods) - set(CONTROLS):
        return said
    arms = [
        Arm(title, name, [run.states for run in found])
        for name, title in compared(methods).items()
        if (found := driven.select(victim=victim, domain=domain, condition=name))
    ]
    where = f"{driven.scenario.replace('_', ' ')}, {victim} policy, {DOMAIN_TITLES[domain]}"
    number_of = count(sum(len(arm.poses) for arm in arms), "drive")
    return replace(
        said,
        film=driven.film if fits(driven.film) else None,
        film_caption=f"From the driver's seat: {where}.",
        above=svg(drives_from_above(driven.scene, arms), "The drives from above, the track, and the object where it stands"),
        above_caption=f"From above: {number_of}, {where}. Green: on track. Dots: where a drive ended.",
    )  # fmt: skip


def opening(table: ResultTable, wording: Wording, key: Condition | None = None) -> FirstScreen:
    """The sentences of a table: first the one of a scenario and victim, by default the table's first; the others below it."""
    found = summaries(table, wording)
    main = key if key in found else next(iter(found), None)
    if main is None:
        return FirstScreen("Nothing was driven yet.")
    more = [(_name_of(each), text) for each, text in found.items() if each != main]
    return FirstScreen(found[main], more=more)


def summaries(table: ResultTable, wording: Wording) -> dict[Condition, str]:
    """A sentence for each scenario and victim of a table."""
    keys = dict.fromkeys(row.key[:2] for row in table.rows)
    return {
        key: _sentence({(row.method, row.domain): row for row in table.rows if row.key[:2] == key}, wording)
        for key in keys
    }


def _name_of(key: Condition) -> str:
    """Readable name of a scenario and victim."""
    return f"{key[0]}, {key[1]} policy".replace("_", " ")


def _sentence(rows: dict[tuple[str, str], TableRow], wording: Wording) -> str:
    methods = list(dict.fromkeys(method for method, _ in rows))
    if not set(methods) - set(CONTROLS):
        return "Nothing was attacked here."
    by_title = {title: name for name, title in compared(methods).items()}
    names = (by_title["attack"], by_title.get("best random", ""), NONE)
    for domain, where in (("deployed", wording.deployed), ("surrogate", "In the learned scene")):
        attacked, random, plain = (
            row if (row := rows.get((name, domain))) is not None and row.seeds else None for name in names
        )
        if attacked is not None and plain is not None:
            return _doubt(plain, where, wording) or _effect(attacked, random, plain, where, wording.thing)
    return f"The drives past the attacked {wording.thing} and past the plain one are not all finished."


def _effect(attacked: TableRow, random: TableRow | None, plain: TableRow, where: str, thing: str) -> str:
    mean = (
        ""
        if attacked.mean_abs_cte_m is None
        else f", on average {attacked.mean_abs_cte_m:.2f} m from its path"
    )
    text = f"{where} the car {_course(attacked)} past the attacked {thing}{mean}"
    others = [("the best random one", random), ("the plain one", plain)]
    did: dict[str, list[str]] = {}
    for name, row in others:
        if row is not None:
            away = "" if row.mean_abs_cte_m is None else f" ({row.mean_abs_cte_m:.2f} m)"
            did.setdefault(_course(row), []).append(name + away)
    rest = ", ".join("past " + " and ".join(names) + f" it {course}" for course, names in did.items())
    return f"{text}; {rest}."


def _doubt(plain: TableRow, where: str, wording: Wording) -> str:
    """A sentence about a victim that does not drive well without an attack; else empty."""
    mean_m, limit_m = plain.mean_abs_cte_m or 0.0, wording.off_track_m
    if limit_m is None or drives(mean_m, plain.off_track > 0, limit_m):
        return ""
    return (
        f"{where} THE POLICY DOES NOT DRIVE even past the plain {wording.thing}: there the car {_course(plain)}, on average {mean_m:.3f} m from its path "
        f"(expected at most {mean_cte_limit_m(limit_m):g} m), so its drives past the attacked one prove nothing."
    )


def _course(row: TableRow) -> str:
    """Whether the car stayed on its track, and what it ran into."""
    hits = row.excess.collided if row.excess else {}
    if row.drives == 1:
        hit = f" and ran into the {next(iter(hits))}" if hits else ""
        return ("left its track" if row.off_track else "stayed on its track") + hit
    every = "both drives" if row.drives == 2 else f"all {row.drives} drives"
    some = every if row.off_track in (0, row.drives) else f"{row.off_track} of {row.drives} drives"
    hit = f" and ran into something in {sum(hits.values())}" if hits else ""
    return f"{'left' if row.off_track else 'stayed on'} its track in {some}{hit}"
