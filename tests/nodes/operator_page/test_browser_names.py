"""Who did what, by name: a code that is entered with a name, in Chromium, over TLS, with real processes."""

import signal

import pytest

from tests.support.live.page_browser import PHONE, Phone, available, says
from tests.support.page import Run

pytestmark = [
    pytest.mark.browser,
    pytest.mark.live,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]


@pytest.fixture
def run(tmp_path):
    made = Run(tmp_path, host="0.0.0.0")
    try:
        yield made.start(environment={"XDG_CONFIG_HOME": str(tmp_path / "config")})
    finally:
        made.close()


@pytest.fixture
def phones(run, playwright):
    made = []

    def make(name=""):
        made.append(Phone(playwright, run.folder))
        made[-1].open(name)
        return made[-1]

    yield make
    for phone in made:
        phone.close()


def test_the_log_names_people(run, phones):
    ana, mallory, nameless = phones("Ana"), phones('<img src=x onerror="alert(1)">'), phones()
    assert ana.page.input_value("#name") == "Ana"
    nameless.page.click("#disarm")
    says(ana.page, "#acts", "watcher 3 disarmed the car")
    mallory.page.click("#disarm")
    says(ana.page, "#acts", '<img src=x onerror="alert(1)"> disarmed the car')
    assert ana.page.locator("#acts img").count() == 0
    ana.page.locator("#estop").dispatch_event("pointerdown")
    says(nameless.page, "#acts", "Ana pressed the emergency stop")  # she watches, and has her name
    ana.page.fill("#name", "Ana M.")
    ana.page.click("#take-form button")
    says(ana.page, "#lease", "You operate as Ana M.")
    ana.page.click("#reset_estop")
    says(ana.page, "#acts", "Ana M. released the emergency stop")
    ana.hold()
    says(nameless.page, "#acts", "Ana M. armed the car")
    ana.let_go()
    says(nameless.page, "#acts", "Ana M. let go of the button")
    ana.page.fill("#label", "a person crossed")
    ana.page.click("#label-form button")
    says(nameless.page, "#acts", "Ana M. was refused: label: nothing is being recorded")
    ana.page.click("#leave")
    says(nameless.page, "#acts", "Ana M. gave control back")
    ana.page.reload()  # the session keeps the name
    ana.page.wait_for_selector("#main:not([hidden])")
    ana.page.click("#disarm")
    says(nameless.page, "#acts", "Ana M. disarmed the car")
    run.wait(lambda: run.log()[-1]["operator"] == "Ana M.", "the log")
    assert {row["operator"] for row in run.log()} >= {"Ana", "Ana M.", "watcher 3"}
    for phone in (ana, mallory, nameless):
        assert phone.console == []


def test_a_name_that_cannot_be_printed_costs_no_code(run, playwright):
    phone = Phone(playwright, run.folder)
    try:
        code = run.door["code"]
        page = phone.context.new_page()
        page.goto(run.door["url"])
        page.wait_for_selector("#enter:not([hidden])")
        page.fill("#code", code)
        page.fill("#who", "Ana\u202eanA")
        page.click("#enter-form button")
        says(page, "#enter-answer", "characters that cannot be printed")
        page.fill("#who", "x" * 60)
        assert page.input_value("#who") == "x" * 40
        assert page.inner_text("#enter-answer") == "", "the answer to what is no longer there"
        page.fill("#who", "Ana")
        page.click("#enter-form button")
        page.wait_for_selector("#main:not([hidden])")
    finally:
        phone.close()


@pytest.mark.parametrize(
    "options", [{"viewport": {"width": 1280, "height": 800}}, PHONE], ids=["desk", "phone"]
)
def test_without_a_connection_the_stops_remain_and_the_rest_is_grey(run, playwright, options):
    phone = Phone(playwright, run.folder, options=options)
    try:
        phone.open("Ana")
        phone.take("Ana")
        run.processes["page"].send_signal(signal.SIGKILL)
        says(phone.page, "#armed", "no connection")
        for button in ("#hold", "#trial", "#attack_off", "#record", "#label-form button"):
            assert phone.page.is_disabled(button), button
        for button in ("#estop", "#disarm"):
            assert phone.page.is_enabled(button), button
        assert phone.page.inner_text("#answer") == ""
    finally:
        phone.close()
