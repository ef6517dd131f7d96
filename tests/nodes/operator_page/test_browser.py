"""The page in Chromium, driven as a person would, with the whole simulated lab behind it."""

import json
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

from advnerf_core.attack.artifact import save_attack
from advnerf_core.geometry import make_transform, rotation_z
from calibration.schema import TargetCalibration, load_calibration
from tests.support.faces import face_attack
from tests.support.live.page_browser import PHONE, Phone, available, live_page
from tests.support.page import TWIN

pytestmark = [
    pytest.mark.browser,
    pytest.mark.live,
    pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium"),
]
DESK = {"viewport": {"width": 1400, "height": 900}, "color_scheme": "dark"}


def attack_file(path):
    target = load_calibration(TargetCalibration, TWIN / "board.yaml")
    attack = face_attack(
        method="random",
        theta=np.random.default_rng(0).normal(size=(16, 16, 3)).astype(np.float32) * 3.0,
        size_m=(1.0, 1.0),
        subject="board",
        corners_in_subject=target.corners,
        T_world_from_object=make_transform(rotation_z(np.deg2rad(172)), [3.15, -1.75, 0.42]),
        predicted_total_cte_m=9.9,
    )
    save_attack(path, attack)
    return attack.attack_id


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    file = tmp_path_factory.mktemp("attack") / "noise.attack.safetensors"
    attack_id = attack_file(file)
    with live_page(f"params.attacks=[{file}]", "page.trial_ticks=20") as operator:
        operator.attack_id = attack_id
        yield operator


@pytest.fixture
def phones(lab, playwright):
    made = []

    def make(options=None):
        made.append(Phone(playwright, lab.run_dir, options=options))
        made[-1].open()
        return made[-1]

    yield make
    for phone in made:
        phone.close()


def says(page, selector, words, timeout_ms=8000):
    page.wait_for_function(
        "([selector, words]) => document.querySelector(selector).innerText.includes(words)",
        arg=[selector, words],
        timeout=timeout_ms,
    )


def drive(page, hold, let_go, *seen):
    """Hold until the car drives, and until pages say what is to be seen then (page, selector, words).

    On a busy computer the safety node may stop it; a person lets go and holds again.
    """
    from playwright.sync_api import TimeoutError as NotYet

    for _ in range(20):
        hold()
        try:
            for where, selector, words in ((page, "#armed", "ARMED"), *seen):
                says(where, selector, words, timeout_ms=2000)
        except NotYet:
            let_go()
            page.wait_for_timeout(500)
        else:
            return
    raise AssertionError(f"not armed: {page.inner_text('#reason')}")


def put_back(page):
    """Begin a trial, which puts the simulated car to the start, and end it."""
    if page.is_hidden("#trial_end"):  # else a test before this one left a trial behind
        page.click("#trial")
    page.click("#trial_end")
    says(page, "#trial-text", "has ended")


@pytest.mark.parametrize("options", [DESK, PHONE], ids=["desk", "phone"])
def test_arm_drive_attack_on_disarm_while_another_watches(lab, phones, options):
    ann, bob = phones(options), phones(DESK)
    page, watcher = ann.page, bob.page
    says(page, "#lease", "Nobody operates")
    ann.take()
    says(watcher, "#lease", "Ann operates; you watch")
    assert watcher.is_disabled("#hold")
    assert watcher.is_disabled("#trial")
    put_back(page)
    drive(page, ann.hold, ann.let_go, (watcher, "#armed", "ARMED"), (page, "#hold", "Let go to stop"))
    page.wait_for_timeout(500)
    page.keyboard.press("Tab")  # the focus leaves the button, and with it the hand
    says(page, "#armed", "disarmed")
    ann.let_go()
    put_back(page)
    page.locator(f"#attacks button[data-id='{lab.attack_id}']").click()
    page.locator("#hold").scroll_into_view_if_needed()
    drive(page, ann.hold, ann.let_go, (watcher, "#attack-text", f"Attack {lab.attack_id} is shown"))
    ann.let_go()
    says(page, "#armed", "disarmed")
    page.click("#attack_off")
    says(page, "#attack-text", "switched off by Ann")
    page.click("#disarm")
    says(page, "#reason", "disarmed by operator: on the page by Ann")
    page.fill("#label", "a person crossed")
    page.click("#label-form button")
    says(watcher, "#acts", "a person crossed")
    page.click("#leave")
    says(watcher, "#lease", "Nobody operates")
    for phone in (ann, bob):
        assert phone.console == []
        assert {urlsplit(url).hostname for url in phone.requests} == {"127.0.0.1"}


def test_a_trial_is_driven_to_its_end_and_measured(lab, phones):
    ann = phones(DESK)
    ann.take("Ann T")
    for _ in range(10):
        ann.page.click("#trial")
        says(ann.page, "#trial-text", "hold the button to begin")
        # The car was just put to the start, which the safety node must have seen.
        ann.page.wait_for_timeout(500)
        drive(ann.page, ann.hold, ann.let_go)
        # A busy computer may stop it before its end, and then it is no result.
        ann.page.wait_for_function(
            "() => /total cross-track error|is no result/.test(document.querySelector('#trial-text').innerText)",
            timeout=20000,
        )
        says(ann.page, "#armed", "disarmed")
        ann.let_go()
        if "20 of 20" in (ended := ann.page.inner_text("#trial-text")):
            break
    assert "total cross-track error" in ended
    rows = [json.loads(line) for line in (lab.run_dir / "page" / "acts.jsonl").read_text().splitlines()]
    held = [row for row in rows if row["act"] == "hold"][-1]
    assert held["operator"] == "Ann T"
    assert 0 < time.time() - held["frame_ns"] / 1e9 < 60


def test_with_the_keyboard_alone(lab, phones):
    ann = phones(DESK)
    page = ann.page
    page.focus("#name")
    page.keyboard.type("Kim")
    page.keyboard.press("Enter")
    says(page, "#lease", "You operate as Kim")
    put_back(page)
    page.focus("#hold")
    space = (lambda: page.keyboard.down(" "), lambda: page.keyboard.up(" "))
    drive(page, *space)
    page.keyboard.press("Escape")
    says(page, "#armed", "EMERGENCY STOP")
    page.keyboard.up(" ")
    says(page, "#estop", "Stopped")
    says(page, "#reason", "e-stop")
    assert page.is_disabled("#hold")
    page.focus("#reset_estop")
    page.keyboard.press("Enter")
    page.wait_for_selector("#reset_estop", state="hidden")
    page.wait_for_timeout(400)
    assert page.inner_text("#armed") == "disarmed"
    page.focus("#hold")
    drive(page, *space)
    page.keyboard.up(" ")
    says(page, "#armed", "disarmed")


def test_another_tab_in_front_is_a_locked_phone(lab, phones):
    ann = phones(PHONE)
    ann.take()
    put_back(ann.page)
    drive(ann.page, ann.hold, ann.let_go)
    session = ann.context.new_cdp_session(ann.page)
    session.send("Page.setWebLifecycleState", {"state": "frozen"})
    lab.wait_until(lambda: not lab.armed, 2.0, "the frozen page to let go")
    session.send("Page.setWebLifecycleState", {"state": "active"})
    says(ann.page, "#armed", "disarmed")
    lab.watch(0.5)
    assert not lab.armed


def test_screen_readers_find_names_roles_and_live_regions(phones):
    page = phones(PHONE).page
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll('button, input, canvas, section, table')].filter((each) => {
             const label = each.labels && each.labels.length ? each.labels[0].innerText : '';
             const by = each.getAttribute('aria-labelledby');
             const named = each.getAttribute('aria-label') || label || each.innerText.trim() || (by && document.getElementById(by));
             return !named;
           }).map((each) => each.outerHTML)"""
    )
    assert unnamed == []
    assert page.get_by_role("button", name="Hold to drive").count() == 1
    assert page.get_by_role("button", name="Emergency stop").count() == 1
    assert page.get_by_role("heading", level=1).count() == 1
    assert page.get_by_role("status").count() >= 4
    # Nothing is wider than the phone.
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
