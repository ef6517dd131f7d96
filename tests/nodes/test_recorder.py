import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from mcap.reader import make_reader
from pydantic import ValidationError
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nodes.bags.reader import read_attachment, read_info, read_messages
from nodes.bags.repair_parts import repair_bag
from nodes.recorder import RecorderConfig, RecorderNode, provenance
from nodes.runtime.bus import Bus
from nodes.runtime.clock import Now, SystemClock
from nodes.runtime.errors import BagError, NodeFinished
from nodes.runtime.messages import decode, encode, header, image_message, pose_message, types
from nodes.runtime.node import MessageInfo, NodeContext
from tests.support.messages import filled

pytestmark = pytest.mark.live


def context(tmp_path):
    return NodeContext("recorder", tmp_path, SystemClock())


def test_wire_bytes_and_all_times_go_into_the_bag_with_what_rides_along(tmp_path):
    (tmp_path / "launch.resolved.yaml").write_text("name: x\n")
    (tmp_path / "camera.yaml").write_text("fx: 1\n")
    config = RecorderConfig(
        topics=["/vicon/car"], statuses_of=["camera"], attachments=[tmp_path / "camera.yaml"]
    )
    node = RecorderNode.build(config, context(tmp_path))
    assert node.subscriptions == ("/vicon/car", "/status/camera")
    cdr = encode(pose_message(np.eye(4), 5))
    info = MessageInfo(1, 2, sequence=7, raw=cdr, publish_real_ns=1000, receive_real_ns=2000, lost=4)
    assert node.handle("/vicon/car", None, info, Now(0, 0)) == []
    node.close()
    (message,) = read_messages(tmp_path / "bag")
    assert (message.cdr, message.log_ns, message.publish_ns, message.sequence) == (cdr, 2000, 1000, 7)
    assert read_attachment(tmp_path / "bag", "camera.yaml") == b"fx: 1\n"
    assert read_attachment(tmp_path / "bag", "launch.resolved.yaml") == b"name: x\n"
    assert read_info(tmp_path / "bag").topics[0].lost == 4
    assert read_info(tmp_path / "bag").metadata.keys() >= {"git", "version", "host", "python"}


def test_the_page_ends_its_recorder_by_the_act_that_follows_its_labels(tmp_path):
    """A signal would overtake them."""
    node = RecorderNode.build(
        RecorderConfig(topics=["/operator/act"], until_page_stops=True), context(tmp_path)
    )

    def hear(number, act, granted=True):
        cdr = encode(
            filled(types.OperatorAct, header=header(number), operator="Ann", act=act, granted=granted)
        )
        info = MessageInfo(
            1, 2, sequence=number, raw=cdr, publish_real_ns=number, receive_real_ns=number, lost=0
        )
        node.handle("/operator/act", None, info, Now(0, 0))

    hear(1, "record_stop", granted=False)  # somebody who may not
    hear(2, "label")
    with pytest.raises(NodeFinished, match="Ann stopped the recording"):
        hear(3, "record_stop")
    node.close()
    bag = read_messages(tmp_path / "bag")
    acts = [decode("advnerf_msgs/msg/OperatorAct", message.cdr).act for message in bag]
    assert acts == ["record_stop", "label", "record_stop"]


def test_pictures_are_compressed_without_loss_for_every_reader(tmp_path):
    """A picture as of the simulated room, smooth with edges, takes less than half; mcap and rosbags give back its bytes."""
    rows, columns = np.mgrid[0:188, 0:336]
    rgb = np.stack([rows, columns // 2, (rows // 40 + columns // 60) * 20], axis=2).astype(np.uint8)
    node = RecorderNode.build(RecorderConfig(topics=["/camera/image_raw"]), context(tmp_path))
    sent = [encode(image_message(np.roll(rgb, k, axis=1), k, "camera")) for k in range(20)]
    for number, cdr in enumerate(sent):
        info = MessageInfo(
            1, 2, sequence=number, raw=cdr, publish_real_ns=number, receive_real_ns=number, lost=0
        )
        node.handle("/camera/image_raw", None, info, Now(0, 0))
    node.close()
    (file,) = (tmp_path / "bag").glob("*.mcap")
    assert file.stat().st_size < 0.5 * sum(map(len, sent))
    with open(file, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert {chunk.compression for chunk in reader.get_summary().chunk_indexes} == {"zstd"}
        assert [message.data for _, _, message in reader.iter_messages()] == sent
    with AnyReader([tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as theirs:
        assert [bytes(data) for _, _, data in theirs.messages()] == sent
    assert [message.cdr for message in read_messages(tmp_path / "bag")] == sent


def test_missing_attachment_is_an_error_before_anything_is_written(tmp_path):
    with pytest.raises(BagError, match=r"cannot attach .*nothing\.yaml: No such file"):
        RecorderNode.build(RecorderConfig(attachments=[tmp_path / "nothing.yaml"]), context(tmp_path))
    assert not (tmp_path / "bag").exists()


def test_unknown_key_is_refused():
    with pytest.raises(ValidationError):
        RecorderConfig(outputs="x")


def test_provenance_names_the_version():
    assert provenance()["version"]


def start_recorder(tmp_path, bus, *settings):
    command = [sys.executable, "-m", "nodes.recorder", "--folder", str(tmp_path)]
    command += [part for setting in settings for part in ("--set", setting)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    for topic in ("/camera/image_raw", "/vicon/car"):
        bus.publisher(topic)
    bus.wait_for_subscribers(["/camera/image_raw", "/vicon/car"], 20)
    return process


def drive(bus, duration_s):
    """30 Hz images and 50 Hz poses; returns how many of each were sent."""
    sent = {"/camera/image_raw": 0, "/vicon/car": 0}
    image, start = np.zeros((188, 366, 3), np.uint8), time.monotonic()
    while (t := time.monotonic() - start) < duration_s:
        if t * 30 >= sent["/camera/image_raw"]:
            bus.publish("/camera/image_raw", image_message(image, time.time_ns(), "camera"))
            sent["/camera/image_raw"] += 1
        if t * 50 >= sent["/vicon/car"]:
            bus.publish("/vicon/car", pose_message(np.eye(4), time.time_ns()))
            sent["/vicon/car"] += 1
        time.sleep(0.001)
    return sent


def test_process_records_everything_even_of_latest_topics(tmp_path):
    with Bus(tmp_path) as bus:
        process = start_recorder(tmp_path, bus)
        sent = drive(bus, 1.0)
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=600)
    assert (process.returncode, errors) == (0, "")
    assert {t.name: t.count for t in read_info(tmp_path / "bag").topics} == sent


def test_killed_process_loses_at_most_what_came_in_its_last_moment(tmp_path):
    with Bus(tmp_path) as bus:
        process = start_recorder(tmp_path, bus)
        sent = drive(bus, 1.0)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate(timeout=600)
    (repaired,) = repair_bag(tmp_path / "bag")
    # Whatever it had received is in the bag or in its journal; only what was on the way to it is gone.
    assert sum(sent.values()) - repaired.messages <= 2
    counts = {t.name: t.count for t in read_info(tmp_path / "bag").topics}
    assert set(counts) == set(sent)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_killed_process_that_splits_its_bag_loses_at_most_what_came_in_its_last_moment(tmp_path, seed):
    rng = np.random.default_rng(seed)
    with Bus(tmp_path) as bus:
        process = start_recorder(tmp_path, bus, "max_bag_size_mb=1", "max_bag_duration_s=0.1")
        sent = drive(bus, 0.6 + rng.uniform(0.0, 0.4))
        os.kill(process.pid, signal.SIGKILL)
        process.communicate(timeout=600)
    repaired = repair_bag(tmp_path / "bag")
    assert len(repaired) >= 3
    assert sum(sent.values()) - sum(part.messages for part in repaired) <= 2
    for topic, count in sent.items():
        numbers = [message.sequence for message in read_messages(tmp_path / "bag", [topic])]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert count - len(numbers) <= 2
    with AnyReader([tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        assert len(list(reader.messages())) == sum(part.messages for part in repaired)


def test_bag_that_exists_is_one_clear_line_and_exit_code_2(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "x").write_text("")
    command = [sys.executable, "-m", "nodes.recorder", "--folder", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "exists and is not empty; record to another folder" in result.stderr
    assert "traceback" not in result.stderr
