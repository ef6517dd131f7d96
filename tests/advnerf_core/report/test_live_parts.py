import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from advnerf_core.report import live_parts
from advnerf_core.report.data import Clip, Texture
from advnerf_core.report.live_parts import live_sections, opening
from advnerf_core.report.result_page import render_page
from advnerf_core.report.result_table import ResultTable

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
    """The one page, with the parts of an experiment whose drives were live."""
    return render_page(table, (), live_sections(data, table), opening(data, table))


def test_the_page_is_whole_and_loads_nothing(report):
    page = page_of(report)
    checker = check(page)
    assert checker.loads == []
    assert "script" not in checker.tags
    assert not re.search(r"url\(\s*['\"]?(?!#)", page)
    assert "://" not in page
    assert "default-src 'none'" in page
    assert checker.ids == [
        "where-the-car-went",
        "what-the-camera-saw",
        "what-the-panel-showed",
        "how-true-the-surrogate-is",
        "the-search",
        "live-timing",
        "memory-against-the-horizon",
        "how-to-make-this-page-again",
    ]
    assert "Not measured in this run" not in page


def test_missing_parts_are_named(bare_report):
    page = page_of(bare_report)
    check(page)
    # runs, laps, clips, textures, fidelity, curves, latency, memory, timings
    assert page.count("Not measured in this run.") == 9
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
    page = page_of(dataclasses.replace(bare_report, runs=runs))
    check(page)
    assert "On the live drive it was not measured in this run." in page


def test_a_lost_clip_is_named_and_those_without_room_stay_beside(bare_report, report, monkeypatch, tmp_path):
    lost = dataclasses.replace(bare_report, clips=(Clip("lost", tmp_path / "no.mp4"),))
    with pytest.raises(FileNotFoundError, match="expected the clip 'lost'"):
        page_of(lost)
    monkeypatch.setattr(live_parts, "MAX_EMBEDDED_BYTES", 10)
    page = page_of(dataclasses.replace(bare_report, clips=report.clips))
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
    assert page.index("NOT DRIVEN LIVE: ") < page.index("A texture for one flat board")


def test_the_opening_says_what_it_did_in_metres(report, make):
    drives = [
        (domain, method, totals, off_track)
        for domain in ("surrogate", "deployed")
        for method, totals, off_track in (("none", [1.0], [False]), ("gradient", [13.0], [True]))
    ]
    (text,) = opening(report, make.table(drives))
    assert text.count("is 0.200 m per tick larger with the gradient texture than past the plain object") == 2
    assert "(total 13.00 m against 1.00 m), and the car left the track in 1 of 1 drive" in text
    bad = [(*each[:3], [True]) for each in drives]
    assert "WITHOUT AN ATTACK THE POLICY DOES NOT DRIVE" in " ".join(opening(report, make.table(bad)))
