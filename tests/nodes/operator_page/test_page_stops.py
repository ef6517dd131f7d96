"""A stop from the page when something has run out: disk, descriptors, places, pictures, numbers. Real processes and sockets."""

import json
import os
import resource
import time

import pytest

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
pytest.importorskip("websockets")

from websockets.exceptions import InvalidStatus

from nodes.runtime.arm_requests import ask_to_arm
from tests.support.disarm import ask_to_disarm
from tests.support.live.page_client import Browser, cookie_of, request
from tests.support.page import Run
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

KINDS = pytest.mark.parametrize("kind", ["estop", "disarm"])


@pytest.fixture
def run(tmp_path):
    """A page on which nobody has to hold a button, so that only the stop itself can stop the car."""
    run = Run(tmp_path, teleop="none")
    run.browsers = []
    try:
        yield run.start()
    finally:
        for browser in run.browsers:
            browser.close()
        run.close()


def browser(run, **options):
    run.browsers.append(Browser(run.port, **options))
    return run.browsers[-1]


def arm(run):
    """Arm the car. The page repeats a stop until it is answered, so the last one may still disarm a car that was armed at once."""

    def armed():
        heard = len(run.car.heard["/safety/state"]) + 2  # reports from after the answer
        if not ask_to_arm(run.folder, "").armed:
            return False
        wait_for(lambda: len(run.car.heard["/safety/state"]) > heard, "reports of the safety node")
        return run.car.armed

    wait_for(armed, "the car to be armed")


def stopped_by(run, ask, reason):
    ask()
    run.wait(lambda: not run.car.armed, "the car to be stopped", 60.0)
    assert reason in run.car.reason
    run.wait(lambda: run.car.moves[-1][1] == 0.0, "a command to brake", 60.0)


def reason_of(kind):
    return "e-stop" if kind == "estop" else "disarmed by operator: on the page by"


@KINDS
@pytest.mark.parametrize("what", ["files", "descriptors"])
def test_a_stop_needs_no_disk_and_no_descriptor_and_the_page_lives_on(run, kind, what):
    ann = browser(run)
    arm(run)
    page = run.processes["page"].pid
    if what == "files":  # as on a full disk: no file of the page may grow, or be made with content
        resource.prlimit(page, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    else:
        count = len(os.listdir(f"/proc/{page}/fd"))
        resource.prlimit(page, resource.RLIMIT_NOFILE, (count, count))
    stopped_by(run, lambda: ann.act(kind), reason_of(kind))
    ann.wait(lambda: any(a.get("act") == kind and not a["refused"] for a in ann.answers), "the answer")
    if what == "files":
        ann.wait(lambda: ann.state["log_trouble"].startswith("cannot write"), "the page to say so")
        resource.prlimit(page, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        run.wait(lambda: run.log() and run.log()[-1]["act"] == kind, "the log to be complete", 60.0)


@KINDS
def test_a_stop_is_taken_whatever_it_carries(run, kind):
    eve = browser(run)
    for more in ({}, {"frame": "77"}, {"n": -1, "key": "0" * 32, "frame": []}):
        arm(run)
        stopped_by(run, lambda more=more: eve.tell({"t": kind, **more}), reason_of(kind))
        if kind == "estop":
            eve.wait(lambda: eve.state["estop"], "the latch")
            assert eve.take() == ""
            assert eve.do("reset_estop") == ""
            assert eve.do("leave") == ""


@KINDS
def test_without_a_place_a_stop_goes_by_request_and_only_with_a_session(run, kind):
    cookie = cookie_of(run.port)
    while True:
        try:
            browser(run, cookie=cookie)
        except InvalidStatus:
            break
        assert len(run.browsers) <= 16
    good = {"Origin": f"http://127.0.0.1:{run.port}", "Cookie": cookie}
    arm(run)
    for bad in ({**good, "Cookie": "advnerf_page=1"}, {**good, "Origin": "http://evil.example"}, {}):
        assert request(run.port, f"/stop/{kind}", bad, "POST")[0] == 403
    assert request(run.port, "/stop/arm", good, "POST")[0] == 403
    assert request(run.port, f"/stop/{kind}", good)[0] == 405
    time.sleep(0.3)
    assert run.car.armed
    status, _, body = request(run.port, f"/stop/{kind}", good, "POST")
    assert (status, json.loads(body)) == (200, {"confirmed": True})
    assert not run.car.armed or run.wait(lambda: not run.car.armed, "the car to be stopped", 60.0) is None


def test_a_page_without_a_motor_node_says_that_nothing_is_confirmed(run):
    ann = browser(run)
    arm(run)
    run.car.motor = False
    stopped_by(run, lambda: ann.act("disarm"), reason_of("disarm"))
    ann.wait(lambda: "NOT CONFIRMED: disarmed, but" in ann.state["not_confirmed"], "the page to say so")
    run.car.motor = True
    ann.wait(lambda: ann.state["not_confirmed"] == "", "the confirmation")


def test_a_page_that_starts_takes_over_a_latched_e_stop_and_can_reset_it(run):
    ann = browser(run)
    assert ann.do("estop") == ""
    run.wait(lambda: "e-stop" in run.car.reason, "the latch of the safety node", 60.0)
    assert ask_to_disarm(run.folder, "", lambda waited_s: None).text.startswith("e-stop")
    run.processes["page"].kill()
    run.processes.pop("page").wait()
    ann.close()
    (run.folder / "page" / "door.json").unlink()
    run.start("page")
    bob = browser(run)
    bob.wait(lambda: bob.state["estop"], "the new page to show the latch")
    assert bob.do("reset_estop") == "nobody operates; take control first"
    assert bob.take("Bob") == ""
    assert bob.do("reset_estop") == ""
    bob.wait(lambda: not bob.state["estop"], "the reset")
    arm(run)


@KINDS
def test_a_page_that_only_watches_stops_too_and_does_nothing_else(tmp_path, kind):
    run = Run(tmp_path, teleop="none", role="watch")
    try:
        run.start()
        eve = Browser(run.port)
        assert eve.welcome["stops"]
        arm(run)
        assert eve.do("trial") == "this page only watches"
        assert eve.do("take", name="Eve") == "this page only watches"
        assert run.car.armed
        stopped_by(run, lambda: eve.act(kind), "on a page that watches")
        eve.close()
    finally:
        run.close()
