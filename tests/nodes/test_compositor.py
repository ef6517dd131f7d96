import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.attack.artifact import AttackFileError, face_texture, save_attack
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.geometry import invert_transform, make_transform, planar_pose, rotation_z
from calibration.schema import CalibrationError, CameraCalibration, TargetCalibration, load_calibration
from nodes.compositor import CompositorConfig, CompositorNode
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import decode, encode, image_message, pose_message, stamp_ns, type_name
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.pictures import rgb_image
from nodes.runtime.transfer import chunk_messages
from tests.support.faces import face_attack, reordered

pytestmark = pytest.mark.live

CALIBRATION = Path(__file__).parents[2] / "calibration" / "twin"
CAMERA = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
TARGET = load_calibration(TargetCalibration, CALIBRATION / "board.yaml")
T_WORLD_FROM_BOARD = make_transform(rotation_z(np.deg2rad(172)), [3.15, -1.75, 0.42])
T0 = 1_700_000_000_000_000_000
MS = 1_000_000


def attack(**changes):
    theta = np.random.default_rng(0).normal(size=(8, 8, 3)).astype(np.float32)
    values = {
        "method": "gradient",
        "theta": theta,
        "texture": face_texture(theta, 128),
        "size_m": (1.0, 1.0),
        "T_world_from_object": T_WORLD_FROM_BOARD,
        "subject": "board",
        "corners_in_subject": TARGET.corners,
        "predicted_total_cte_m": 1.0,
    }
    return face_attack(**{**values, **changes})


def car_at(t_s):
    """Driving toward the board at 0.8 m/s while turning a little."""
    return planar_pose(0.5 + 0.8 * t_s, -2.0, 0.1 * t_s)


class Bench:
    """Feeds a node as its loop would: every message through CDR, on a clock that only the test moves."""

    def __init__(self, node):
        self.node, self.clock, self.out = node, ManualClock(mono_ns=5 * 10**9, real_ns=T0), []

    def send(self, topic, message):
        raw = encode(message)
        info = MessageInfo(0, 0, raw=raw)
        self._take(self.node.handle(topic, decode(type_name(message), raw), info, self.clock.now()))

    def poses(self, t_s):
        stamp = T0 + round(t_s * 1e9)
        self.send("/vicon/board", pose_message(T_WORLD_FROM_BOARD, stamp))
        self.send("/vicon/car", pose_message(car_at(t_s), stamp))

    def image(self, t_s, value=90):
        rgb = np.full((188, 336, 3), value, np.uint8)
        self.send("/camera/image_raw", image_message(rgb, T0 + round(t_s * 1e9), "camera"))

    def pass_time(self, seconds):
        for _ in range(round(seconds / 0.01)):
            self.clock.advance(0.01)
            self._take(self.node.tick(self.clock.now()))

    def _take(self, outs):
        for topic, message in outs:
            data = message if isinstance(message, bytes) else encode(message)
            self.out.append((topic, data))

    def images(self):
        return [
            decode("sensor_msgs/msg/Image", data) for topic, data in self.out if topic == "/compositor/image"
        ]

    def labels(self):
        return [
            decode("advnerf_msgs/msg/AttackStamp", data)
            for topic, data in self.out
            if topic == "/compositor/attack"
        ]


def node_of(first=None, **settings):
    files = {"camera": CALIBRATION / "camera.yaml", "target": CALIBRATION / "board.yaml"}
    return CompositorNode(CompositorConfig(**files, **settings), CAMERA, TARGET, first)


@pytest.fixture
def bench():
    return Bench(node_of(attack()))


def expected_image(t_s, value=90):
    overlay = FaceOverlay(attack().required_face().texture, TARGET.corners, CAMERA.pinhole)
    T = invert_transform(car_at(t_s) @ CAMERA.mount) @ T_WORLD_FROM_BOARD
    return overlay.draw(np.full((188, 336, 3), value, np.uint8), T)[0]


def test_the_face_is_drawn_in_its_own_colours_into_a_picture_in_bgr(bench):
    for t in (0.0, 0.01, 0.02):
        bench.poses(t)
    rgb = np.full((188, 336, 3), (90, 60, 30), np.uint8)
    bgr = image_message(np.ascontiguousarray(rgb[..., ::-1]), T0 + 20 * MS, "camera", "bgr8")
    bench.send("/camera/image_raw", bgr)
    bench.poses(0.03)
    (image,) = bench.images()
    T = invert_transform(car_at(0.02) @ CAMERA.mount) @ T_WORLD_FROM_BOARD
    expected = FaceOverlay(attack().required_face().texture, TARGET.corners, CAMERA.pinhole).draw(rgb, T)[0]
    assert image.encoding == "rgb8"
    assert np.abs(rgb_image(image, "test").astype(int) - expected).mean() < 0.3
    assert (expected != rgb).any()


def test_an_image_waits_for_the_pose_after_it_and_shows_the_face_at_its_own_stamp(bench):
    for t in (0.0, 0.01, 0.02):
        bench.poses(t)
    bench.image(0.025)
    assert bench.out == []
    bench.poses(0.03)
    (image,), (label,) = bench.images(), bench.labels()
    assert stamp_ns(image) == stamp_ns(label) == T0 + 25 * MS
    assert image.header.frame_id == "camera"
    assert label.attack_id == attack().attack_id
    assert label.drawn
    assert label.reason == ""
    # Interpolation between poses 10 ms apart is exact to micrometres here: at most a rounding step somewhere.
    difference = np.abs(rgb_image(image, "test").astype(int) - expected_image(0.025))
    assert difference.max() <= 1
    assert (rgb_image(image, "test") != 90).any()


def test_after_the_bounded_wait_the_pose_is_extrapolated_and_flagged(bench):
    for t in (0.0, 0.01, 0.02):
        bench.poses(t)
    bench.image(0.035)
    bench.pass_time(0.02)
    assert bench.out == []
    bench.pass_time(0.01)
    (image,), (label,) = bench.images(), bench.labels()
    assert label.drawn
    assert "extrapolated by 15 ms" in label.reason
    assert "extrapolated" in bench.node.status()[1]
    assert bench.node.counters()["extrapolated"] == 1
    assert np.abs(rgb_image(image, "test").astype(int) - expected_image(0.035)).mean() < 0.3


def test_without_poses_in_reach_the_image_is_dropped_and_counted(bench):
    bench.image(0.0)
    bench.pass_time(0.05)
    for t in (0.05, 0.06):
        bench.poses(t)
    bench.image(0.2)  # 140 ms after the last pose
    bench.pass_time(0.05)
    assert bench.out == []
    assert bench.node.counters()["dropped_no_pose"] == 2
    assert "dropped" in bench.node.status()[1]


@pytest.mark.parametrize("bad", ["nan", "zero quaternion"])
@pytest.mark.parametrize("topic", ["/vicon/board", "/vicon/car"])
def test_a_pose_that_is_none_is_as_good_as_a_lost_one(bench, topic, bad):
    """A clean image under "out of view" would be taken for a drive without an attack."""
    for t in (0.0, 0.01):
        bench.poses(t)
    stamp = T0 + 200_000_000
    message = pose_message(T_WORLD_FROM_BOARD, stamp)
    pose = message.pose
    if bad == "nan":
        pose.position.x = float("nan")
    else:
        pose.orientation.x = pose.orientation.y = pose.orientation.z = pose.orientation.w = 0.0
    bench.send(topic, message)
    bench.image(0.2)
    bench.pass_time(0.05)
    assert bench.out == []
    counters = bench.node.counters()
    assert (counters["bad_poses"], counters["dropped_no_pose"]) == (1, 1)


def test_an_image_of_another_size_than_calibrated_is_dropped_and_counted(bench):
    for t in (0.0, 0.01):
        bench.poses(t)
    other = image_message(np.full((100, 100, 3), 90, np.uint8), T0 + 5_000_000, "camera")
    bench.send("/camera/image_raw", other)
    bench.pass_time(0.05)
    assert bench.out == []
    assert bench.node.counters()["dropped_bad"] == 1
    assert "expected 336 x 188, as calibrated, got 100 x 100" in bench.node.status()[1]


def test_two_images_never_wait(bench):
    for t in (0.0, 0.01):
        bench.poses(t)
    bench.image(0.02, value=10)
    bench.image(0.03, value=20)
    assert [rgb_image(i, "test")[0, 0, 0] for i in bench.images()] == [10]
    bench.poses(0.03)
    assert [rgb_image(i, "test")[0, 0, 0] for i in bench.images()] == [10, 20]


@pytest.mark.parametrize(
    ("T_world_from_car", "reason"),
    [
        (planar_pose(0.0, 2.0, np.pi), "out of view"),
        (planar_pose(5.0, -1.5, np.pi), "turned away: the camera sees the back of the face"),
    ],
)
def test_a_face_that_is_not_drawn_passes_the_image_unchanged_and_says_why(bench, T_world_from_car, reason):
    for t in (0.0, 0.01):
        bench.send("/vicon/board", pose_message(T_WORLD_FROM_BOARD, T0 + round(t * 1e9)))
        bench.send("/vicon/car", pose_message(T_world_from_car, T0 + round(t * 1e9)))
    bench.image(0.005)
    (image,), (label,) = bench.images(), bench.labels()
    assert (rgb_image(image, "test") == 90).all()
    assert not label.drawn
    assert label.reason == reason
    assert bench.node.status() == ("active", f"attack {attack().attack_id}; {reason}")


def test_without_an_attack_file_images_pass_at_once():
    bench = Bench(node_of())
    bench.image(0.0)
    (image,), (label,) = bench.images(), bench.labels()
    assert (rgb_image(image, "test") == 90).all()
    assert (label.attack_id, label.drawn) == ("", False)
    assert bench.node.status()[0] == "active"
    bench.pass_time(1.5)
    assert bench.node.status()[0] == "ready"


def test_any_order_of_arrival_before_the_deadline_gives_the_same_bytes():
    def run(order):
        bench = Bench(node_of(attack()))
        events = [lambda t=t: bench.poses(t) for t in (0.0, 0.01, 0.02, 0.03)] + [lambda: bench.image(0.024)]
        for k in order:
            events[k]()
        return bench.out

    first = run([0, 1, 2, 3, 4])
    assert len(first) == 2
    for order in ([4, 0, 1, 2, 3], [0, 4, 2, 1, 3], [0, 2, 1, 4, 3]):
        assert run(order) == first


def test_build_reads_the_files_and_refuses_wrong_ones(tmp_path):
    path = tmp_path / "attack.safetensors"
    save_attack(path, attack())
    files = {"camera": CALIBRATION / "camera.yaml", "target": CALIBRATION / "board.yaml"}
    context = NodeContext("compositor", tmp_path, ManualClock())
    node = CompositorNode.build(CompositorConfig(attack=path, **files), context)
    poses = ("/vicon/car", "/vicon/board")
    assert node.subscriptions == ("/camera/image_raw", *poses, "/attack/file", "/attack/switch")
    assert "passes through" not in node.status()[1]
    assert (
        CompositorNode.build(CompositorConfig(attack="", **files), context)
        .status()[1]
        .endswith("pass through")
    )
    path.write_bytes(b"garbage")
    with pytest.raises(AttackFileError, match="cannot read"):
        CompositorNode.build(CompositorConfig(attack=path, **files), context)
    save_attack(path, attack(size_m=(0.3, 0.3)))
    with pytest.raises(ConfigError, match="name the target it was made for"):
        CompositorNode.build(CompositorConfig(attack=path, **files), context)
    with pytest.raises(ValidationError, match="Extra inputs"):
        CompositorConfig(atack=path, **files)


@pytest.mark.parametrize("order", [(1, 2, 3, 0), (2, 3, 0, 1), (1, 0, 3, 2)])
def test_a_target_with_the_corners_of_the_attack_in_another_order_is_refused(order):
    """It was drawn turned, and measured as the attack."""
    files = {"camera": CALIBRATION / "camera.yaml", "target": CALIBRATION / "board.yaml"}
    with pytest.raises(CalibrationError, match="expected corners_in_subject_m of target board in the order"):
        CompositorNode(CompositorConfig(**files), CAMERA, reordered(TARGET, order), attack())


def file_of(tmp_path, **changes):
    save_attack(tmp_path / "new.safetensors", attack(**changes))
    return (tmp_path / "new.safetensors").read_bytes()


def drive_by(bench, t_s):
    for t in (t_s - 0.005, t_s + 0.005):
        bench.poses(t)
    bench.image(t_s)


def test_a_new_attack_is_taken_over_between_two_images_and_every_label_names_what_was_drawn(tmp_path):
    bench = Bench(node_of(attack()))
    drive_by(bench, 0.1)
    chunks = chunk_messages(file_of(tmp_path, seed=7), "new", T0)
    assert len(chunks) > 0
    bench.poses(0.195)
    bench.image(0.2)  # waits for the pose after it, and was seen under the old attack
    for chunk in chunks:
        bench.send("/attack/file", chunk)
    for t_s in (0.3, 0.4):
        drive_by(bench, t_s)
    old, new = attack().attack_id, attack(seed=7).attack_id
    assert [label.attack_id for label in bench.labels()] == [old, old, new, new]
    assert all(label.drawn for label in bench.labels())
    assert bench.node.status()[1] == f"attack {new}"
    counters = bench.node.counters()
    assert (counters["attacks_taken"], counters["attacks_refused"]) == (1, 0)
    for chunk in chunks:  # it is sent again for others
        bench.send("/attack/file", chunk)
    assert bench.node.counters()["attacks_taken"] == 1


def test_without_an_attack_the_first_one_is_shown_when_it_comes(tmp_path):
    bench = Bench(node_of())
    drive_by(bench, 0.1)
    for chunk in chunk_messages(file_of(tmp_path), "new", T0):
        bench.send("/attack/file", chunk)
    drive_by(bench, 0.2)
    assert [(label.attack_id, label.drawn) for label in bench.labels()] == [
        ("", False),
        (attack().attack_id, True),
    ]
    assert (rgb_image(bench.images()[1], "test") != 90).any()


def broken(case, tmp_path):
    chunks = [
        decode("advnerf_msgs/msg/FileChunk", encode(c)) for c in chunk_messages(file_of(tmp_path), "new", T0)
    ]
    if case == "garbage":
        return chunk_messages(b"garbage", "new", T0)
    if case == "changed":
        return chunk_messages(file_of(tmp_path).replace(b'"seed\\":0', b'"seed\\":1'), "new", T0)
    if case == "corrupt":
        return [replace(chunks[0], data=chunks[0].data ^ 1), *chunks[1:]]
    turned = {"corners_in_subject": np.roll(TARGET.corners, 1, axis=0)}
    sizes = {"size": {"size_m": (0.3, 0.3)}, "subject": {"subject": "monitor"}, "turned": turned}
    return chunk_messages(file_of(tmp_path, **sizes[case]), "new", T0)


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("garbage", "cannot read the attack new as an attack file"),
        ("changed", "was changed after it was saved"),
        ("corrupt", "with the announced hash"),
        ("size", "name the target it was made for"),
        ("subject", "was made for monitor"),
        ("turned", "on its side: they begin 1 corner later"),
    ],
)
def test_what_is_wrong_with_a_new_attack_is_said_and_the_old_one_stays(case, reason, tmp_path):
    bench = Bench(node_of(attack(seed=3)))
    for chunk in broken(case, tmp_path):
        bench.send("/attack/file", chunk)
    drive_by(bench, 0.1)
    (label,) = bench.labels()
    assert (label.attack_id, label.drawn) == (attack(seed=3).attack_id, True)
    state, text = bench.node.status()
    assert state == "active"
    assert "new attack refused" in text
    assert reason in text
    assert bench.node.counters()["attacks_refused"] == 1
    for chunk in chunk_messages(file_of(tmp_path, seed=9), "good", T0):
        bench.send("/attack/file", chunk)
    assert bench.node.status()[1] == f"attack {attack(seed=9).attack_id}"


def test_the_node_needs_no_torch():
    code = "import sys, nodes.compositor; assert not {'torch', 'numba', 'scipy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
