"""Commands over bags that others wrote: they play, train, become data sets; what cannot is one line and exit code 2."""

import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.driving.expert import Expert
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration
from nodes.bags.reader import read_info
from nodes.cli import main as cli
from nodes.lab.policy_data.frames import frames_of
from nodes.lab.policy_data.logs import open_log
from nodes.lab.policy_reference import from_bag
from nodes.lab.wizards.bags import read_pictures, read_poses
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime.bus import Bus
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import pose_matrix, stamp_ns
from tests.support.foreign_samples import COMPRESSED, COUNT, START_NS, STEP_NS, WRITERS, rgb_at, state_at

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
CAMERA, ROOM = TWIN / "camera.yaml", TWIN / "room.yaml"
VIEW = PolicyView(load_calibration(CameraCalibration, CAMERA).pinhole)
EXPERT = Expert(load_calibration(RoomCalibration, ROOM).reference_path)
TRANSFORM = "geometry_msgs/msg/TransformStamped"
FORMS = [
    ("mcap", {"encoding": "bgr8"}),
    ("ros1", {"encoding": "bgr8"}),
    ("rosbags-sqlite3", {"image_type": COMPRESSED, "image_topic": "/camera/image_raw/compressed"}),
    ("rosbags-mcap", {"image_type": COMPRESSED, "pose_type": TRANSFORM}),
    ("rosbags-sqlite3", {"encoding": "rgb8", "pose_type": "nav_msgs/msg/Odometry"}),
]


def advnerf(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(("writer", "options"), FORMS)
def test_a_policy_learns_from_foreign_pictures_in_their_colours(tmp_path, writer, options):
    recording = frames_of(open_log(WRITERS[writer](tmp_path / "drive", **options)), VIEW, EXPERT, "expert")
    assert len(recording.frames.images) == COUNT
    for index, image in enumerate(recording.frames.images):
        np.testing.assert_array_equal(image, VIEW.image(rgb_at(index)))
    assert recording.stamps_ns.tolist() == [START_NS + k * STEP_NS - 5_000_000 for k in range(COUNT)]
    np.testing.assert_allclose(
        recording.frames.states[:, 0], [state_at(k)[0][0] for k in range(COUNT)], atol=1e-9
    )


def test_grey_pictures_train_and_other_encodings_are_one_line(tmp_path):
    grey = WRITERS["mcap"](tmp_path / "grey", encoding="mono8")
    (image, *_) = frames_of(open_log(grey), VIEW, EXPERT, "expert").frames.images
    np.testing.assert_array_equal(image, VIEW.image(np.repeat(rgb_at(0)[..., 1:2], 3, axis=2)))
    depth = WRITERS["rosbags-sqlite3"](tmp_path / "depth", encoding="32FC1")
    with pytest.raises(MessageError) as caught:
        frames_of(open_log(depth), VIEW, EXPERT, "expert")
    text = str(caught.value)
    assert text.startswith(
        f"/camera/image_raw in {depth}: expected a supported image encoding, got '32FC1'; supported are rgb8"
    )
    assert "\n" not in text


def test_the_commands_to_train_and_to_make_a_data_set_take_a_foreign_bag(tmp_path):
    bag = WRITERS["rosbags-sqlite3"](tmp_path / "drive", encoding="bgr8", pose_type=TRANSFORM)
    trained = advnerf(
        "policy",
        "train",
        bag,
        "--camera",
        CAMERA,
        "--room",
        ROOM,
        "--steps",
        2,
        "-o",
        tmp_path / "policy",
    )
    assert trained.exit_code == 0, trained.output
    made = advnerf(
        "scene",
        "from-bag",
        bag,
        "-o",
        tmp_path / "set",
        "--calibration",
        CAMERA,
        "--step",
        0.01,
        "--margin",
        2,
    )
    assert made.exit_code == 0, made.output
    pictures = sorted((tmp_path / "set" / "images").rglob("*.png"))
    assert pictures
    for picture in pictures:
        index = round((int(picture.stem) - START_NS) / STEP_NS)
        np.testing.assert_array_equal(cv2.imread(str(picture))[..., ::-1], rgb_at(index))


def test_reference_frames_and_calibration_read_foreign_bags(tmp_path):
    bag = WRITERS["ros1"](tmp_path / "drive", encoding="bgr8", pose_type=TRANSFORM)
    reference = from_bag(bag, ROOM, VIEW)
    np.testing.assert_array_equal(reference.images[2], VIEW.image(rgb_at(2)))
    pictures = list(read_pictures(bag.parent))
    assert [int(name) for name, _ in pictures] == [START_NS + k * STEP_NS - 5_000_000 for k in range(COUNT)]
    np.testing.assert_array_equal(pictures[1][1], rgb_at(1))
    np.testing.assert_allclose(
        read_poses(bag, "/vicon/car").T[:, 1, 3], [state_at(k)[0][1] for k in range(COUNT)]
    )


@pytest.mark.parametrize("writer", WRITERS)
def test_a_foreign_bag_is_described(tmp_path, writer):
    bag = WRITERS[writer](tmp_path / "drive", pose_type=TRANSFORM)
    shown = advnerf("bag", "info", bag, "--stamps")
    assert shown.exit_code == 0, shown.output
    assert f"{3 * COUNT} messages in" in shown.output
    assert TRANSFORM in shown.output
    taken = advnerf("bag", "extract", bag, "-o", tmp_path / "out")
    assert (taken.exit_code, taken.output) == (0, "")


REPLAYED = f"""\
name: foreign
nodes:
  compositor:
    module: nodes.compositor
    config: {{camera: {CAMERA}, target: {TWIN / "board.yaml"}}}
"""


def test_one_drive_in_four_formats_replays_to_the_same_bytes(tmp_path):
    (tmp_path / "foreign.launch.yaml").write_text(REPLAYED)
    choice = Choice(("compositor",), launch=tmp_path / "foreign.launch.yaml")
    digests = set()
    for writer, write in WRITERS.items():
        with Replay(write(tmp_path / writer, encoding="bgr8", pose_type=TRANSFORM), choice) as replay:
            made = [message for message in replay if not message.topic.startswith("/status/")]
        assert len(made) == 2 * COUNT
        digests.add(replay.summary.digest)
    assert len(digests) == 1


def test_a_whole_replay_of_a_foreign_bag_says_what_it_leaves_out(tmp_path):
    (tmp_path / "foreign.launch.yaml").write_text(REPLAYED)
    bag = WRITERS["rosbags-sqlite3"](tmp_path / "drive", pose_type=TRANSFORM)
    arguments = (
        "--nodes",
        "compositor",
        "--launch",
        tmp_path / "foreign.launch.yaml",
        "-o",
        tmp_path / "again",
    )
    done = advnerf("bag", "replay", bag, *arguments)
    assert done.exit_code == 0, done.output
    assert "without /chatter (not in the topic table)" in " ".join(done.output.split())
    kept = {topic.name: (topic.type, topic.count) for topic in read_info(tmp_path / "again").topics}
    assert kept["/vicon/car"] == ("geometry_msgs/msg/PoseStamped", COUNT)
    assert "/chatter" not in kept


def player(bag, run_dir, *arguments):
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "bag",
        "play",
        str(bag),
        "--folder",
        str(run_dir),
        *map(str, arguments),
    ]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("writer", ["rosbags-sqlite3", "ros1"])
def test_a_foreign_bag_is_played_in_our_types_and_under_our_names(tmp_path, writer):
    bag = WRITERS[writer](
        tmp_path / "drive", pose_type=TRANSFORM, image_type=COMPRESSED, image_topic="/front/image"
    )
    with Bus(tmp_path / "run") as bus:
        bus.subscribe("/vicon/car")
        bus.subscribe("/camera/image_raw", queue=50)
        wanted = ("--wait-for", "/vicon/car", "--wait-for", "/camera/image_raw")
        process = player(bag, tmp_path / "run", "--remap", "/front/image:=/camera/image_raw", *wanted)
        got, deadline = [], time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:
            bus.wait(0.05)
            got += bus.receive()
        got += bus.receive()
    assert process.wait(120) == 0
    (warning,) = process.stderr.read().splitlines()
    assert "unchecked: " in warning
    assert "has no checksums" in warning
    poses = [entry.message() for entry in got if entry.topic == "/vicon/car"]
    assert [stamp_ns(pose) for pose in poses] == [START_NS + k * STEP_NS - 5_000_000 for k in range(COUNT)]
    assert pose_matrix(poses[3])[0, 3] == pytest.approx(state_at(3)[0][0])
    images = [entry.message() for entry in got if entry.topic == "/camera/image_raw"]
    assert {(image.encoding, image.width, image.height) for image in images} == {("rgb8", 336, 188)}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--offset", 99], "expected a start offset between 0 and 0.5 s"),
        (["--topics", "/nothing"], "has no topic /nothing; it has /camera/image_raw, /chatter, /vicon/car"),
        (["--topics", "/chatter"], "unknown topic '/chatter'; known are /camera/image_raw"),
        (
            ["--remap", "/vicon/car:=/odom"],
            "/vicon/car is geometry_msgs/msg/PoseStamped, expected nav_msgs/msg/Odometry",
        ),
        (
            ["--topics", "/vicon/car", "--offset", 0.45, "--duration", 0.01],
            "has no message of /vicon/car after 0.45 s within 0.01 s",
        ),
        (["--wait-for", "/arm"], "cannot wait for subscribers of /arm, which is not played"),
    ],
)
def test_a_wrong_wish_of_the_player_is_one_line_and_exit_code_2(tmp_path, arguments, said):
    process = player(WRITERS["mcap"](tmp_path / "drive"), tmp_path / "run", *arguments)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 2
    assert errors.count("\n") == 1
    assert said in errors
    assert "traceback" not in errors.lower()
    assert not list((tmp_path / "run").rglob("*.traceback.txt"))


def test_a_file_that_is_no_bag_is_one_line_and_exit_code_2(tmp_path):
    path = tmp_path / "notes.mcap"
    path.write_text("drove well today\n")
    process = player(path, tmp_path / "run")
    _, errors = process.communicate(timeout=600)
    assert (process.returncode, errors.count("\n")) == (2, 1)
    assert "notes.mcap is a text file; expected a bag" in errors
