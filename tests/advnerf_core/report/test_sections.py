import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from advnerf_core.report import pages, sections
from advnerf_core.report.data import Texture
from advnerf_core.report.result_page import render_page
from advnerf_core.report.result_table import ResultTable, make_table
from advnerf_core.report.sections import page_sections
from nodes.experiment.pages.opening import Wording, first_screen, summaries

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Checker(HTMLParser):
    """Collects what a browser would load, and that every element is closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.ids, self.links, self.tags = [], [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for name, value in attrs:
            if name in ("src", "href", "poster", "data", "srcset", "action") and not (value or "").startswith(
                ("data:", "#")
            ):
                self.loads.append((tag, name, value))
            if name == "id" and tag == "section":
                self.ids.append(value)
            if name == "href" and tag == "a":
                self.links.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def check(page):
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    return checker


METHODS = ("none", "random", "gradient")
NO_ROWS = ResultTable((), {}, "room")


def page_of(data, table=NO_ROWS):
    """The one page, with the sections of an experiment."""
    return render_page(
        table, first_screen(data, table, "hardened", Wording()), sections=page_sections(data, table)
    )


def test_the_page_is_whole_and_loads_nothing(report):
    page = page_of(report)
    checker = check(page)
    assert checker.loads == []
    assert "script" not in checker.tags
    assert not re.search(r"url\(\s*['\"]?(?!#)", page)
    assert "://" not in page
    assert "default-src 'none'" in page
    assert checker.ids == [
        "results-in-metres",
        "how-true-the-learned-scene-is",
        "track",
        "what-the-panel-showed",
        "learned-and-real-pictures",
        "laps-without-attack",
        "live-timing",
        "how-it-was-run",
    ]
    assert checker.links == ["#how-it-was-run", *(f"#{each}" for each in checker.ids)]
    assert "Not measured in this run" not in page


def test_missing_parts_are_named(bare_report):
    page = page_of(bare_report)
    check(page)
    # drives, fidelity, laps, latency
    assert page.count("Not measured in this run.") == 4
    assert "No &lt;live&gt; drive." in page


def test_text_from_outside_is_escaped(bare_report):
    evil = "<script>alert(1)</script>"
    textures = (Texture(evil, "gradient", np.zeros((4, 4, 3), np.uint8), evil),)
    manifest = dataclasses.replace(bare_report.manifest, command=evil, machine={evil: evil})
    page = page_of(dataclasses.replace(bare_report, textures=textures, manifest=manifest))
    assert "script" not in check(page).tags
    assert page.count("&lt;script&gt;") >= 5


def test_one_victim_one_start_without_live_drives(make, bare_report):
    runs = tuple(make.drive("surrogate", c, a) for c, a in (("none", 0.02), ("gradient", 0.6)))
    page = page_of(dataclasses.replace(bare_report, drives=(make.drives(runs),)), make.table([]))
    check(page)
    assert "<h1>The drives past the attacked object and past the plain one are not all finished.</h1>" in page


def test_a_page_without_live_drives_has_the_world_and_what_was_seen_and_no_live_parts(make, bare_report):
    picture = np.zeros((4, 8, 3), np.uint8)
    driven = dataclasses.replace(
        make.drives([make.drive("surrogate", "none", 0.02)]), seen={"random": picture}
    )
    page = page_of(dataclasses.replace(bare_report, drives=(driven,), overview=picture, live=False))
    assert check(page).ids == [
        "results-in-metres",
        "how-true-the-learned-scene-is",
        "the-world",
        "track",
        "how-it-was-run",
    ]
    assert page.count('<img src="data:image') == 2
    assert "Objects seen: best random" in page


def test_a_film_without_room_stays_beside(make, bare_report, report, monkeypatch):
    monkeypatch.setattr(pages.fits, "__defaults__", (10,))
    monkeypatch.setattr(sections, "MAX_EMBEDDED_BYTES", 10)
    page = page_of(dataclasses.replace(bare_report, drives=(make.drives(film=report.drives[0].film),)))
    assert "Not embedded" in page
    assert "<video" not in page


def test_tries_are_listed_with_why_they_do_not_count(report, make):
    late = "the stack stopped the car: no pose of the car for 0.21 s"
    drives = [("surrogate", "gradient", [9.0], [True]), ("surrogate", "none", [1.0], [False])]
    table = make.table(drives, extra={"horizon": 60, "spoiled_tries": [[late]]}, not_driven_live=late)
    bare = dataclasses.replace(report, latency=None, laps=None)
    page = page_of(bare, table)
    check(page)
    assert page.count(f"<td>{late}</td>") == 2
    assert page.index("NOT DRIVEN LIVE: ") < page.index(
        "<h1>In the learned scene the car left its track past"
    )


def drives_of(attacked, random=([1.0], [False])):
    """Deployed drives: totals and whether each left the track, against 1 m past the plain object."""
    plain = ([1.0] * len(attacked[0]), [False] * len(attacked[0]))
    return [
        ("deployed", name, *each)
        for name, each in (("none", plain), ("random", random), ("gradient", attacked))
    ]


LAB = Wording("board", "In the simulated lab", 0.4)


@pytest.mark.parametrize(
    ("drives", "says"),
    [
        (
            drives_of(([13.2], [True])),
            "In the simulated lab the car left its track past the attacked board, on average 0.22 m from its path; past the best random "
            "one (0.02 m) and the plain one (0.02 m) it stayed on its track.",
        ),
        (
            drives_of(([6.0, 18.0, 6.0], [False, True, False]), ([3.0] * 3, [False] * 3)),
            "In the simulated lab the car left its track in 1 of 3 drives past the attacked board, on average 0.17 m from its path; past "
            "the best random one (0.05 m) and the plain one (0.02 m) it stayed on its track in all 3 drives.",
        ),
        (
            drives_of(([6.0, 6.0], [False, False]), ([9.0, 3.0], [True, False])),
            "In the simulated lab the car stayed on its track in both drives past the attacked board, on average 0.10 m from its path; "
            "past the best random one (0.10 m) it left its track in 1 of 2 drives, past the plain one (0.02 m) it stayed on its track in "
            "both drives.",
        ),
    ],
)
def test_the_sentence_says_what_happened(make, drives, says):
    (sentence,) = summaries(make.table(drives), LAB).values()
    assert sentence == says


def test_the_sentence_of_a_policy_that_does_not_drive_claims_no_effect(make):
    bad = [(*each[:3], [True]) for each in drives_of(([13.0], [True]))]
    (sentence,) = summaries(make.table(bad), LAB).values()
    assert "THE POLICY DOES NOT DRIVE even past the plain board" in sentence
    assert sentence.endswith("so its drives past the attacked one prove nothing.")


def test_every_victim_has_its_sentence_on_the_first_screen(report, make):
    cells = [
        cell.model_copy(update={"victim": victim})
        for victim in ("hardened", "naive")
        for cell in make.table(drives_of(([13.2], [True]))).cells.values()
    ]
    wanted = {("track", victim, name): (0,) for victim in ("hardened", "naive") for name in METHODS}
    first = first_screen(report, make_table(wanted, cells), "naive", LAB)
    assert first.sentence.startswith("In the simulated lab the car left its track")
    assert [name for name, _ in first.more] == ["track, hardened policy"]
    assert first.above_caption.startswith("From above: 14 drives, track, naive policy, deployed.")
