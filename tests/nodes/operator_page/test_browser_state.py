"""What a person reads on the page in Chromium when pictures stop, a stop is latched, or the window is small."""

import pytest

from benchmarks.page_browser import PHONE, Phone, available
from tests.support.page import Run

pytestmark = [
    pytest.mark.browser,
    pytest.mark.live,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]
DESK = {"viewport": {"width": 1280, "height": 800}}
SIZES = pytest.mark.parametrize("options", [DESK, PHONE], ids=["desk", "phone"])
LONG_MS = 60_000


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    made = Run(tmp_path_factory.mktemp("run"))
    yield made.start()
    made.close()


@pytest.fixture(scope="module")
def playwright():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as running:
        yield running


@pytest.fixture
def open_page(run, playwright):
    made = []

    def make(options):
        made.append(Phone(playwright, run.folder, options=options))
        made[-1].open()
        made[-1].page.wait_for_function("() => document.querySelector('#age-1').innerText", timeout=LONG_MS)
        return made[-1]

    yield make
    for phone in made:
        if phone.page.is_visible("#reset_estop"):
            phone.page.click("#reset_estop")
        if phone.page.is_visible("#leave"):
            phone.page.click("#leave")
        phone.close()


def says(page, selector, words):
    page.wait_for_function(
        "([selector, words]) => document.querySelector(selector).innerText.includes(words)",
        arg=[selector, words],
        timeout=LONG_MS,
    )


def test_the_age_of_a_picture_grows_and_the_picture_turns_grey(run, open_page):
    page = open_page(DESK).page
    old = "document.querySelector('#picture-0').classList.contains('old')"
    page.wait_for_function(f"() => !{old}", timeout=LONG_MS)
    run.car.pictures = False
    try:
        page.wait_for_function(f"() => {old}", timeout=LONG_MS)
        seconds = "parseFloat(document.querySelector('#age-0').innerText)"
        first = page.evaluate(seconds)
        page.wait_for_function(f"() => {seconds} > {first} + 1", timeout=LONG_MS)
        says(page, "#age-1", "s old")
        assert "grayscale" in page.evaluate("getComputedStyle(document.querySelector('#picture-0')).filter")
    finally:
        run.car.pictures = True
    page.wait_for_function(f"() => !{old}", timeout=LONG_MS)
    says(page, "#age-0", " ms")


@SIZES
def test_a_latched_stop_is_the_state_of_the_whole_page(open_page, options):
    ann = open_page(options)
    page = ann.page
    ann.take("Ann")
    says(page, "#lease", "You operate as Ann")
    page.locator("#estop").dispatch_event("pointerdown")
    says(page, "#armed", "EMERGENCY STOP")
    says(page, "#estop", "Stopped")
    says(page, "#answer", "Done: emergency stop.")
    says(page, "#acts", "Ann: emergency stop")
    says(page, "#acts", "Ann: take control")
    assert page.is_disabled("#hold")
    assert page.is_disabled("#trial")
    bad = page.evaluate("getComputedStyle(document.querySelector('#estop')).backgroundColor")
    assert page.evaluate("getComputedStyle(document.querySelector('#armed')).backgroundColor") == bad
    good = page.evaluate("getComputedStyle(document.documentElement).getPropertyValue('--good').trim()")
    greens = """(good) => {
      const probe = document.body.appendChild(document.createElement('i'));
      probe.style.color = good;
      const colour = getComputedStyle(probe).color;
      probe.remove();
      return [...document.querySelectorAll('main *')].filter((each) => each.childElementCount === 0 && each.innerText
        && getComputedStyle(each).color === colour).map((each) => each.innerText);
    }"""
    assert page.evaluate(greens, good) == []
    page.click("#reset_estop")
    page.wait_for_selector("#reset_estop", state="hidden", timeout=LONG_MS)
    says(page, "#answer", "Done: release the emergency stop.")
    says(page, "#armed", "disarmed")


@SIZES
def test_no_text_of_the_hands_wraps_or_leaves_its_button(open_page, options):
    page = open_page(options).page
    for button, texts in {
        "hold": ["Hold to drive", "Let go to stop", "Held, not armed", "Asking"],
        "estop": ["Emergency stop", "Stopped"],
    }.items():
        for words in texts:
            lines, inside = page.evaluate(
                """([id, words]) => {
                  const button = document.getElementById(id).cloneNode();
                  button.textContent = words;
                  document.getElementById('hands').replaceChild(button, document.getElementById(id));
                  const range = document.createRange();
                  range.selectNodeContents(button);
                  return [range.getClientRects().length, button.scrollWidth <= button.clientWidth];
                }""",
                [button, words],
            )
            assert (lines, inside) == (1, True), words


@SIZES
def test_the_hands_are_in_reach_wherever_the_page_is_scrolled(open_page, options):
    page = open_page(options).page
    # A long list of acts, as after an hour of work.
    page.evaluate("document.querySelector('#acts').style.minHeight = '3000px'")
    for share in (0.0, 0.3, 0.6, 1.0):
        page.evaluate("(share) => window.scrollTo(0, share * document.documentElement.scrollHeight)", share)
        page.wait_for_timeout(100)
        for button in ("#hold", "#estop"):
            on_top = page.evaluate(
                """(selector) => {
                  const box = document.querySelector(selector).getBoundingClientRect();
                  const found = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
                  return found !== null && found.matches(selector) && box.top >= 0 && box.bottom <= window.innerHeight;
                }""",
                button,
            )
            assert on_top, (button, share)


def test_an_answer_does_not_stay_under_what_is_shown_later(open_page):
    ann = open_page(DESK)
    ann.take("Ann")
    says(ann.page, "#answer", "Done: take control.")
    ann.page.fill("#label", "a person crossed")
    ann.page.click("#label-form button")
    says(ann.page, "#answer", "Not done: label: nothing is being recorded, so the label would be lost")
    ann.page.wait_for_function("() => document.querySelector('#answer').innerText === ''", timeout=LONG_MS)
