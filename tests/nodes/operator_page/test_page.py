"""The page node with real processes and sockets: who may act, and what stops the car."""

import json
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.driving.metrics import Horizon, drive_metrics, states_at_ticks
from advnerf_core.geometry import planar_pose
from calibration.schema import RoomCalibration, load_calibration
from nodes.runtime.clock import ManualClock
from nodes.runtime.messages import header, pose_message, types
from nodes.runtime.node import MessageInfo, NodeContext

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
pytest.importorskip("websockets")

from nodes.page import PageConfig, PageNode
from tests.support.faces import red_attack
from tests.support.live.page_client import Browser, cookie_of, request
from tests.support.messages import filled
from tests.support.page import IN_TIME, TWIN, Run
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    run = Run(tmp_path_factory.mktemp("page"))
    try:
        yield run.start()
    finally:
        run.close()


@pytest.fixture(params=IN_TIME)
def stop_s(request):
    """So long a stop may take [s]."""
    return request.param


@pytest.fixture
def browser(run):
    made = []

    def make(*arguments, **options):
        made.append(Browser(run.port, *arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def drive(run, ann):
    """Hold until the car moves; a press that load ended is made again."""

    def moves():
        pressed_s, since_ns = time.monotonic(), time.monotonic_ns()
        ann.hold()
        while time.monotonic() < pressed_s + 5.0:
            if run.car.armed and any(t > since_ns and speed > 0.0 for t, speed in list(run.car.moves)):
                return True
            time.sleep(0.01)
        ann.release()
        return False

    wait_for(moves, "a command to move", 120.0)


def test_the_car_drives_while_the_button_is_held(run, browser, stop_s):
    ann = browser()
    assert ann.take() == ""
    drive(run, ann)
    time.sleep(0.5)
    assert run.car.armed
    since_ns = time.monotonic_ns()
    assert ann.release() == ""
    run.wait(lambda: not run.car.armed, "the car to be disarmed")
    assert run.car.stop_after(since_ns) < stop_s
    assert run.car.reason == "the button is not held"
    held = [act for act in run.car.acts if act.act == "hold"][-1]
    assert (held.operator, held.granted, held.address) == ("Ann", True, "127.0.0.1")
    seen_ns = held.seen.sec * 10**9 + held.seen.nanosec
    assert seen_ns in {int(stamp) for _, stamp, _ in ann.pictures}
    row = [row for row in run.log() if row["act"] == "hold"][-1]
    assert (row["operator"], row["frame_ns"], row["refused"]) == ("Ann", seen_ns, "")


def test_the_page_shows_what_happens(run, browser):
    ann = browser()
    ann.take()
    ann.wait(lambda: len(ann.pictures) > 6, "pictures")
    channel, _, jpeg = ann.pictures[-1]
    assert channel in (0, 1)
    assert jpeg.startswith(b"\xff\xd8")
    assert ann.welcome["operates"]
    assert len(ann.welcome["fence"]) >= 3
    state = ann.state
    assert state["car"]["cte_m"] is not None
    assert {node["name"] for node in state["nodes"]} == {"page", "safety"}
    assert state["recording"]["disk_left_gb"] > 0.0
    assert state["hint"] == ""


@pytest.mark.parametrize("how", ["closed", "killed", "silent", "blind"])
def test_a_browser_that_goes_stops_the_car(run, browser, stop_s, how):
    ann = browser()
    ann.take()
    drive(run, ann)
    since_ns, before = time.monotonic_ns(), len(run.car.acts)
    if how == "closed":
        ann.close()
    elif how == "killed":
        ann.cut()
    elif how == "silent":
        ann.responsive = False  # frozen: it neither answers beats nor draws
    else:
        run.car.pictures = False
        run.wait(lambda: not run.car.armed, "the car to be disarmed")
        run.car.pictures = True
        assert 0.8 < run.car.stop_after(since_ns) < 1.0 + stop_s
        # The act comes from the page, the state from the safety node: either may be heard first.
        run.wait(
            lambda: any(act.act == "let_go" for act in run.car.acts[before:]), "the reason for letting go"
        )
        let_go = next(act for act in run.car.acts[before:] if act.act == "let_go")
        assert re.match(r"the picture on the page is [1-9]", let_go.detail)
        return
    run.wait(lambda: not run.car.armed, "the car to be disarmed")
    assert run.car.stop_after(since_ns) < stop_s
    if how == "silent":
        ann.responsive = True
        time.sleep(0.5)
        assert not run.car.armed, "the earlier press must not continue"
        drive(run, ann)  # a new one does


def test_answers_to_old_beats_do_not_hold(run, browser):
    ann = browser()
    ann.take()
    ann.wait(lambda: len(ann.beats) > 20, "beats")
    ann.responsive = False
    for beat in ann.beats[:12]:
        ann.act("hold", beat=beat, press=1)
    time.sleep(0.3)
    assert not run.car.armed
    assert ann.state["held"] is False
    assert {a["refused"] for a in ann.answers if a["t"] == "answer" and a["act"] == "hold"} == {
        "the answer of the page is too old"
    }


def test_a_page_node_that_hangs_stops_the_car(run, browser, stop_s):
    ann = browser()
    ann.take()
    drive(run, ann)
    since_ns = time.monotonic_ns()
    run.processes["page"].send_signal(signal.SIGSTOP)
    try:
        assert run.car.stop_after(since_ns) < stop_s
    finally:
        run.processes["page"].send_signal(signal.SIGCONT)
    time.sleep(0.5)
    assert not run.car.armed


def test_one_operator_and_others_who_watch(run, browser):
    ann, bob = browser(), browser()
    assert ann.take() == ""
    assert bob.take("Bob") == "Ann operates; one operator at a time"
    bob.hold()
    bob.wait(lambda: bob.state["lease"] is not None, "the lease")
    assert bob.state["lease"]["name"] == "Ann"
    for act in ("trial", "record", "attack_off", "reset_estop", "leave"):
        assert bob.do(act) == "Ann operates; one operator at a time"
    assert bob.do("label", text="mine") == "Ann operates; one operator at a time"
    time.sleep(0.2)
    assert not run.car.armed
    assert ann.do("leave") == ""
    assert bob.take("Bob") == ""
    bob.hold()
    run.wait(lambda: run.car.armed, "Bob to drive")
    assert ann.do("disarm") == "", "anyone who watches may stop the car"
    run.wait(lambda: not run.car.armed, "the car to be disarmed")


def test_the_e_stop_of_a_watcher_latches_until_the_operator_resets_it(run, browser, stop_s):
    ann, bob = browser(), browser()
    ann.take()
    drive(run, ann)
    since_ns = time.monotonic_ns()
    assert bob.do("estop") == ""
    run.wait(lambda: not run.car.armed, "the car to be disarmed")
    assert run.car.stop_after(since_ns) < stop_s
    ann.held = False
    ann.hold()
    time.sleep(0.3)
    assert not run.car.armed
    assert ann.state["estop"]
    run.wait(lambda: "e-stop" in run.car.reason, "the safety node's own latch")
    assert ann.do("reset_estop") == ""
    time.sleep(0.4)
    assert not run.car.armed, "a reset arms nothing"
    ann.release()
    drive(run, ann)
    ann.release()


def test_a_label_is_in_the_bag_with_the_picture_that_its_author_saw(run, browser):
    from nodes.bags.reader import read_messages
    from nodes.runtime.messages import decode

    ann = browser()
    ann.take()
    lost = "nothing is being recorded, so the label would be lost; start recording first"
    assert ann.do("label", text="too early") == lost
    assert ann.do("record") == ""
    assert ann.do("record").startswith("already recording")
    # The process has just been started, and takes longer than this to connect.
    assert (
        ann.do("label", text="still too early") == "the recorder is still starting; label again in a second"
    )
    ann.wait(lambda: ann.state["recording"]["records"], "the recorder to receive messages of the page")
    assert ann.do("label", text="a person crossed") == ""
    assert ann.do("record_stop") == ""
    ann.wait(lambda: not ann.state["recording"]["on"], "the recorder to end")
    assert ann.state["recording"]["trouble"] == ""
    bag = run.folder / ann.state["recording"]["folder"]
    acts = [decode("advnerf_msgs/msg/OperatorAct", m.cdr) for m in read_messages(bag, ["/operator/act"])]
    (label,) = [act for act in acts if act.act == "label"]
    assert (label.operator, label.detail, label.granted) == ("Ann", "a person crossed", True)
    assert label.seen.sec > 0


def test_a_trial_runs_from_the_first_motion_and_is_measured(tmp_path):
    run = Run(tmp_path, trial_ticks=5)
    try:
        run.start()
        ann = Browser(run.port)
        ann.take()
        assert ann.do("estop") == ""
        assert ann.do("trial") == "the emergency stop is latched; release it first"
        assert ann.do("reset_estop") == ""
        assert ann.do("trial") == ""
        ann.wait(lambda: ann.state["trial"]["phase"] == "waiting", "the trial to wait for the car")
        run.car.goes_to_m = 0.012
        drive(run, ann)
        assert ann.do("trial") == "the car is armed; release the button first"
        ann.wait(lambda: ann.state["trial"]["phase"] == "done", "the trial to end")
        run.wait(lambda: not run.car.armed, "the end of the trial to let go")
        trial = ann.state["trial"]
        assert (trial["ticks"], trial["number"]) == (5, 1)
        # The car stands again after this centimetre, so its error is the same at all five ticks.
        assert trial["total_cte_m"] == pytest.approx(5 * abs(ann.state["car"]["cte_m"]), abs=0.01)
        ann.close()
    finally:
        run.close()


def test_a_trial_is_measured_by_every_pose_and_not_by_those_at_the_pages_own_ticks(tmp_path):
    """The total is that of the bag: the same start, the same states at the same ticks."""
    run, clock = Run(tmp_path), ManualClock(10**10, 1_800_000_000_000_000_000)
    config = PageConfig.model_validate(run.configs["page"])
    node = PageNode.build(config, NodeContext("page", tmp_path, clock))
    horizon, room = Horizon(config.trial_ticks), load_calibration(RoomCalibration, TWIN / "room.yaml")
    stamps, poses = [], []
    try:
        node._operation.trial.start()
        for ms in range(0, 6600, 10):
            now = clock.now()
            info = MessageInfo(now.mono_ns, now.mono_ns)
            if ms % 100 == 0:
                state = filled(types.SafetyState, header=header(now.real_ns), armed=ms >= 100)
                node.handle("/safety/state", state, info, now)
            moving_s = max(0, ms - 200) / 1000
            x_m, y_m = 0.8 * moving_s, -2.0 + 0.1 * np.sin(7.0 * moving_s)
            pose = pose_message(planar_pose(x_m, y_m, 0.0), now.real_ns)
            node.handle("/vicon/car", pose, info, now)
            if stamps or np.hypot(x_m, y_m + 2.0) > 0.01:  # a centimetre from where it was armed
                stamps.append(now.real_ns)
                poses.append((x_m, y_m, 0.0))
            if ms % 170 == 0:
                node.tick(now)
            clock.advance(0.01)
        shown = node._operation.trial.state()
    finally:
        node.close()
    states = states_at_ticks(np.array(stamps), np.array(poses), stamps[0], horizon)
    expected = drive_metrics(room.reference_path, states, horizon)
    assert (shown["phase"], shown["ticks"]) == ("done", horizon.ticks)
    assert shown["total_cte_m"] == pytest.approx(expected.total_cte_m, abs=1e-9)


def test_another_attack_waits_for_the_end_of_a_trial(tmp_path):
    run = Run(tmp_path, trial_ticks=3000)
    try:
        run.start()
        ann = Browser(run.port)
        ann.take()
        assert ann.do("trial") == ""
        assert ann.do("attack_off") == ""
        run.car.goes_to_m = 0.012
        drive(run, ann)
        ann.wait(lambda: ann.state["trial"]["phase"] == "running", "the trial to run")
        refusal = "a trial is running, of one attack; end it first"
        assert [ann.do("attack_off"), ann.do("attack", id="0" * 12)] == [refusal, refusal]
        assert ann.do("trial_end") == ""
        assert ann.do("attack_off") == ""
        ann.close()
    finally:
        run.close()


def test_without_a_held_button_the_page_says_so_and_arms_nothing(tmp_path):
    run = Run(tmp_path, teleop="none")
    try:
        run.start()
        ann = Browser(run.port)
        assert "launch with --set safety.teleop=hold" in ann.state["hint"]
        ann.take()
        ann.hold()
        time.sleep(0.5)
        assert not run.car.armed
        assert ann.do("estop") == ""
        assert ann.do("reset_estop") == ""
        time.sleep(0.5)
        assert not run.car.armed, "a reset is no request to arm"
        ann.close()
    finally:
        run.close()


def test_strangers_do_nothing_and_the_page_stays_up(run, browser):
    from websockets.exceptions import InvalidStatus

    ann = browser()
    ann.take()
    time.sleep(0.3)
    before = len(run.car.acts)
    good = cookie_of(run.port)
    origins = ["http://evil.example", f"https://127.0.0.1:{run.port}", "null", f"http://localhost:{run.port}"]
    for origin in origins:
        with pytest.raises(InvalidStatus, match="403"):
            Browser(run.port, good, origin)
    for cookie in ("", "advnerf_page=1", good[:-1] + ("0" if good[-1] != "0" else "1")):
        with pytest.raises(InvalidStatus, match="403"):
            Browser(run.port, cookie)
    assert request(run.port, headers={"Host": "evil.example"})[0] == 421
    assert request(run.port, "/session", {"Host": f"evil.example:{run.port}"})[0] == 421
    assert request(run.port, "/web/../desk.py")[0] == 404
    assert request(run.port, "/web/%2e%2e%2fdesk.py")[0] == 404
    assert request(run.port, "/attack/000000000000")[0] == 404
    time.sleep(0.3)
    assert len(run.car.acts) == before
    assert ann.do("attack_off") == "", "the page is still here"


def test_a_replayed_or_malformed_message_is_no_act(run, browser):
    ann, eve = browser(), browser()
    ann.take()
    number = ann.act("label", text="once")  # it is refused, because nothing is recorded
    ann.wait(lambda: any(a.get("n") == number for a in ann.answers), "the answer")
    time.sleep(0.3)
    message = {"t": "label", "key": ann.welcome["key"], "n": number, "frame": ann.frame, "text": "once"}
    before = len(run.car.acts)
    ann.tell(message)  # the same bytes again
    eve.tell({**message, "n": number + 1})  # in another connection
    eve.tell({**message, "n": number + 1, "frame": "1"})
    for text in ("{}", "nonsense", json.dumps({"t": "arm"})):
        eve.send_text(text)
    eve.wait(lambda: len([a for a in eve.answers if a["t"] == "refused"]) == 5, "five refusals")
    for _ in range(100):
        eve.tell({"t": "arm"})
    eve.wait(lambda: eve.closed, "the connection to be closed")
    assert len(run.car.acts) == before
    assert ann.do("attack_off") == "", "the page is still here"


def test_the_headers_keep_foreign_code_out(run):
    status, headers, body = request(run.port)
    assert status == 200
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["set-cookie"] is None
    cookie = request(run.port, "/session")[1]["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    assert b"//" not in body.replace(b"//www.w3.org", b""), "nothing from elsewhere"
    assert request(run.port, "/docs")[0] == 404


def test_off_the_machine_there_is_tls_and_a_code(tmp_path):
    from websockets.exceptions import InvalidStatus

    run = Run(tmp_path, host="0.0.0.0", code_s=3.0)
    try:
        run.start(environment={"XDG_CONFIG_HOME": str(tmp_path / "config")})
        port, door = run.port, run.door
        assert door["url"].startswith("https://")
        assert len(door["fingerprint"].split(":")) == 32
        status, headers, _ = request(port, "/session", tls=True)
        assert (status, headers["set-cookie"]) == (200, None)
        origin = {"Origin": f"https://127.0.0.1:{port}"}

        def enter(code, headers=origin, **options):
            body = json.dumps({"code": code})
            return request(port, "/enter", headers, "POST", body, tls=True, **options)

        assert enter(run.door["code"], {"Origin": "https://evil.example"})[0] == 403
        assert enter("AAAAAAAA")[0] == 403
        old = run.door["code"]
        run.wait(lambda: run.door["code"] != old, "a new code")
        assert enter(old)[0] == 403, "it has expired"
        code = run.door["code"]
        status, headers, _ = enter(code)
        assert status == 200
        cookie = headers["set-cookie"]
        assert "Secure" in cookie
        assert enter(code)[0] == 403, "it was used"
        token = cookie.partition(";")[0]
        with pytest.raises(InvalidStatus, match="403"):
            Browser(port, "", tls=True)
        ann = Browser(port, token, tls=True)
        assert ann.take() == ""
        ann.hold()
        run.wait(lambda: run.car.armed, "the car to be armed")
        ann.close()
        # The same cookie from another address is a stolen one.
        session = request(port, "/session", {"Cookie": token}, tls=True, source=("127.0.0.2", 0))
        assert json.loads(session[2])["open"] is False
        assert json.loads(request(port, "/session", {"Cookie": token}, tls=True)[2])["open"] is True
    finally:
        run.close()


def test_a_folder_of_attacks_may_name_them_by_their_ids_and_says_what_is_none(tmp_path):
    import torch
    from safetensors.torch import save_file

    from nodes.operator_page.catalogue import read_catalogue

    published = Path(__file__).parents[3] / "docs" / "results" / "paper_monitor" / "attacks"
    entries, left_out = read_catalogue([published])
    assert {file.stem for file in published.iterdir()} == {entry.facts["name"] for entry in entries.values()}
    assert left_out == []
    (tmp_path / "empty").mkdir()
    for name, kind, form in (
        ("network", torch.bfloat16, None),
        ("policy", torch.float32, "advnerf-policy-1"),
        ("scene", torch.uint8, "advnerf-scene-2"),
    ):
        file = tmp_path / f"{name}.safetensors"
        save_file({"w": torch.zeros(4, dtype=kind)}, file, form and {"format": form})
    run = Run(tmp_path, attacks=[str(tmp_path), str(tmp_path / "empty"), str(tmp_path / "none.safetensors")])
    try:
        run.start()
        said = [
            line for line in (tmp_path / "page.log").read_text().splitlines() if line.startswith("page: ")
        ]
    finally:
        run.close()
    begins = [
        f"page: {tmp_path}: expected attack files (*.safetensors), found none; correct the folder",
        f"page: network.safetensors: cannot read {tmp_path}/network.safetensors as an attack file",
        "page: policy.safetensors: expected",
        "page: scene.safetensors: expected",
        f"page: {tmp_path / 'empty'}: expected attack files (*.safetensors), found none; correct the folder",
        f"page: none.safetensors: expected an attack file at {tmp_path}/none.safetensors, found none",
    ]
    assert [line[: len(begin)] for line, begin in zip(said, begins, strict=True)] == begins
    assert said[2].endswith("got 'advnerf-policy-1'")


def test_an_attack_is_chosen_and_switched_off(tmp_path):
    import numpy as np

    from advnerf_core.attack.artifact import attack_from_bytes, save_attack
    from nodes.runtime.transfer import Assembler
    from tests.support.faces import face_attack

    theta = np.random.default_rng(0).normal(size=(8, 8, 3)).astype(np.float32)
    attack = face_attack(
        method="gradient",
        theta=theta,
        size_m=(0.6, 0.6),
        subject="board",
        corners_in_subject=np.zeros((4, 3)),
        T_world_from_object=np.eye(4),
        seed=3,
        predicted_total_cte_m=12.5,
    )
    save_attack(tmp_path / "strong.attack.safetensors", attack)
    run = Run(tmp_path, attacks=[str(tmp_path / "strong.attack.safetensors")])
    try:
        run.start()
        ann = Browser(run.port)
        facts = ann.welcome["attacks"][0]
        assert (facts["id"], facts["name"], facts["predicted_m"]) == (attack.attack_id, "strong", 12.5)
        status, headers, png = request(
            run.port, f"/attack/{attack.attack_id}", {"Cookie": cookie_of(run.port)}
        )
        assert (status, headers["content-type"], png[:4]) == (200, "image/png", b"\x89PNG")
        assert request(run.port, f"/attack/{attack.attack_id}")[0] == 404, "only with a session"
        assert ann.do("attack", id=attack.attack_id) == "nobody operates; take control first"
        ann.take()
        assert ann.do("attack", id="0" * 12) == "no attack 000000000000 among the 1 of this page"
        assert ann.do("attack", id=attack.attack_id) == ""
        run.wait(lambda: "/attack/switch" in run.car.heard, "the switch")
        run.wait(
            lambda: any(m.index + 1 == m.count for _, m in run.car.heard.get("/attack/file", ())), "the file"
        )
        assembler = Assembler()
        whole = [assembler.add(message, 1) for _, message in run.car.heard["/attack/file"]]
        received = next(file for file, _ in whole if file is not None)
        assert attack_from_bytes(received.content, "test").attack_id == attack.attack_id
        assert run.car.newest["/attack/switch"].show
        assert ann.do("attack_off") == ""
        run.wait(lambda: not run.car.newest["/attack/switch"].show, "the attack to be switched off")
        assert run.car.newest["/attack/switch"].source == "Ann"
        ann.close()
    finally:
        run.close()


def test_an_attack_that_was_switched_off_stays_so_when_page_and_compositor_start_again(tmp_path):
    """The page said that it was chosen to be shown, and no longer repeated that it was not."""
    attack, file = red_attack(tmp_path, "board")
    run = Run(tmp_path, attacks=[str(file)])
    run.configs["compositor"] = {"camera": str(TWIN / "camera.yaml"), "target": str(TWIN / "board.yaml")}
    run.car.compositor = False

    def again(name):
        run.processes[name].kill()
        run.processes[name].wait()
        run.start(name)

    def seen(browser, reason):
        return (browser.state["attack"] or {}).get("reason") == reason

    try:
        run.start()
        ann = Browser(run.port)
        ann.wait(lambda: ann.state["attack"], "a label of the compositor")
        assert ann.state["chosen"]["show"]
        ann.take()
        assert ann.do("attack_off") == ""
        ann.wait(lambda: seen(ann, "switched off by Ann"), "the attack to be switched off")
        (tmp_path / "page" / "door.json").unlink()
        again("page")
        bob = Browser(run.port)
        bob.wait(lambda: not bob.state["chosen"]["show"], "the choice to be taken over")
        again("compositor")
        since_ns = time.monotonic_ns()
        run.wait(lambda: run.car.heard["/attack/switch"][-1][0] > since_ns, "the choice to be repeated")
        switch = run.car.newest["/attack/switch"]
        assert (switch.show, switch.source) == (False, "Ann")
        bob.wait(lambda: seen(bob, "switched off by Ann"), "the new compositor to hear it")
        assert bob.take("Bob") == ""
        assert bob.do("attack", id=attack.attack_id) == ""
        bob.wait(lambda: bob.state["chosen"]["show"], "the choice of Bob")
        run.wait(lambda: run.car.newest["/attack/switch"].show, "the attack to be switched on")
        assert bob.state["chosen"]["show"], "an earlier label does not undo a choice"
    finally:
        run.close()
