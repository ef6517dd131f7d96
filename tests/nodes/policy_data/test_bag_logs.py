"""Bags as logs: ours exported and read again, and those of other software with Ackermann commands."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.writer import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.data.logs.lerobot_write import write_lerobot
from advnerf_core.driving.expert import Expert
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.view import PolicyView
from nodes.bags.one_clock import OneClockError, require_one_clock
from nodes.bags.reader import read_attachments, read_messages
from nodes.bags.writer import BagWriter
from nodes.lab.importing.driven_bag import BagConfig, take_frames
from nodes.lab.policy_data.frames import frames_of, view_for_size
from nodes.lab.policy_data.log_facts import read_facts
from nodes.lab.policy_data.logs import open_log
from nodes.runtime.messages import (
    decode,
    encode,
    header,
    image_message,
    ns_from_stamp,
    pose_message,
    stamp_from_ns,
    types,
)
from tests.support.commands import advnerf
from tests.support.foreign_samples import IMAGE, Make

TWIN_CAMERA = Path(__file__).parents[3] / "calibration" / "twin" / "camera.yaml"
START_NS, STEP_NS, COUNT = 1_800_000_000_000_000_000, 100_000_000, 24
ACKERMANN, DRIVE = "ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive"
DEFINITIONS = {
    DRIVE: "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    ACKERMANN: "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}
VIEW = PolicyView(Pinhole(64, 48, 33.0, 33.0, 32.0, 24.0), 6, 28)
EXPERT = Expert(DrivingPath.rounded_square(4.0, 1.1))


def picture(k):
    rows, columns = np.mgrid[0:48, 0:64]
    return np.stack([columns * 3 + k, rows * 4, 200 - columns - k], axis=2).astype(np.uint8)


def pose(k):
    T = np.eye(4)
    T[:2, 3] = EXPERT.path.pose_at(np.array([0.08 * k]))[0, :2]
    return T


def write_bag(folder, pause_after=12, braking=(5, 6), disturbed=(15,)):
    """Ours: a pause, the car brakes during two frames (the second has the next command), and one in which the expert disturbs itself."""
    with BagWriter(folder, {"room.yaml": b"x: 1\n"}) as bag:
        for k in range(COUNT):
            t = START_NS + k * STEP_NS + (k > pause_after) * 3_000_000_000
            numbers = {
                "speed_mps": 0.8,
                "steering_rad": 0.01 * k - 0.1,
                "erpm": 0.0,
                "servo": 0.5,
                "brake_current_a": 0.0,
            }
            times = {"serial_write_mono_ns": t, "serial_write_real_ns": t}
            sent = types.MotorSent(
                header=header(t, "car"), braking=k in braking, reason="", peer="", **numbers, **times
            )
            zeros = dict.fromkeys(
                ("cte_m", "heading_error_rad", "s_m", "driven_m", "speed_mps", "steering_rad"), 0.0
            )
            wish = types.ExpertState(header=header(t, "car"), disturbance_rad=0.1 * (k in disturbed), **zeros)
            rows = {
                "/camera/image_raw": image_message(picture(k), t, "camera"),
                "/vicon/car": pose_message(pose(k), t),
            }
            for topic, message in {**rows, "/motor/sent": sent, "/expert/state": wish}.items():
                bag.write(topic, encode(message), t, t, k)
    return folder


def test_a_bag_is_one_in_capital_letters_too(tmp_path):
    part = next(write_bag(tmp_path / "bag").glob("*.mcap"))
    copied = part.rename(tmp_path / "DRIVE.MCAP")
    assert open_log(copied).count == COUNT


@pytest.mark.parametrize(("labels", "codec"), [("recorded", "libx264rgb"), ("expert", "libvpx-vp9")])
def test_a_bag_that_was_exported_gives_the_same_frames(tmp_path, monkeypatch, labels, codec):
    pytest.importorskip("pyarrow")
    av = pytest.importorskip("av")
    assert codec in av.codecs_available
    monkeypatch.setattr(av, "codecs_available", {codec})
    bag = write_bag(tmp_path / "bag")
    assert advnerf(monkeypatch, "policy", "log", "export", str(bag), "-o", str(tmp_path / "set")) == 0
    exported = open_log(tmp_path / "set")
    assert (exported.count, exported.labels, exported.unit.unknown) == (COUNT - 1, "expert", "")
    assert exported.attached() == {"room.yaml": b"x: 1\n"}
    first, again = (frames_of(log, VIEW, EXPERT, labels) for log in (open_log(bag), exported))
    kept = np.isfinite(first.recorded_rad)  # what the car did while it braked is not exported
    assert again.stamps_ns.tolist() == first.stamps_ns[kept].tolist()
    assert again.recorded_rad == pytest.approx(first.recorded_rad[kept])
    assert again.frames.states == pytest.approx(first.frames.states[kept], abs=1e-6)
    assert again.frames.steering_rad == pytest.approx(first.frames.steering_rad[kept], abs=1e-5)
    assert np.array_equal(again.frames.images, first.frames.images[kept])
    assert first.counts["disturbed"] == again.counts["disturbed"] == (1 if labels == "recorded" else 0)


def test_an_export_has_an_episode_for_each_drive_and_never_replaces_one(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    log = open_log(write_bag(tmp_path / "bag"))
    done = write_lerobot(log, tmp_path / "set")
    assert (done.frames, done.episodes, done.rate_hz, done.left_out) == (COUNT - 1, 3, 10, 1)
    rows = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in rows] == [5, 7, 11]
    with pytest.raises(LogError, match="set exists; remove it or choose another folder"):
        write_lerobot(log, tmp_path / "set")
    with pytest.raises(LogError, match="expected steering in"):
        write_lerobot(open_log(write_ackermann(tmp_path / "two", "ros2", ("/a", "/b"))), tmp_path / "other")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["bag", "set", "two"]


def write_ackermann(
    path,
    form,
    topics=("/drive",),
    unstamped=(),
    late_ns=1000,
    step=0.02,
    count=6,
    going_back=(),
    depths=(),
    more_images=(),
    log_back_ns=0,
    repeated=(),
    kind=ACKERMANN,
    ahead_s=0,
):
    """A bag of other software: images, and commands of a car.

    Args:
        unstamped: Topics whose stamps are all zero.
        late_ns: From an image to the recording of its command, and, in another clock, to its stamp [ns].
        step: Steering of an image above that of the one before.
        going_back: Topics whose clock jumps 2 s back before the fourth image.
        depths: Topics with images of depths.
        more_images: Topics with one picture that never changes.
        log_back_ns: By how much the recorder's clock is set back before the fourth image [ns].
        kind: Type of the commands.
        ahead_s: By how much the clock of the commands is ahead [s].
        repeated: Images with the stamp of the one before.
    """
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    make = Make(store)
    make.ros1 = form == "ros1"
    if form == "ros1":
        path = path.with_suffix(".bag")
        writer, pack = rosbag1.Writer(path), store.serialize_ros1
    else:
        writer, pack = (
            rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3),
            store.serialize_cdr,
        )
    with writer:
        images = writer.add_connection("/front/image", IMAGE, typestore=store)
        still = make.image(0)
        still_images = [writer.add_connection(topic, IMAGE, typestore=store) for topic in more_images]
        depth_images = [writer.add_connection(topic, IMAGE, typestore=store) for topic in depths]
        drives = [writer.add_connection(topic, kind, typestore=store) for topic in topics]
        for k in range(count):
            image = make.image(k)
            t = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec - (log_back_ns if k >= 3 else 0)
            if "/front/image" in unstamped:
                image.header.stamp.sec = image.header.stamp.nanosec = 0
            image.header.stamp.sec -= 2 if k >= 3 and "/front/image" in going_back else 0
            if k in repeated:
                image.header.stamp = make.header(k - 1, "camera").stamp
            writer.write(images, t, pack(image, IMAGE))
            for each in still_images:
                still.header.stamp = image.header.stamp
                writer.write(each, t, pack(still, IMAGE))
            image.encoding = "32FC1"
            for depth in depth_images:
                writer.write(depth, t, pack(image, IMAGE))
            for topic, drive in zip(topics, drives, strict=True):
                command = store.types[DRIVE](step * k, 0.0, 1.5, 0.0, 0.0)
                if kind != ACKERMANN:
                    other = command if kind == DRIVE else store.types[kind](step * k)
                    writer.write(drive, t + late_ns, pack(other, kind))
                    continue
                message = store.types[ACKERMANN](header=make.header(k, "car"), drive=command)
                message.header.stamp.sec += late_ns // 10**9 - (2 if k >= 3 and topic in going_back else 0)
                message.header.stamp.sec += ahead_s
                if topic in unstamped:
                    message.header.stamp.sec = message.header.stamp.nanosec = 0
                writer.write(drive, t + late_ns, pack(message, ACKERMANN))
    return path


@pytest.mark.parametrize("form", ["ros1", "ros2"])
def test_ackermann_commands_of_other_software_are_wheel_angles(tmp_path, form):
    log = open_log(write_ackermann(tmp_path / "drive", form))
    assert (log.images, log.controls, str(log.unit)) == (
        "/front/image",
        ("/drive",),
        "/drive [rad], left positive",
    )
    assert log.rate_hz == pytest.approx(10.0)
    assert [frame.steering for frame in log.frames()] == pytest.approx([0.02 * k for k in range(6)])
    assert [frame.speed_mps for frame in log.frames()] == pytest.approx([1.5] * 6)
    assert log.steering() == pytest.approx([0.02 * k for k in range(6)])


@pytest.mark.parametrize("unstamped", [("/drive",), ("/front/image",), ("/front/image", "/drive")])
def test_what_has_no_stamps_is_joined_by_the_times_of_recording(tmp_path, unstamped):
    """A zero stamp of every command would give all images one command, the smallest."""
    log = open_log(write_ackermann(tmp_path / "drive", "ros2", unstamped=unstamped))
    assert log.notes == (
        f"images and steering are joined by times of recording, as all stamps on {' and '.join(unstamped)} are equal",
    )
    assert [frame.steering for frame in log.frames()] == pytest.approx([0.02 * k for k in range(6)])
    assert log.labels == "recorded"  # without poses there is no expert


def test_another_recording_in_the_folder_of_a_bag_is_named(tmp_path):
    bag = write_ackermann(tmp_path / "drive", "ros2")
    (part,) = open_log(bag).files
    assert open_log(bag).notes == ()
    other = shutil.copy(part, bag / f"earlier{part.suffix}")
    (note,) = open_log(bag).notes
    assert note == f"not read, as no part of this bag: {other.name}; give each of these files by itself"
    assert open_log(bag).count == open_log(other).count


def test_two_drives_whose_stamps_overlap_are_not_joined_with_each_other(tmp_path):
    log = open_log(write_ackermann(tmp_path / "drive", "ros2", going_back=("/front/image", "/drive")))
    with pytest.raises(
        LogError, match=r"drive, /drive: expected stamps that go forward, got one 1\.9 s before"
    ):
        list(log.frames())


@pytest.mark.parametrize("topic", ["/front/image", "/drive"])
def test_a_clock_of_one_topic_that_is_set_back_in_the_drive_is_refused(tmp_path, topic):
    other = {"/front/image": "/drive", "/drive": "/front/image"}[topic]
    said = rf"expected stamps of one clock, got those of {other} (0|1e-06) s before their recording, and those of {topic} 2 s before it"
    for count in (8, 300):
        bag = write_ackermann(tmp_path / f"drive{count}", "ros2", count=count, going_back=(topic,))
        with pytest.raises(LogError, match=said):
            open_log(bag)


@pytest.mark.parametrize("form", ["ros1", "ros2"])
@pytest.mark.parametrize("hours", [2, 9000, -2])
def test_a_recorder_whose_clock_was_set_does_not_change_the_order_of_the_drive(tmp_path, form, hours):
    """Stamps are those of the drive; only the log time goes back."""
    right = list(open_log(write_ackermann(tmp_path / "right", form)).frames())
    bag = write_ackermann(tmp_path / "drive", form, log_back_ns=hours * 3600 * 10**9)
    frames = list(open_log(bag).frames())
    assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in right]
    assert [frame.steering for frame in frames] == pytest.approx([0.02 * k for k in range(6)])
    assert all(np.array_equal(one.image, two.image) for one, two in zip(frames, right, strict=True))


def test_two_drives_whose_stamps_overlap_are_refused_after_a_pause_too(tmp_path):
    both = ("/front/image", "/drive")
    bag = write_ackermann(
        tmp_path / "drive", "ros2", count=40, going_back=both, log_back_ns=-2 * 3600 * 10**9
    )
    with pytest.raises(LogError, match=r"expected stamps that go forward, got one 1.* s before"):
        list(open_log(bag).frames())


@pytest.mark.parametrize(("repeated", "first"), [((1, 3, 5), 1), ((4,), 4)])
def test_an_image_with_the_stamp_of_another_is_refused(tmp_path, repeated, first):
    log = open_log(write_ackermann(tmp_path / "drive", "ros2", repeated=repeated))
    said = rf"image {first}: expected a stamp that no other image has.* got that of \S*drive, image {first - 1}; remove"
    with pytest.raises(LogError, match=said):
        list(log.frames())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"late_ns": 60 * 10**9}, "no steering belongs to any of the first 20 images: their times differ"),
        (
            {"step": 20.0},
            "/drive: expected a steering angle below 1 rad, got 380 times 1; give the wheel angle at a value of 1 with --steering-full-rad",
        ),
        (
            {"step": 1.0},
            "/drive: expected a steering angle below 1 rad, got 19 times 1; these look like degrees: give --steering-full-rad 0.01745",
        ),
    ],
)
def test_a_log_that_training_refuses_is_not_promised(tmp_path, change, told):
    facts = read_facts(open_log(write_ackermann(tmp_path / "drive", "ros2", count=20, **change)))
    learned, _, evaluated = facts.verdicts()
    assert not learned.possible
    assert (learned.why, evaluated.why) == (told, told)
    facts = read_facts(open_log(write_ackermann(tmp_path / "right", "ros2", count=20)))
    assert [each.possible for each in facts.verdicts()][::2] == [True, True]


def poses_of_another_clock(folder, log_path, shift_ns):
    """A copy of a bag of ours whose poses alone are stamped by another clock."""
    with BagWriter(folder, read_attachments(log_path)) as copy:
        for message in read_messages(log_path):
            cdr = message.cdr
            if message.topic == "/vicon/car":
                found = decode("geometry_msgs/msg/PoseStamped", cdr)
                found.header.stamp = stamp_from_ns(ns_from_stamp(found.header.stamp) + shift_ns)
                cdr = encode(found)
            copy.write(message.topic, cdr, message.log_ns, message.publish_ns, message.sequence)
    return folder


@pytest.mark.parametrize(("shift_s", "said"), [(2, "2 s after"), (-2, "2 s before")])
def test_poses_of_another_clock_are_refused(tmp_path, shift_s, said):
    """The expert's labels were those of places where the car was not."""
    bag = poses_of_another_clock(tmp_path / "other", write_bag(tmp_path / "bag"), shift_s * 10**9)
    with pytest.raises(LogError, match=f"expected stamps of one clock, got .*those of /vicon/car {said}"):
        open_log(bag)
    with pytest.raises(OneClockError, match="expected stamps of one clock"):
        take_frames(bag, tmp_path / "images", BagConfig(), lambda *_: None, TWIN_CAMERA)


@pytest.mark.parametrize(("shift_s", "refused"), [(0.3, True), (0.15, True), (-0.3, False), (0.04, False)])
def test_stamps_after_their_recording_are_of_another_clock(tmp_path, shift_s, refused):
    """A link that is 0.3 s late is possible, one that delivers before the capture is not."""
    bag = poses_of_another_clock(tmp_path / "other", write_bag(tmp_path / "bag"), round(shift_s * 10**9))
    topics = ("/camera/image_raw", "/vicon/car")
    if not refused:
        require_one_clock(bag, topics)
        return
    with pytest.raises(OneClockError, match=rf"those of /vicon/car {shift_s:g} s after their recording"):
        require_one_clock(bag, topics)


def test_the_rate_is_that_of_the_stamps(tmp_path):
    """A link delivers pictures in bursts."""
    bag = write_bag(tmp_path / "bag")
    with BagWriter(tmp_path / "bursts", {}) as copy:
        for number, message in enumerate(read_messages(bag)):
            late_ns = message.log_ns + 1000 * number if number % 16 else message.log_ns
            in_burst = late_ns // (4 * STEP_NS) * 4 * STEP_NS + 4 * STEP_NS + number % 16
            copy.write(message.topic, message.cdr, in_burst, in_burst, message.sequence)
    assert open_log(tmp_path / "bursts").rate_hz == pytest.approx(open_log(bag).rate_hz)


def test_the_first_of_several_cameras_is_named_and_equal_images_teach_nothing(tmp_path, monkeypatch, capsys):
    bag = write_ackermann(tmp_path / "drive", "ros2", ("/drive",), count=30, more_images=("/back/image",))
    log = open_log(bag)
    note = "images of /back/image, the first of /back/image, /front/image; --images chooses others"
    assert (log.images, log.notes) == ("/back/image", (note,))
    assert open_log(bag, LogChoice(images="/front/image")).notes == ()
    assert open_log(write_bag(tmp_path / "ours")).notes == ()  # our own topics have an order of their own
    said = r"expected images that differ in .*drive, got \d+ equal ones of /back/image; choose others with --images"
    with pytest.raises(LogError, match=said):
        frames_of(log, view_for_size(336, 188), None, "recorded")
    pytest.importorskip("pyarrow")
    assert advnerf(monkeypatch, "policy", "log", "export", str(bag), "-o", str(tmp_path / "set")) == 0
    assert f"note: {note}" in capsys.readouterr().out


def test_what_scenes_and_labels_of_a_bag_need_is_said(tmp_path):
    ours = write_bag(tmp_path / "bag")
    facts = read_facts(open_log(ours))
    policy, scene, _ = facts.verdicts()
    assert policy.why.startswith("labels by the expert at the poses;")
    assert scene.possible
    other = replace(facts, has_room=False, log=replace(facts.log, images="/front/image"))
    policy, scene, _ = other.verdicts()
    assert policy.why.startswith(
        "labels by the expert at the poses, with --room, as no room.yaml is attached;"
    )
    assert not scene.possible
    assert scene.why.endswith(
        "reads images on /camera/image_raw or /camera/image_raw/compressed, these are on /front/image"
    )


def test_commands_of_another_clock_are_refused(tmp_path):
    """Most images got the steering of two seconds later."""
    said = r"expected stamps of one clock, got those of /drive 2 s after their recording, and those of /front/image 0 s before it; set the"
    with pytest.raises(LogError, match=said):
        open_log(write_ackermann(tmp_path / "drive", "ros2", count=60, ahead_s=2))
    said = "got those of /front/image 0 s before their recording, and those of /drive 3 s before it"
    with pytest.raises(LogError, match=said):
        open_log(write_ackermann(tmp_path / "behind", "ros2", count=60, ahead_s=-3))


def test_a_drive_whose_clocks_differ_is_answered_with_the_times(tmp_path):
    log = open_log(write_ackermann(tmp_path / "drive", "ros2", count=20, late_ns=3600 * 10**9))
    for use in (lambda: frames_of(log, VIEW, None, "recorded"), lambda: write_lerobot(log, tmp_path / "set")):
        with pytest.raises(
            LogError, match=r"got 0 \(20 no command\); their times and those of the steering differ"
        ):
            use()
    empty = open_log(write_ackermann(tmp_path / "empty", "ros2", count=20, step=np.nan))
    with pytest.raises(LogError, match=r"got 0 \(20 no command\); record the steering too"):
        frames_of(empty, VIEW, None, "recorded")
    short = open_log(write_ackermann(tmp_path / "short", "ros2", count=3))
    with pytest.raises(LogError, match=r"got 3 \(no other images\); record more"):
        write_lerobot(short, tmp_path / "set")


@pytest.mark.parametrize("kind", [DRIVE, "std_msgs/msg/Float64"])
def test_steering_of_another_type_is_named_with_the_type_that_is_read(tmp_path, kind):
    bag = write_ackermann(tmp_path / "drive", "ros2", ("/steer",), kind=kind)
    said = f"wheel angles are read from {ACKERMANN}, the bag has /steer ({kind}); convert the messages"
    learned, _, evaluated = read_facts(open_log(bag)).verdicts()
    assert said in learned.why
    assert said in evaluated.why
    for refused in (
        lambda: open_log(bag, LogChoice(steering="/steer")),
        lambda: frames_of(open_log(bag), VIEW, None, "recorded"),
        lambda: write_lerobot(open_log(bag), tmp_path / "set"),
    ):
        with pytest.raises(LogError, match=re.escape(said)):
            refused()


def test_the_setting_for_degrees_gives_the_angle_in_radians(tmp_path):
    degrees = open_log(
        write_ackermann(tmp_path / "drive", "ros2", step=1.0), LogChoice(steering_full_rad=0.01745)
    )
    found = frames_of(degrees, view_for_size(336, 188), None, "recorded").recorded_rad
    assert found == pytest.approx(np.deg2rad(range(6)), rel=1e-3)


def test_of_two_topics_with_commands_none_is_taken_unasked(tmp_path):
    bag = write_ackermann(tmp_path / "drive", "ros2", ("/a", "/b"))
    assert (open_log(bag).unit, open_log(bag).controls) == (None, ("/a", "/b"))
    assert open_log(bag, LogChoice(steering="/b")).unit.name == "/b"
    with pytest.raises(LogError, match=r"expected a topic with wheel angles /c in .*, it has /a, /b"):
        open_log(bag, LogChoice(steering="/c"))


def test_images_that_cannot_be_shown_are_answered_with_the_others(tmp_path):
    bag = write_ackermann(tmp_path / "drive", "ros2", depths=("/aligned_depth/image",))
    log = open_log(bag)
    said = r"expected a supported image encoding, got '32FC1'.*; or choose other images with --images: /front/image"
    with pytest.raises(LogError, match=said):
        log.first_image()
    assert len(list(open_log(bag, LogChoice(images="/front/image")).frames())) == 6


def test_a_damaged_bag_is_one_line(tmp_path, monkeypatch, capsys):
    for form in ("ros1", "ros2"):
        bag = write_ackermann(tmp_path / f"drive_{form}", form)
        file = bag if bag.is_file() else next(bag.glob("*.db3"))
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        assert advnerf(monkeypatch, "policy", "log", "info", str(bag)) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert file.name in line


def test_one_drive_in_two_formats_is_not_trained_on(tmp_path, monkeypatch, capsys):
    logs = [str(write_ackermann(tmp_path / form, form, count=20)) for form in ("ros1", "ros2")]
    assert advnerf(monkeypatch, "policy", "train", *logs, "--steps", "1", "-o", str(tmp_path / "out")) == 2
    said = f"got {logs[0]} and {logs[1]}, which have 20 images in common; remove one of them"
    assert said in capsys.readouterr().err
