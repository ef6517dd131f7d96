import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from advnerf_core.report import sections
from advnerf_core.report.data import Texture
from advnerf_core.report.result_page import render_page
from advnerf_core.report.result_table import ResultTable
from advnerf_core.report.sections import page_sections, what_it_did

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Checker(HTMLParser):
    """Collects what a browser would load, and that every element is closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.ids, self.tags = [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for name, value in attrs:
            if name in ("src", "href", "poster", "data", "srcset", "action") and not (value or "").startswith(
                ("data:", "#")
            ):
                self.loads.append((tag, name, value))
            if name == "id" and tag == "section":
                self.ids.append(value)
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


NO_ROWS = ResultTable((), {}, "room")


def page_of(data, table=NO_ROWS):
    """The one page, with the sections of an experiment."""
    return render_page(table, (), page_sections(data, table), what_it_did(data, table, "hardened"))


def test_the_page_is_whole_and_loads_nothing(report):
    page = page_of(report)
    checker = check(page)
    assert checker.loads == []
    assert "script" not in checker.tags
    assert not re.search(r"url\(\s*['\"]?(?!#)", page)
    assert "://" not in page
    assert "default-src 'none'" in page
    assert checker.ids == [
        "track",
        "what-the-panel-showed",
        "how-true-the-learned-scene-is",
        "laps-without-attack",
        "live-timing",
        "memory-against-the-horizon",
        "how-to-make-this-page-again",
    ]
    assert "Not measured in this run" not in page


def test_missing_parts_are_named(bare_report):
    page = page_of(bare_report)
    check(page)
    # drives, fidelity, laps, latency, memory, timings
    assert page.count("Not measured in this run.") == 6
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
    assert "Deployed it was not measured in this run." in page


def test_a_page_without_live_drives_has_the_world_and_what_was_seen_and_no_live_parts(make, bare_report):
    picture = np.zeros((4, 8, 3), np.uint8)
    driven = dataclasses.replace(
        make.drives([make.drive("surrogate", "none", 0.02)]), seen={"random": picture}
    )
    page = page_of(dataclasses.replace(bare_report, drives=(driven,), overview=picture, live=False))
    assert check(page).ids == [
        "the-world",
        "track",
        "how-true-the-learned-scene-is",
        "how-to-make-this-page-again",
    ]
    assert page.count('<img src="data:image') == 2
    assert "Objects seen: best random" in page


def test_a_lost_film_is_named_and_one_without_room_stays_beside(
    make, bare_report, report, monkeypatch, tmp_path
):
    lost = dataclasses.replace(bare_report, drives=(make.drives(film=tmp_path / "no.mp4"),))
    with pytest.raises(FileNotFoundError, match="expected the film"):
        page_of(lost)
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
    assert page.index("NOT DRIVEN LIVE: ") < page.index("in the learned scene the cross-track error")


def test_the_opening_says_what_it_did_in_metres(report, make):
    drives = [
        (domain, method, totals, off_track)
        for domain in ("surrogate", "deployed")
        for method, totals, off_track in (("none", [1.0], [False]), ("gradient", [13.0], [True]))
    ]
    (text,) = what_it_did(report, make.table(drives), "hardened")
    assert text.count("is 0.200 m per tick larger with the gradient texture than past the plain object") == 2
    assert "(total 13.00 m against 1.00 m), and the car left the track in 1 of 1 drive" in text
    bad = [(*each[:3], [True]) for each in drives]
    assert "WITHOUT AN ATTACK THE POLICY DOES NOT DRIVE" in " ".join(
        what_it_did(report, make.table(bad), "hardened")
    )
