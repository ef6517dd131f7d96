"""What a person reads on the page in Chromium when pictures stop, a stop is latched, or the window is small."""

import pytest

from tests.support.live.page_browser import LONG_MS, PHONE, Phone, available, says
from tests.support.page import Run

pytestmark = [
    pytest.mark.browser,
    pytest.mark.live,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]
DESK = {"viewport": {"width": 1280, "height": 800}}
SIZES = pytest.mark.parametrize("options", [DESK, PHONE], ids=["desk", "phone"])
SCHEMES = pytest.mark.parametrize("scheme", ["light", "dark"])
LEAST_CONTRAST = 4.5  # WCAG 2.2, 1.4.3, level AA
# The texts of a part of the page whose contrast with what is behind them is too low.
POOR_CONTRAST = """([root, least]) => {
  const parse = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const luminance = ([red, green, blue]) => [[red, 0.2126], [green, 0.7152], [blue, 0.0722]].reduce((sum, [part, weight]) =>
    sum + weight * (part / 255 <= 0.04045 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4), 0);
  const behind = (node) => {
    const colour = parse(getComputedStyle(node).backgroundColor);
    return colour.length === 3 ? colour : behind(node.parentElement);
  };
  return [...document.querySelectorAll(`${root} *`)].filter((each) => each.offsetParent !== null && each.tagName !== 'INPUT'
    && [...each.childNodes].some((child) => child.nodeType === 3 && child.data.trim())).map((each) => {
      const [low, high] = [luminance(parse(getComputedStyle(each).color)), luminance(behind(each))].sort((a, b) => a - b);
      return [each.innerText, (high + 0.05) / (low + 0.05)];
    }).filter(([, contrast]) => contrast < least);
}"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    made = Run(tmp_path_factory.mktemp("run"))
    yield made.start()
    made.close()


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
        assert phone.console == []


def colour(page, selector, what="backgroundColor"):
    """Red, green and blue of a part of the page."""
    text = page.evaluate(f"(selector) => getComputedStyle(document.querySelector(selector)).{what}", selector)
    return [int(part) for part in text.removeprefix("rgb(").removesuffix(")").split(",")]


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
    says(page, "#acts", "Ann pressed the emergency stop")
    says(page, "#acts", "Ann took control")
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
        for button in ("#hold", "#estop", "#disarm"):
            on_top = page.evaluate(
                """(selector) => {
                  const box = document.querySelector(selector).getBoundingClientRect();
                  const found = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
                  const below = document.querySelector('header').getBoundingClientRect().bottom;
                  return found !== null && found.matches(selector) && box.top >= below && box.bottom <= window.innerHeight;
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


@SIZES
@SCHEMES
def test_a_latched_stop_turns_the_header_red_and_greys_what_cannot_be_used(run, open_page, options, scheme):
    ann = open_page({**options, "color_scheme": scheme})
    page = ann.page
    ann.take("Ann")
    calm = colour(page, "header")
    assert max(calm) - min(calm) < 20
    assert page.evaluate(POOR_CONTRAST, ["body", LEAST_CONTRAST]) == []
    page.locator("#estop").dispatch_event("pointerdown")
    says(page, "#armed", "EMERGENCY STOP")
    for part in ("header", "#estop"):
        red, green, blue = colour(page, part)
        assert red > 2 * max(green, blue), part
    for button in ("#hold", "#trial"):
        assert page.is_disabled(button)
        assert max(colour(page, button)) - min(colour(page, button)) < 20, f"{button} is not grey"
    for button in ("#estop", "#disarm", "#reset_estop"):
        assert page.is_enabled(button)
    assert page.evaluate(POOR_CONTRAST, ["body", LEAST_CONTRAST]) == []
    page.click("#disarm")
    says(page, "#acts", "Ann disarmed the car")
    page.click("#reset_estop")
    says(page, "#armed", "disarmed")
    assert colour(page, "header") == calm
    assert page.is_enabled("#hold")
    assert page.is_enabled("#trial")


def test_a_refusal_goes_when_its_cause_is_gone(open_page):
    ann, bob = open_page(DESK), open_page(DESK)
    page = ann.page
    ann.take("Ann")
    # Without a clock in the page, no message grows old: only the end of its cause takes it away.
    page.evaluate("() => { const now = performance.now(); performance.now = () => now; }")
    bob.page.locator("#estop").dispatch_event("pointerdown")
    says(page, "#armed", "EMERGENCY STOP")
    # A press that was on its way when the stop was latched.
    page.evaluate(
        """() => {
          const button = document.querySelector('#hold');
          button.disabled = false;
          button.dispatchEvent(new KeyboardEvent('keydown', { key: ' ' }));
        }"""
    )
    says(page, "#hold-answer", "Not held: the emergency stop is latched; release it first.")
    says(page, "#armed", "EMERGENCY STOP")
    assert "latched" in page.inner_text("#hold-answer")
    page.click("#reset_estop")
    page.wait_for_function("() => document.querySelector('#hold-answer').innerText === ''", timeout=LONG_MS)
    says(page, "#answer", "Done: release the emergency stop.")
    bob.page.locator("#estop").dispatch_event("pointerdown")
    page.wait_for_function("() => document.querySelector('#answer').innerText === ''", timeout=LONG_MS)


@SIZES
def test_the_attacked_picture_is_the_large_one(run, open_page, options):
    page = open_page(options).page
    width = "(id) => document.querySelector(id).getBoundingClientRect().width"
    large, small = page.evaluate(width, "#picture-1"), page.evaluate(width, "#picture-0")
    assert large > 1.9 * small
    assert large > 0.9 * page.evaluate(width, "#pictures")
    run.car.compositor = False  # as where a screen shows the attack, which the camera sees
    try:
        page.reload()
        page.wait_for_selector("#picture-0[data-stamp]", timeout=LONG_MS)
        assert page.is_hidden("#picture-1")
        assert page.evaluate(width, "#picture-0") == large
    finally:
        run.car.compositor = True
    page.wait_for_selector("#picture-1[data-stamp]", timeout=LONG_MS)
    assert page.evaluate(width, "#picture-0") == small
