"""The first screen of pages in Chromium, on a desk and on a phone: the sentence, the film and the drives from above."""

from pathlib import Path

import numpy as np
import pytest

from advnerf_core.driving.path import Line
from advnerf_core.driving.path import Path as DrivenPath
from advnerf_core.report.result_page import render_page
from advnerf_core.report.sections import page_sections
from nodes.audit.judging import FOUND, NO_OBJECT, PLAIN_OBJECT
from nodes.audit.page import write_page
from nodes.audit.verdict import ArmDrives
from nodes.experiment.pages.opening import Wording, first_screen
from tests.support.audits import audit_result
from tests.support.live.page_browser import PHONE, available

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]
SCREENS = {"desk": {"viewport": {"width": 1280, "height": 800}}, "phone": PHONE}
LEAST_CONTRAST = 4.5  # WCAG 2.2, 1.4.3, level AA
BOTTOM = "(names) => names.map((name) => document.querySelector(name).getBoundingClientRect().bottom)"
# Texts whose colour has less contrast with the first opaque background behind them.
PALE = """(least) => {
  const parts = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const light = (colour) => parts(colour).slice(0, 3).map((each) => each / 255)
    .map((each) => each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4)
    .reduce((sum, each, at) => sum + each * [0.2126, 0.7152, 0.0722][at], 0);
  const behind = (each) => { while (each && (parts(getComputedStyle(each).backgroundColor)[3] ?? 1) === 0) each = each.parentElement; return each; };
  return [...document.querySelectorAll('body *')].filter((each) => each.checkVisibility()
    && [...each.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())).filter((each) => {
      const style = getComputedStyle(each), colour = each.closest('svg') ? style.fill : style.color;
      const [low, high] = [light(colour), light(getComputedStyle(behind(each)).backgroundColor)].sort((a, b) => a - b);
      return (high + 0.05) / (low + 0.05) < least;
    }).map((each) => each.outerHTML.slice(0, 120));
}"""


@pytest.fixture(scope="module")
def pages(report, make, tmp_path_factory):
    """The page of an experiment, and that of an audit."""
    folder = tmp_path_factory.mktemp("pages")
    drives = [
        (domain, method, totals, off_track)
        for domain in ("surrogate", "deployed")
        for method, totals, off_track in (
            ("none", [1.0] * 2, [False] * 2),
            ("random", [3.0, 2.0], [False] * 2),
            ("gradient", [13.0, 20.0], [True, False]),
        )
    ]
    table = make.table(drives)
    first = first_screen(report, table, "hardened", Wording("board", "In the simulated lab", 0.4))
    text = render_page(table, first, sections=page_sections(report, table))
    (folder / "report.html").write_text(text)
    return {"report": folder / "report.html", "audit": write_audit_page(folder, report.drives[0].film)}


def write_audit_page(folder: Path, film) -> Path:
    along = np.linspace(0.0, 5.0, 20)
    driven = {}
    for name, off_m in ((NO_OBJECT, 0.0), (PLAIN_OBJECT, 0.05), (FOUND, 0.9)):
        across = off_m * along / 5.0
        states = np.stack([[along, across + 0.02 * start, 0.0 * along] for start in range(4)]).swapaxes(1, 2)
        largest = np.full(4, off_m)
        driven[name] = ArmDrives(states, largest, 0.5 * largest, np.full(4, 19))
    path = DrivenPath.from_segments((0.0, 0.0, 0.0), [Line(6.0)], closed=False)
    return write_page(folder, audit_result(), {"world": driven}, path, film, [])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("screen", SCREENS)
@pytest.mark.parametrize("name", ["report", "audit"])
def test_what_happened_is_on_the_first_screen(browser, pages, name, screen, scheme):
    page = browser.new_context(**SCREENS[screen], color_scheme=scheme).new_page()
    said = []
    page.on("console", lambda each: said.append(each.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(pages[name].as_uri())
    page.wait_for_function("document.querySelector('.first video').readyState >= 2")
    bottoms = page.evaluate(BOTTOM, ["h1", ".first video", ".first .above svg"])
    assert max(bottoms) <= SCREENS[screen]["viewport"]["height"]
    assert (
        page.evaluate(
            "(v => [v.muted, v.loop, v.poster.startsWith('data:image')])(document.querySelector('.first video'))"
        )
        == [True] * 3
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= SCREENS[screen]["viewport"]["width"]
    assert page.evaluate(PALE, LEAST_CONTRAST) == []
    assert page.evaluate(PALE, 22.0) != [], "no text was looked at"
    assert said == []
