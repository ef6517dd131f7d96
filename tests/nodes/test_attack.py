import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from advnerf_core.attack.artifact import attack_from_bytes, load_attack
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from nodes.attack import AttackNode, AttackNodeConfig
from nodes.cli.attack_node import in_words
from nodes.experiment.node import job, search
from nodes.experiment.node.client import ask_for_attack, cancel_attack, new_request_id
from nodes.experiment.node.prepare import request_text
from nodes.runtime.bus import Bus
from nodes.runtime.clock import ManualClock, SystemClock
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import decode, encode, header, image_message, pose_message, type_name, types
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.pictures import rgb_image
from nodes.runtime.transfer import Assembler, FileSender, chunk_messages
from tests.support.messages import filled
from tests.support.tiny_request import loaded, tiny_request

REPOSITORY = Path(__file__).parents[2]
CALIBRATION = REPOSITORY / "calibration" / "twin"


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")


class Bench:
    """Runs a node as its loop would, in this thread, on the real clock, every message through CDR."""

    def __init__(self, run_dir, **config):
        self.out, self.clock = [], SystemClock()
        self.node = AttackNode.build(
            AttackNodeConfig(repeat_s=0.0, **config), NodeContext("attack", run_dir, ManualClock())
        )

    def send(self, topic, message):
        began = time.monotonic()
        raw = encode(message)
        self._take(
            self.node.handle(
                topic, decode(type_name(message), raw), MessageInfo(0, 0, raw=raw), self.clock.now()
            )
        )
        return time.monotonic() - began

    def request(self, text, request_id="a"):
        return self.send(
            "/attack/request",
            filled(types.AttackRequest, request_id=request_id, request=text),
        )

    def cancel(self, request_id=""):
        return self.send(
            "/attack/cancel",
            types.AttackCancel(header=header(0), request_id=request_id, reason="enough", ask_id=""),
        )

    def run_until(self, condition, timeout_s=300.0):
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, self.progress()[-1:]
            for item in self.node.inbox.take():
                self._take(self.node.receive(item, self.clock.now()))
            self._take(self.node.tick(self.clock.now()))
            time.sleep(0.005)

    def _take(self, outs):
        self.out += [(topic, decode(type_name(message), encode(message))) for topic, message in outs]
        assert {topic for topic, _ in outs} <= set(self.node.publications)

    def of(self, topic):
        return [message for name, message in self.out if name == topic]

    def progress(self):
        return self.of("/attack/progress")

    def state(self):
        return self.progress()[-1].state if self.progress() else ""

    def close(self):
        self.node.close()
        self.node.inbox.close()


@pytest.fixture
def bench(tmp_path):
    made = Bench(tmp_path / "run")
    yield made
    made.close()


def on_one_thread(work):
    """As the node of these tests searches: torch's convolutions have other last bits on several threads, on some processors."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return work()
    finally:
        torch.set_num_threads(threads)


def test_a_request_ends_in_the_attack_file_that_the_command_would_have_written(bench, tmp_path):
    request = loaded(tiny_request(tmp_path, evaluations=3))
    assert bench.node.status() == ("ready", "waiting for a request")
    bench.request(request_text(request))
    assert bench.state() == "preparing"
    bench.run_until(
        lambda: (
            bench.of("/attack/file") and len(bench.of("/attack/file")) >= bench.of("/attack/file")[0].count
        )
    )
    states = [message.state for message in bench.progress()]
    assert states[0] == "preparing"
    assert "searching" in states
    last = bench.progress()[-1]
    assert (last.state, last.evaluation, last.evaluations, last.request_id) == ("done", 3, 3, "a")
    assert np.isfinite(last.loss_m)
    assert last.best_total_cte_m >= last.total_cte_m > 0.0
    expected = on_one_thread(lambda: search.run_attack(request, tmp_path / "direct", _Silent()))[
        0
    ].read_bytes()
    (chunk, *_) = bench.of("/attack/file")
    assert (chunk.sha256, chunk.count, chunk.name) == (
        hashlib.sha256(expected).hexdigest(),
        len(chunk_messages(expected, "", 0)),
        last.attack_id,
    )
    assembler, files = Assembler(), []
    for message in bench.of("/attack/file"):
        file, trouble = assembler.add(message, 1)
        assert trouble == ""
        files += [file] if file else []
    attack = attack_from_bytes(files[0].content, "a")
    assert attack.attack_id == last.attack_id
    assert last.clean_total_cte_m == pytest.approx(attack.clean_drive.mean_total_cte_m)
    assert last.clean_drives == attack.clean_drive.drives
    assert f", without attack {last.clean_total_cte_m:.2f} m" in in_words(last)
    assert (last.objective, last.unit) == ("cte", "m")
    assert last.best_value == pytest.approx(last.best_total_cte_m)
    assert last.clean_value == pytest.approx(last.clean_total_cte_m)
    assert rgb_image(bench.of("/attack/texture")[-1], "test").shape == (256, 256, 3)
    assert rgb_image(bench.of("/attack/preview")[-1], "test").shape == (132, 400, 3)
    assert bench.node.status()[0] == "ready"


class _Silent:
    def start(self, stage):
        return lambda fraction, text="": None

    def finish(self, stage, seconds, cached):
        pass


@pytest.mark.slow
def test_a_cancel_is_answered_at_once_and_the_same_request_goes_on(bench, tmp_path):
    text = request_text(loaded(tiny_request(tmp_path, evaluations=400)))
    bench.request(text)
    bench.run_until(lambda: bench.progress()[-1].evaluation >= 3)
    worker = int(bench.node.counters()["worker_pid"])
    assert bench.cancel("another") < 5.0
    assert (bench.state(), bench.progress()[-1].request_id) == ("refused", "another")
    assert bench.progress()[-1].text == "expected the search another to cancel it; a is running and goes on"
    assert bench.node.status()[0] == "active"
    assert bench.cancel("a") < 5.0
    assert (bench.state(), bench.progress()[-1].text) == ("cancelled", "enough")
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
    done = bench.progress()[-1].evaluation
    bench.request(text)
    bench.run_until(lambda: bench.state() == "searching")
    assert bench.progress()[-1].evaluation >= done - 1
    bench.cancel()


def test_progress_is_told_in_the_objective_of_the_request(bench, tmp_path):
    file = tiny_request(tmp_path, evaluations=3)
    file.write_text(file.read_text().replace("attack: {", "attack: {objective: peak, "))
    bench.request(request_text(loaded(file)))
    bench.run_until(lambda: bench.of("/attack/file"))
    last = bench.progress()[-1]
    attack = load_attack(last.text)
    found = attack.extra["objective"]
    assert (last.objective, last.unit) == ("peak", found["unit"])
    assert last.best_value == pytest.approx(found["value"])
    assert last.clean_value == pytest.approx(found["clean_value"])
    assert f"best peak {found['value']:.4g} {found['unit']}, without attack" in in_words(last)
    during = [message for message in bench.progress() if message.state == "searching" and message.evaluation]
    assert max(message.value for message in during) == pytest.approx(found["value"])


def test_what_cannot_be_done_is_refused_in_words(bench, tmp_path):
    text = request_text(loaded(tiny_request(tmp_path, evaluations=400)))

    def refused(text, request_id="a"):
        bench.request(text, request_id)
        message = bench.progress()[-1]
        return message.text if message.state == "refused" else message.state

    assert "unknown key horizn; valid keys here" in refused(text.replace("horizon", "horizn"))
    assert "expected a request id of 1 to 40 letters" in refused(text, "../../etc")
    bench.request(text, "a")
    assert refused(text, "a") != "refused"
    assert refused(text, "b") == "busy with a; wait for it, or cancel it"
    bench.cancel("b")
    assert bench.progress()[-1].text == "expected the search b to cancel it; a is running and goes on"
    assert "another request already" in refused(text.replace("horizon: 3", "horizon: 4"))
    assert bench.node.counters()["worker_pid"]
    bench.cancel("a")
    assert bench.state() == "cancelled"


def test_a_cancel_without_a_search_is_refused(bench):
    bench.cancel()
    assert (bench.state(), bench.progress()[-1].text) == (
        "refused",
        "nothing to cancel: none is running",
    )


@pytest.mark.parametrize(
    ("current", "says"),
    [
        ('{"request_id": "a", "state": "done", "file": "FOLDER/a.attack.safetensors"}', "a.attack.safetensors as an attack file"),
        ('{"request_id": "a", "state": "running"}', "No such file or directory.*attack/a"),
        ('{"request_id": "a"}', "KeyError: 'state'"),
        ('{"request_id"', "current.json"),
        ("[]", "cannot go on with it"),
    ],
)  # fmt: skip
def test_what_was_damaged_between_two_starts_does_not_keep_a_node_from_starting(tmp_path, current, says):
    """It is started again by itself, and would die of the same file each time."""
    folder = tmp_path / "run" / "attack"
    folder.mkdir(parents=True)
    (folder / "a.attack.safetensors").write_bytes(b"half")
    (folder / "current.json").write_text(current.replace("FOLDER", str(folder)))
    bench = Bench(tmp_path / "run")
    try:
        state, text = bench.node.status()[0], bench.node._progress["text"]
        assert (state, bench.node._progress["state"]) == ("ready", "failed")
        assert re.search(f"cannot go on with it: .*{says}|{says}", text), text
        bench.request(request_text(loaded(tiny_request(tmp_path, evaluations=400))), "b")
        assert bench.state() == "preparing"
    finally:
        bench.close()


@pytest.mark.parametrize(
    ("fails", "says"),
    [("raise KeyError('mine')", r"your code has failed: KeyError: 'mine' \(.*mine\.py:5\)"), ("raise SystemExit(0)", r"has called sys\.exit")],
)  # fmt: skip
def test_a_search_that_a_user_s_code_ends_says_where(bench, tmp_path, fails, says):
    (tmp_path / "mine.py").write_text(
        f"from advnerf_core.attack.objective import Objective\n\nclass Mine(Objective):\n    def value(self, drives):\n        {fails}\n"
    )
    bench.request(request_text(loaded(tiny_request(tmp_path), ["attack.objective=mine.py:Mine"])))
    bench.run_until(lambda: bench.state() == "failed")
    assert re.search(says, bench.progress()[-1].text), bench.progress()[-1].text


def test_a_search_that_fails_says_why(bench, tmp_path):
    request = loaded(tiny_request(tmp_path))
    text = request_text(request)
    (tmp_path / "policy.safetensors").write_bytes(b"nothing")
    bench.request(text)
    bench.run_until(lambda: bench.state() == "failed")
    assert "policy.safetensors" in bench.progress()[-1].text
    assert "worker.log" in bench.progress()[-1].text
    assert bench.node.status()[0] == "ready"
    # Nothing was found: the corrected request may have the same id.
    bench.request(request_text(loaded(tiny_request(tmp_path), ["horizon=4"])))
    assert bench.state() not in ("refused", "failed")
    bench.cancel()


@pytest.mark.slow
def test_a_killed_search_fails_and_goes_on_when_asked_again(bench, tmp_path):
    text = request_text(loaded(tiny_request(tmp_path, evaluations=400)))
    bench.request(text)
    bench.run_until(lambda: bench.progress()[-1].evaluation >= 2)
    os.kill(int(bench.node.counters()["worker_pid"]), signal.SIGKILL)
    bench.run_until(lambda: bench.state() == "failed")
    assert "SIGKILL" in bench.progress()[-1].text
    bench.request(text)
    bench.run_until(lambda: bench.state() == "searching")
    assert bench.progress()[-1].evaluation >= 2
    bench.cancel()


def test_the_request_file_has_one_name():
    assert job.REQUEST == search.REQUEST
    assert "--" not in new_request_id("")
    assert new_request_id("Ecke Nr. 3").startswith("Ecke-Nr--3-")


def test_a_file_is_sent_in_rounds_and_again_to_whoever_comes_late():
    sender = FileSender(["x", "y"], rounds=2, pause_ns=10)
    sent = [sender.next(ns, 1) for ns in range(0, 30, 5)]
    assert sent == ["x", "y", None, "x", "y", None]
    assert [sender.next(ns, 1) for ns in (40, 50)] == [None, None]
    assert [sender.next(ns, 2) for ns in (60, 61, 62, 80)] == ["x", "y", None, None]


def node_process(module, run_dir, config):
    run_dir.mkdir(parents=True, exist_ok=True)
    name = module.rpartition(".")[2]
    file = run_dir / f"{name}.yaml"
    file.write_text(yaml.safe_dump(config))
    command = [sys.executable, "-m", module, "--config", str(file), "--folder", str(run_dir)]
    return subprocess.Popen(command, cwd=REPOSITORY, stderr=(run_dir / f"{name}.log").open("ab"))


def end(process):
    process.send_signal(signal.SIGTERM)
    assert process.wait(120) == 0


class Car:
    """Feeds a compositor on the real bus and reads its labels."""

    def __init__(self, bus):
        self.bus = bus
        for topic in ("/camera/image_raw", "/vicon/car", "/vicon/board"):
            bus.publisher(topic)
        bus.subscribe("/compositor/attack")
        self.labels = []

    def see(self):
        now = time.time_ns()
        board = make_transform(rotation_z(np.deg2rad(172)), [3.15, -1.75, 0.42])
        for stamp in (now - 20_000_000, now):
            self.bus.publish("/vicon/board", pose_message(board, stamp))
            self.bus.publish("/vicon/car", pose_message(planar_pose(0.5, -2.0, 0.0), stamp))
        self.bus.publish(
            "/camera/image_raw",
            image_message(np.full((188, 336, 3), 90, np.uint8), now - 10_000_000, "camera"),
        )
        self.bus.wait(0.05)
        self.labels += [
            received.message() for received in self.bus.receive() if received.topic == "/compositor/attack"
        ]


@pytest.mark.slow
def test_a_killed_node_goes_on_and_a_running_compositor_takes_the_attack_over(tmp_path):
    run_dir = tmp_path / "run"
    request = loaded(tiny_request(tmp_path / "data", evaluations=20))
    attack = node_process("nodes.attack", run_dir, {"repeat_s": 0.2})
    compositor = node_process(
        "nodes.compositor",
        run_dir,
        {"camera": str(CALIBRATION / "camera.yaml"), "target": str(CALIBRATION / "board.yaml")},
    )
    try:
        with Bus(run_dir) as bus:
            car = Car(bus)
            seen = []
            ask_for_attack(run_dir, request_text(request), "live", seen.append, follow=False)
            assert seen[0].state == "preparing"
            bus.subscribe("/attack/progress")
            _wait(bus, lambda message: message.evaluation >= 3)
            attack.kill()
            attack.wait()
            attack = node_process("nodes.attack", run_dir, {"repeat_s": 0.2})
            first = _wait(bus, lambda message: message.state == "searching")
            assert first.evaluation >= 3
            deadline = time.monotonic() + 300
            while not (car.labels and car.labels[-1].attack_id):
                assert time.monotonic() < deadline
                car.see()
            car.see()
        direct = load_attack(run_dir / "attack" / "live" / "seed_0.attack.safetensors")
        whole = load_attack(
            on_one_thread(lambda: search.run_attack(request, tmp_path / "whole", _Silent()))[0]
        )
        ids = [label.attack_id for label in car.labels]
        assert sorted(set(ids)) == ["", direct.attack_id]
        assert ids == sorted(ids)
        assert car.labels[-1].drawn
        np.testing.assert_array_equal(direct.face_object.theta, whole.face_object.theta)
        end(attack)
        end(compositor)
    finally:
        for process in (attack, compositor):
            process.kill()
            process.wait()


def _wait(bus, condition, timeout_s=300.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        bus.wait(0.1)
        for received in bus.receive():
            if received.topic == "/attack/progress" and condition(received.message()):
                return received.message()
    raise AssertionError("the attack node did not come so far")


def test_without_a_node_the_commands_say_so_whoever_else_listens(tmp_path, monkeypatch):
    monkeypatch.setattr("nodes.experiment.node.client._ANSWER_S", 0.3)
    with pytest.raises(LaunchError, match=r"the attack node did not answer within 0\.3 s"):
        cancel_attack(tmp_path, "", "")
    with Bus(tmp_path) as recorder:
        recorder.subscribe("/attack/cancel")
        with pytest.raises(LaunchError, match=r"the attack node did not answer within 0\.3 s"):
            cancel_attack(tmp_path, "", "")


def test_a_repeated_request_is_decided_once_and_answered_every_time(bench):
    def ask(ask_id, text):
        message = types.AttackRequest(
            header=header(0), request_id="a", request=text, source="", ask_id=ask_id
        )
        bench.send("/attack/request", message)
        return bench.progress()[-1]

    first, other, again = ask("x", "no: request"), ask("y", "neither: this"), ask("x", "no: request")
    assert [progress.answered_id for progress in (first, other, again)] == ["x", "y", "x"]
    assert [progress.state for progress in (first, other, again)] == ["refused"] * 3
    assert first.text == again.text != other.text
