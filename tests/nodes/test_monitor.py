import hashlib
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.attack.artifact import face_texture, save_attack
from calibration.panel import MonitorPanel, make_panel, require_fits
from calibration.schema import CalibrationError, TargetCalibration, load_calibration
from hardware.emulators.monitor_port import MonitorPort
from hardware.errors import HardwareError
from nodes.monitor import MonitorConfig, MonitorNode, TwinScreenConfig
from nodes.runtime.clock import ManualClock
from nodes.runtime.messages import decode, encode, header, type_name, types
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.transfer import chunk_messages
from tests.support.faces import centre_square, face_attack, outward_normal
from tests.support.messages import filled

pytestmark = pytest.mark.live

TARGET = load_calibration(
    TargetCalibration, Path(__file__).parents[2] / "calibration" / "twin" / "monitor.yaml"
)
SQUARE = centre_square(TARGET)
PANEL = make_panel((1920, 1080), TARGET)


def attack(seed=0, **changes):
    theta = np.random.default_rng(seed).normal(size=(8, 8, 3)).astype(np.float32)
    values = {
        "method": "gradient",
        "theta": theta,
        "texture": face_texture(theta, 128),
        "size_m": (0.3362, 0.3362),
        "T_world_from_object": np.eye(4),
        "subject": "monitor",
        "corners_in_subject": SQUARE.corners,
        "seed": seed,
        "predicted_total_cte_m": 1.0,
    }
    return face_attack(**{**values, **changes})


class Screen:
    """The twin's monitor behind its real socket, and a clock that only the test moves."""

    def __init__(self, folder, first=None, **config):
        self.port = MonitorPort(folder / "monitor", (0.5977, 0.3362))
        self.clock = ManualClock(mono_ns=5 * 10**9, real_ns=10**18)
        file = folder / "target.yaml"
        file.write_text((Path(__file__).parents[2] / "calibration" / "twin" / "monitor.yaml").read_text())
        if first is not None:
            save_attack(folder / "a.safetensors", first)
            config["attack"] = folder / "a.safetensors"
        config = MonitorConfig(target=file, display=TwinScreenConfig(path=folder / "monitor"), **config)
        self.said, self.shown = {}, None
        try:
            self.node = MonitorNode.build(config, NodeContext("monitor", folder, self.clock))
        except BaseException:
            self.port.close()
            raise

    def close(self):
        self.node.close()
        self.port.close()

    def hear(self, topic, message):
        raw = encode(message)
        info = MessageInfo(self.clock.now().mono_ns, 0, raw=raw)
        self._note(self.node.handle(topic, decode(type_name(message), raw), info, self.clock.now()))

    def safety(self, armed, reason=""):
        self.hear(
            "/safety/state",
            filled(types.SafetyState, armed=armed, stopping=not armed, reason=reason),
        )

    def pass_time(self, ms):
        self.clock.advance(ms / 1e3)
        self._note(self.node.tick(self.clock.now()))

    def _note(self, outs):
        for topic, message in outs:
            self.said[topic] = decode(type_name(message), encode(message))

    @property
    def pixels(self):
        changed, picture = self.port.take()
        if changed:
            self.shown = picture
        return self.shown


@pytest.fixture
def screen(tmp_path):
    made = []

    def make(*arguments, **config):
        made.append(Screen(tmp_path, *arguments, **config))
        return made[-1]

    yield make
    for each in made:
        each.close()


def centre_of(picture):
    # 336.2 mm of 598 mm on 1920 px, and of 336 mm on 1080 px.
    width, height = round(336.2 / 598.0 * 1920), round(336.2 / 336.0 * 1080)
    left, top = (1920 - width) // 2, (1080 - height) // 2
    return picture[max(top, 0) : top + height, left : left + width], left


def test_the_attack_is_on_the_screen_only_while_the_car_is_armed(screen):
    bench = screen(attack())
    plain = np.round(255 * np.array([0.20, 0.62, 0.28]))
    face, left = centre_of(bench.pixels)
    assert (face == plain).all()
    assert not bench.pixels[:, : left - 1].any()
    bench.safety(True)
    face, _ = centre_of(bench.pixels)
    assert len(np.unique(face.reshape(-1, 3), axis=0)) > 1000
    shown = bench.said["/monitor/shown"]
    assert (shown.attacking, shown.attack_id) == (True, attack().attack_id)
    assert shown.sha256 == hashlib.sha256(bench.pixels.tobytes()).hexdigest()
    assert bench.said["/monitor/attack"].drawn
    bench.safety(False, "outside the fence")
    assert (centre_of(bench.pixels)[0] == plain).all()
    assert bench.said["/monitor/shown"].reason == "not armed: outside the fence"


def test_silence_of_the_safety_node_takes_the_attack_off(screen):
    bench = screen(attack())
    bench.safety(True)
    bench.pass_time(400)
    assert bench.said["/monitor/attack"].drawn
    bench.pass_time(150)
    assert not bench.said["/monitor/attack"].drawn
    assert bench.said["/monitor/attack"].reason == "no message from the safety node"


def test_the_operator_switches_the_attack_off_and_on(screen):
    bench = screen(attack())
    bench.safety(True)
    bench.hear("/attack/switch", types.AttackSwitch(header=header(0), show=False, source="ann"))
    assert bench.said["/monitor/attack"].reason == "switched off by ann"
    assert not bench.said["/monitor/attack"].drawn
    bench.hear(
        "/attack/switch",
        types.AttackSwitch(header=header(bench.clock.now().real_ns), show=True, source="ann"),
    )
    assert bench.said["/monitor/attack"].drawn


def test_every_pixel_of_the_texture_is_where_nearest_neighbour_puts_it():
    texture = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    picture = MonitorPanel((1920, 1080), (0.64, 0.36)).picture(texture, (0.18, 0.18))  # 540 px square
    rows = [int((row + 0.5) * 64 / 540) for row in range(540)]
    left, top = (1920 - 540) // 2, (1080 - 540) // 2
    np.testing.assert_array_equal(picture[top : top + 540, left : left + 540], texture[np.ix_(rows, rows)])
    assert int((picture.reshape(-1, 3).any(axis=1)).sum()) <= 540 * 540


def test_a_new_attack_comes_over_the_bus_and_a_wrong_one_changes_nothing(screen, tmp_path):
    bench = screen(attack())
    bench.safety(True)
    before = bench.pixels.copy()

    def send(sent, damage=False):
        save_attack(tmp_path / "new.safetensors", sent)
        for chunk in chunk_messages((tmp_path / "new.safetensors").read_bytes(), sent.attack_id, 0):
            if damage:
                chunk.data = chunk.data.copy()
                chunk.data[500] ^= 1
            bench.hear("/attack/file", chunk)

    send(attack(seed=1, subject="board"))
    assert "for board" in bench.node.status()[1]
    send(attack(seed=1), damage=True)
    send(attack(seed=1, size_m=(1.0, 1.0)))
    assert "more than the 0.336 m" in bench.node.status()[1]
    assert bench.node.counters()["attacks_refused"] == 3
    np.testing.assert_array_equal(bench.pixels, before)
    send(attack(seed=1))
    assert bench.said["/monitor/shown"].attack_id == attack(seed=1).attack_id
    assert (bench.pixels != before).any()


def test_a_screen_that_changes_the_colours_ends_the_node(screen):
    bench = screen(attack())
    genuine = bench.node._display.read_back
    bench.node._display.read_back = lambda: genuine() // 2 * 2  # a night light, six bits
    with pytest.raises(HardwareError, match="to hold the shown pixels"):
        bench.safety(True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"subject": "board"}, "for board"),
        ({"size_m": (0.4, 0.4)}, "more than the 0.336 m"),
        ({"corners_in_subject": SQUARE.corners + np.array([0.0, 0.1, 0.0])}, "10.0 cm from the middle"),
        (
            {"corners_in_subject": np.roll(SQUARE.corners, 1, axis=0)},
            "on its side: they begin 1 corner later",
        ),
        ({"corners_in_subject": np.roll(SQUARE.corners, 2, axis=0)}, "a face upside down"),
        ({"corners_in_subject": SQUARE.corners[[1, 0, 3, 2]]}, "got them mirrored"),
    ],
)
def test_an_attack_that_does_not_fit_is_refused_at_the_start(screen, changes, message):
    with pytest.raises(CalibrationError, match=message):
        screen(attack(**changes))


def test_a_monitor_that_is_not_the_measured_one_is_refused():
    with pytest.raises(CalibrationError, match=r"0.527 x 0.297 m, but the corners .* give 0.598 x 0.336"):
        make_panel((1920, 1080), TARGET, (527.0, 297.0))
    assert make_panel((1920, 1080), TARGET, (598.0, 336.0)).size_m == (0.598, 0.336)
    require = partial(require_fits, panel=PANEL, target=TARGET)
    require(attack())


def test_the_centre_square_is_square_centred_and_in_the_panel():
    corners = SQUARE.corners
    np.testing.assert_allclose(corners.mean(axis=0), TARGET.corners.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1), 0.3362, atol=1e-6
    )
    np.testing.assert_allclose(outward_normal(SQUARE), outward_normal(TARGET))


def test_the_node_needs_neither_torch_nor_scipy():
    script = "import sys, nodes.monitor; sys.exit('torch' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0
