"""Cameras of users: named in files, checked by a command, and run by the real camera node."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.documents import dump_yaml
from calibration.schema import CameraCalibration, load_calibration
from nodes.bags import read_messages
from nodes.camera import CameraNodeConfig
from nodes.cli.main import app
from nodes.lab import camera_check
from nodes.lab.camera_check import CHECKS, CameraBench
from nodes.lab.camera_tools import parse_source
from nodes.launching.launch import Launch
from nodes.launching.launch_check import check_nodes
from nodes.launching.launch_file import load_launch
from nodes.runtime import decode
from nodes.runtime.config import load_node_config
from nodes.runtime.errors import ConfigError
from nodes.runtime.findings import MetButLook, NotMet
from nodes.runtime.pictures import rgb_image

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "http_camera.py"
TWIN = ROOT / "calibration" / "twin" / "camera.yaml"
RED = (200, 30, 20)

GENERATOR = """
import time
from dataclasses import dataclass

import numpy as np

from hardware.cameras.interface import Camera, Frame
from hardware.errors import LinkLost


class Generator(Camera):
    '''Grey pictures that grow brighter. Nobody takes them.'''

    @dataclass(frozen=True)
    class Config:
        width: int
        rate_hz: float = 50.0

    def __init__(self, config):
        self.config, self.next_s, self.number, self.is_open = config, 0.0, 0, False

    def open(self):
        self.is_open, self.next_s = True, time.monotonic()

    def read(self, timeout_s):
        if not self.is_open:
            raise LinkLost("expected an open camera; call open() first")
        wait_s = self.next_s - time.monotonic()
        time.sleep(max(min(wait_s, timeout_s), 0.0))
        if wait_s > timeout_s:
            return None
        self.next_s, self.number = time.monotonic() + 1.0 / self.config.rate_hz, self.number + 1
        rgb = np.full((4, self.config.width, 3), self.number % 256, np.uint8)
        rgb.flags.writeable = False
        return Frame(rgb, time.time_ns(), time.monotonic_ns(), self.number)

    def close(self):
        self.is_open = False


class Bare(Camera):
    pass


class Mute(Generator):
    read = Camera.read


class Other(Generator):
    def __init__(self, config, port):
        pass
"""


@pytest.fixture
def generator(tmp_path: Path) -> Path:
    file = tmp_path / "mine.py"
    file.write_text(GENERATOR)
    return file


@pytest.fixture
def stream() -> Iterator[str]:
    """Address of a red picture over HTTP, 20 times a second, as network cameras send it."""
    ended = threading.Event()
    picture = np.full((188, 336, 3), RED[::-1], np.uint8)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
            self.end_headers()
            try:
                while not ended.wait(0.05):
                    picture[:8] ^= 1  # no two pictures of a sensor are alike
                    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
                    self.wfile.write(b"--next\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg + b"\r\n")
            except OSError:
                return

        def log_message(self, *arguments: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/stream"
    ended.set()
    server.shutdown()
    thread.join()
    server.server_close()


def command(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    if isinstance(done.exception, Exception):
        raise done.exception
    return done.exit_code, done.output


def test_its_keys_stand_beside_those_of_every_source(generator: Path) -> None:
    source = parse_source(
        f"{{kind: {generator}:Generator, width: 6, rate_hz: 0.5, stall_s: 2.0, repeats: 3}}"
    )
    assert (source.config.width, source.stall_s, source.repeats) == (6, 2.0, 3)
    assert source.period_s() == 2.0
    assert source.steady()._stall_s == 6.0  # three periods
    assert source.camera().config is source.config


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            "widht: 6",
            r"widht: unknown key of this camera; valid keys here: kind, rate_hz, repeats, stall_s, width$",
        ),
        ("width: a", "width: input should be a valid integer, got 'a'"),
        ("rate_hz: 3.0", "width is missing; add it"),
        ("width: 6, stall_s: -1.0", "stall_s: input should be greater than 0"),
    ],
)
def test_a_wrong_key_is_one_line(generator: Path, keys: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_source(f"{{kind: {generator}:Generator, {keys}}}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            "webcam",
            r"kind: expected a camera of v4l2, .*folder; got 'webcam'; one of your own is file.py:Name",
        ),
        ("mine.py:Missing", "kind: camera .*: expected a name in mine.py"),
        (
            "mine.py:Frame",
            r"expected a class that derives from hardware\.cameras\.interface\.Camera, got the class Frame",
        ),
        ("mine.py:Mute", "expected a class that defines open, read and close, got none of read"),
        ("mine.py:Bare", "expected an attribute Config with its keys, .* got none"),
        (
            "mine.py:Other",
            r"called with its Config alone, got another __init__ \(missing a required argument: 'port'\)",
        ),
        ("other.py:Generator", "expected a Python file at .*other.py, found none"),
    ],
)
def test_a_name_that_is_no_camera_is_one_line(
    generator: Path, monkeypatch: pytest.MonkeyPatch, kind: str, message: str
) -> None:
    monkeypatch.chdir(generator.parent)
    with pytest.raises(ConfigError, match=message):
        parse_source(f"{{kind: '{kind}', width: 6}}")


def test_a_package_brings_a_camera(generator: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = generator.parent / "stranger_camera-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger-camera\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[advnerf.cameras]\ngrey = mine:Generator\n")
    monkeypatch.syspath_prepend(str(generator.parent))
    assert parse_source("{kind: grey, width: 6}").config.width == 6
    code, printed = command("experiment", "list", "cameras")
    assert code == 0
    assert "grey" in printed
    assert "stranger-camera 1.0  Grey pictures that grow brighter." in printed


def test_the_check_meets_a_good_camera_and_says_what_it_executes(generator: Path) -> None:
    code, printed = command("car", "camera", "check", f"{generator}:Generator", "--set", "width=6")
    assert code == 0, printed
    assert printed.count(" met ") == len(CHECKS)
    assert f"executes {generator}:Generator (sha256 " in printed


def bench_of(generator: Path, before: str, after: str) -> CameraBench:
    """The good camera with one change."""
    assert before in GENERATOR
    generator.write_text(GENERATOR.replace(before, after))
    return CameraBench(parse_source(f"{{kind: {generator}:Generator, width: 6}}").camera())


@pytest.mark.parametrize(
    ("part", "before", "after", "message"),
    [
        ("frames", "rgb.flags.writeable = False", "pass", "read-only"),
        ("frames", "np.uint8)", "float)", r"\[H, W, 3\] uint8, got float64"),
        ("stamps", "time.time_ns()", "1", "both stamps|stamp_realtime_ns to rise"),
        ("frames", "(4, self.config.width, 3)", "(0, self.config.width, 3)", r"\[H, W, 3\] uint8, got uint8 \[0, 6, 3\]"),
        ("frames", "rgb = np.full(", "self.kept = kept = getattr(self, 'kept', np.zeros((4, 6, 3), np.uint8)); kept[:] = self.number; rgb = kept.view(); (", "a later read.. has written into"),
        ("stamps", "time.time_ns(), time.monotonic_ns()", "1e9 * time.time(), 1e9 * time.monotonic()", "a whole number for stamp_mono_ns, got .*; use time.time_ns"),
        ("stamps", "self.number)", "7)", "sequence to rise"),
        ("closed", 'raise LinkLost("expected an open camera; call open() first")', "return None", "LinkLost"),
        ("stall", "wait_s > timeout_s", "False", "return None while there is no new frame"),
        ("reopening", "self.is_open, self.next_s = True,", "self.kept = [*getattr(self, 'kept', []), open('/dev/null')]; self.is_open, self.next_s = True,", "left open"),
        ("timeout", "min(wait_s, timeout_s)", "0.5", r"read\(0.03\) to return within its timeout, got 0\.5"),
        ("newest", "time.monotonic() + 1.0 /", "self.next_s + 1.0 /", r"the newest frame after a pause, got \d+ frames at once: read\(\) hands out a queue"),
        ("frames", "return Frame(", "return rgb, (", r"expected read\(\) to return a hardware\.cameras\.interface\.Frame or None, got "),
    ],
)  # fmt: skip
def test_the_check_finds_what_is_wrong(
    generator: Path, part: str, before: str, after: str, message: str
) -> None:
    bench = bench_of(generator, before, after)
    with pytest.raises(NotMet, match=message):
        CHECKS[part](bench)


@pytest.mark.parametrize(
    ("part", "before", "after", "message"),
    [
        ("frames", "self.number % 256, np", "7, np", "4 identical pictures: .*repeats: 0 ends that"),
        ("stamps", "time.time_ns(), time.monotonic_ns()", "time.time_ns() - 10**9 // 2, time.monotonic_ns() - 10**9 // 2", "drops frames older than its max_age_s, 0.2 s"),
    ],
)  # fmt: skip
def test_the_check_shows_what_the_node_would_not_publish(
    generator: Path, part: str, before: str, after: str, message: str
) -> None:
    bench = bench_of(generator, before, after)
    with pytest.raises(MetButLook, match=message):
        CHECKS[part](bench)


def test_the_check_of_a_camera_that_never_returns_ends(generator: Path) -> None:
    """As a driver that waits for its device, whatever the time-out."""
    generator.write_text(GENERATOR.replace("wait_s > timeout_s", "time.sleep(1e6)"))
    bench = CameraBench(parse_source(f"{{kind: {generator}:Generator, width: 6}}").camera())
    findings = camera_check.check_camera(bench, most_s=2.0)
    assert not findings[-1].met
    assert "not ended after 2 s; make read(timeout_s) return None" in findings[-1].text
    assert len(findings) < len(CHECKS)


def test_the_check_tells_bgr_from_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((4, 6, 3), RED[::-1], np.uint8))
    camera = parse_source(f"{{kind: folder, folder: {tmp_path}}}").camera()
    assert CHECKS["colours"](CameraBench(camera, shows="red")) == "red is red"
    with pytest.raises(NotMet, match=r"expected most of blue .* OpenCV's images are BGR"):
        CHECKS["colours"](CameraBench(camera, shows="blue"))


@pytest.mark.parametrize(
    ("first", "said"),
    [
        ("import os; os.write(1, b'SDK 1.0\\n')", ""),  # as libraries of C print, past sys.stdout
        ("import os; os._exit(0)", "expected an answer of each node, got none: a module ends the process"),
    ],
)
def test_a_module_that_prints_or_ends_the_process_does_not_hide_the_answers(
    tmp_path: Path, first: str, said: str
) -> None:
    (tmp_path / "mine.py").write_text(f"{first}\n{GENERATOR}")
    config = {"calibration": str(TWIN), "source": {"kind": "mine.py:Generator", "width": 336}}
    file = tmp_path / "my.launch.yaml"
    file.write_text(
        dump_yaml({"name": "mine", "nodes": {"camera": {"module": "nodes.camera", "config": config}}})
    )
    found = check_nodes(load_launch(file))
    assert said in found.get("nodes", "")
    assert bool(found) == bool(said)


def test_a_relative_file_is_relative_to_the_launch_file_that_names_it(
    generator: Path, tmp_path: Path
) -> None:
    below = tmp_path / "below"
    below.mkdir()
    source = {"kind": "../mine.py:Generator", "width": 336}
    node = {"module": "nodes.camera", "config": {"calibration": str(TWIN), "source": source}}
    (below / "base.launch.yaml").write_text(dump_yaml({"name": "base", "nodes": {"camera": node}}))
    top = tmp_path / "top.launch.yaml"
    top.write_text(dump_yaml({"name": "top", "include": ["below/base.launch.yaml"], "nodes": {}}))
    plan = load_launch(top)
    assert plan.documents["camera"].data["source"]["kind"] == f"{generator}:Generator"
    (wrong,) = check_nodes(load_launch(top, ["camera.source.width=wide"])).values()
    assert "source.width: input should be a valid integer" in wrong
    code, printed = command("launch", top, "--check")
    assert (code, f"executes {generator}:Generator (sha256 " in printed) == (0, True)
    plain = tmp_path / "camera.yaml"
    plain.write_text(
        dump_yaml({"calibration": str(TWIN), "source": {"kind": "mine.py:Generator", "width": 336}})
    )
    assert load_node_config(CameraNodeConfig, "camera", plain).source.config.width == 336


def test_the_example_is_a_camera(stream: str) -> None:
    code, printed = command(
        "car", "camera", "check", f"{EXAMPLE}:HttpCamera", "--set", f"url={stream}", "--shows", "red"
    )
    assert code == 0, printed
    assert "336 x 188" in printed


@pytest.mark.live
def test_the_camera_node_runs_the_example(stream: str, tmp_path: Path) -> None:
    file = tmp_path / "http.launch.yaml"
    source = {"kind": f"{EXAMPLE}:HttpCamera", "url": stream}
    nodes = {"camera": {"module": "nodes.camera", "config": {"calibration": str(TWIN), "source": source}}}
    file.write_text(dump_yaml({"name": "http", "record": {"topics": ["/camera/image_raw"]}, "nodes": nodes}))
    with Launch(file, [], tmp_path / "run", lambda line: None) as launch:
        launch.wait_ready(60.0)
        time.sleep(1.0)
    images = list(read_messages(tmp_path / "run" / "bag", ["/camera/image_raw"]))
    assert len(images) >= 5
    rgb = rgb_image(decode("sensor_msgs/msg/Image", images[-1].cdr), "test")
    calibration = load_calibration(CameraCalibration, TWIN)
    assert rgb.shape == (calibration.height, calibration.width, 3)
    assert np.abs(rgb.reshape(-1, 3).mean(axis=0) - RED).max() < 4
