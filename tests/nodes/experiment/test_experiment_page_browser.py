"""The experiment page in Chromium, from the first stage of a tiny experiment until its report."""

from urllib.parse import urlsplit

import pytest

from benchmarks.experiment_page_pictures import watched_experiment
from nodes.experiment_page.page import ExperimentPage
from tests.support.experiment_page import CELLS, record_of, search_so_far
from tests.support.live.page_browser import PHONE, available

pytestmark = [
    pytest.mark.browser,
    pytest.mark.live,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]
DESK = {"viewport": {"width": 1400, "height": 900}, "color_scheme": "dark"}
# Stages of seconds, and steps enough that the page sees them run.
TINY = [
    "capture.photos=80",  # with fewer, fog hides the face
    "capture.colour_pairs=2",
    "capture.held_out=3",
    "scene.steps=150",
    "scene.log2_entries=12",
    "policy.deployed_stills=12",
    "policy.surrogate_stills=8",
    "policy.deployed_drives=1",
    "policy.surrogate_drives=2",
    "policy.drive_steps=3",
    "policy.first_steps=60",
    "policy.round_steps=3",
    "policy.naive_steps=0",
    "gate=null",  # so small a scene is not like the place
    "over.method=[none,random]",
    "attack.horizon=6",
    "attack.evaluations=6",
    "carrier.resolution=8",
    "horizon=8",
    "deploy.through=world",
    "deploy.starts=null",
]
NO_ACCESSIBLE_NAME = """() => [...document.querySelectorAll('svg, img, video, section, [role=region], progress, table')].filter((each) => {
  const by = each.getAttribute('aria-labelledby');
  return !(each.getAttribute('aria-label') || each.getAttribute('alt') || each.ariaLabel || each.querySelector('caption')
    || (by && document.getElementById(by)) || (each.tagName === 'TABLE' && each.closest('[role=region]')));
}).map((each) => each.outerHTML.slice(0, 200))"""


class Watcher:
    """A tab, with all that it said and asked for."""

    def __init__(self, browser, options, url):
        self.said, self.asked = [], []
        self.page = browser.new_context(**options).new_page()
        self.page.on("console", lambda each: self.said.append(f"{each.type}: {each.text}"))
        self.page.on("pageerror", lambda error: self.said.append(f"error: {error}"))
        self.page.on("response", lambda each: self.said.extend([each.url] if each.status >= 400 else []))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(url)

    def sees(self, expression, timeout_s=600.0):
        self.page.wait_for_function(f"() => {expression}", timeout=1000 * timeout_s)

    def check(self):
        assert self.said == []
        assert {urlsplit(url).hostname for url in self.asked} == {"127.0.0.1"}


def part_is(name, state):
    return f"""[...document.querySelectorAll('#parts tr')].some((row) => row.cells[0].innerText === '{name}'
      && row.cells[1].firstChild.innerText === '{state}')"""


def test_a_tiny_experiment_is_watched_until_its_report(browser, tmp_path):
    with watched_experiment(tmp_path, TINY) as (process, url):
        watcher = Watcher(browser, DESK, url)
        assert urlsplit(watcher.page.url).path == "/run"
        watcher.sees(part_is("capture", "done"))
        watcher.sees("document.querySelector('#curves .card svg .line')")
        assert "PSNR on training rays" in watcher.page.inner_text("#curves")
        watcher.sees(part_is("policy", "done"))
        assert "Error of the hardened policy" in watcher.page.inner_text("#curves")
        watcher.sees("document.querySelector('#searches img')?.naturalWidth > 0")
        assert "best" in watcher.page.inner_text("#searches")
        watcher.sees("location.pathname === '/report/report.html'")
        assert watcher.page.inner_text("h1").startswith("In the world lab ")
        watcher.page.go_back()
        watcher.sees(part_is("report", "done"))
        watcher.sees("document.querySelector('#films video')?.readyState >= 1")
        assert "The report is ready" in watcher.page.inner_text("#said")
        watcher.check()
        assert process.poll() is None  # it serves until Ctrl-C


@pytest.mark.parametrize("options", [DESK, PHONE], ids=["desk", "phone"])
def test_names_tables_and_live_regions_and_nothing_wider_than_the_screen(browser, tmp_path, options):
    record = record_of(tmp_path)
    record.finish("capture", 1.0, cached=False)
    record.start("scene")(0.5, "a_long_word_without_any_place_to_break_it_" * 4)
    for cell in CELLS[1:]:
        search_so_far(tmp_path / "cells" / cell.name, [1.0, 3.0, 2.0])
        record.finish(cell.name, 1.0, cached=True)
    with ExperimentPage(tmp_path, 0) as server:
        watcher = Watcher(browser, options, server.url)
        page = watcher.page
        watcher.sees("document.querySelectorAll('#searches img').length === 2")
        assert page.evaluate(NO_ACCESSIBLE_NAME) == []
        assert page.get_by_role("heading", level=1).count() == 1
        assert page.get_by_role("table").count() == 1
        assert page.get_by_role("columnheader").count() == 3
        assert (
            page.inner_text("[role=status][aria-live=polite]") == "3 of 6 parts are finished. Running: scene."
        )
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.innerText") == "Skip to the stages and cells"
        page.locator("#searches summary").first.focus()
        page.keyboard.press("Enter")
        watcher.sees("document.querySelectorAll('#searches details[open] tbody tr').length === 3")
        assert page.evaluate("document.documentElement.scrollWidth") <= options["viewport"]["width"]
        record.end("ValueError: the scene is empty")
        watcher.sees("document.querySelector('[role=alert]').innerText.includes('the scene is empty')")
        watcher.check()


def test_a_page_without_its_server_says_so_and_comes_back_to_nothing_wrong(browser, tmp_path):
    record_of(tmp_path)
    with ExperimentPage(tmp_path, 0) as server:
        watcher = Watcher(browser, DESK, server.url)
        watcher.sees("document.getElementById('phase').innerText === 'running'")
    watcher.sees("document.getElementById('phase').innerText === 'no connection'")
    assert "does not answer" in watcher.page.inner_text("#said")
