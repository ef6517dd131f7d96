import dataclasses
import json
import re
import tempfile
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.report.data import Clip, LiveTries, ReportData, Texture
from advnerf_core.report.live_parts import live_parts
from advnerf_core.report.results import read_results, results_dict, write_results
from advnerf_core.report.transfer import TransferTable
from advnerf_core.report.transfer_page import render_transfer_page

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


def render_page(data):
    """The one page, with the parts of an experiment whose drives were live."""
    table = TransferTable((), {}, "room")
    parts = live_parts(data)
    return render_transfer_page(table, (), parts.sections, parts.lead, parts.targets)


@pytest.fixture(scope="module")
def written(report, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    write_results(report, folder / "results.json")
    (folder / "report.html").write_text(render_page(report), encoding="utf-8")
    return folder / "report.html"


def test_the_page_is_whole_and_loads_nothing(written):
    page = written.read_text(encoding="utf-8")
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


def test_results_round_trip(report, written):
    content = json.loads((written.parent / "results.json").read_text(encoding="utf-8"))
    back = read_results(written.parent / "results.json")
    assert results_dict(back) == content == results_dict(report)
    np.testing.assert_array_equal(back.runs[3].states, report.runs[3].states)
    assert back.clips[0].path == report.clips[0].path
    assert back.fidelity.steering_difference_rad == report.fidelity.steering_difference_rad
    assert back.textures[0].image is None


def test_results_of_another_version_are_refused(tmp_path):
    path = tmp_path / "results.json"
    path.write_text('{"schema": "other/9"}')
    with pytest.raises(ValueError, match="expected schema 'advnerf-results/1'"):
        read_results(path)
    path.write_text("{")
    with pytest.raises(ValueError, match="expected JSON"):
        read_results(path)


def test_missing_parts_are_named(bare_report):
    page = render_page(bare_report)
    check(page)
    # runs, laps, clips, textures, fidelity, curves, latency, memory, timings
    assert page.count("Not measured in this run.") == 9
    assert "No &lt;live&gt; drive." in page


def test_text_from_outside_is_escaped(bare_report):
    evil = "<script>alert(1)</script>"
    textures = (Texture(evil, "gradient", np.zeros((4, 4, 3), np.uint8), evil),)
    manifest = dataclasses.replace(bare_report.manifest, command=evil, machine={evil: evil})
    page = render_page(dataclasses.replace(bare_report, textures=textures, manifest=manifest))
    assert "script" not in check(page).tags
    assert page.count("&lt;script&gt;") >= 5


def test_one_victim_one_start_without_live_drives(make, bare_report):
    runs = tuple(make.drive("surrogate", c, a) for c, a in (("none", 0.02), ("gradient", 0.6)))
    page = render_page(dataclasses.replace(bare_report, runs=runs))
    check(page)
    assert "On the live drive it was not measured in this run." in page


def test_single_drives_are_embedded_and_a_lost_clip_is_named(make, bare_report, report, tmp_path):
    clip = report.clips[0].path
    runs = (make.drive("deployed", "gradient", 0.6, clip=clip),)
    assert "Single drives (1)" in render_page(dataclasses.replace(bare_report, runs=runs))
    lost = dataclasses.replace(bare_report, clips=(Clip("lost", tmp_path / "no.mp4"),))
    with pytest.raises(FileNotFoundError, match="expected the clip 'lost'"):
        render_page(lost)


def test_unknown_missing_part_is_refused(make):
    with pytest.raises(ValueError, match=r"not_measured keys among .*, got \['latencies'\]"):
        ReportData(make.settings(), make.scene(), (), make.manifest(), not_measured={"latencies": "x"})


def test_tries_are_listed_and_an_arm_that_was_not_driven_live_is_named_first(report):
    late = "the stack stopped the car: no pose of the car for 0.21 s"
    tries = (LiveTries("none", "hardened", 0, True, (late,)), LiveTries("random", "hardened", 0, True))
    driven = dataclasses.replace(report, live_tries=tries)
    page = render_page(driven)
    assert page.count(late) == 1
    assert "NOT DRIVEN LIVE" not in page
    given_up = LiveTries("gradient", "hardened", 0, False, (late,) * 3)
    runs = tuple(run for run in report.runs if (run.domain, run.condition) != ("deployed", "gradient"))
    missing = dataclasses.replace(driven, runs=runs, live_tries=(*tries, given_up))
    page = render_page(missing)
    assert check(page)
    assert page.index("NOT DRIVEN LIVE: gradient") < page.index("A texture for one flat board")
    assert "are no evidence of transfer" in page
    assert "On the live drive it was not measured in this run" in page


def test_a_report_without_any_live_drive_is_a_whole_page(report):
    given_up = tuple(
        LiveTries(name, "hardened", 0, False, ("late",) * 3) for name in ("none", "random", "gradient")
    )
    runs = tuple(run for run in report.runs if run.domain == "surrogate")
    bare = dataclasses.replace(report, runs=runs, live_tries=given_up, latency=None, laps=None)
    page = render_page(bare)
    assert check(page)
    assert "NOT DRIVEN LIVE: " in page
    assert [dataclasses.asdict(each) for each in read_results_of(bare)] == [
        dataclasses.asdict(each) for each in given_up
    ]


def read_results_of(data):
    with tempfile.TemporaryDirectory() as folder:
        return read_results(write_results(data, Path(folder) / "results.json")).live_tries
