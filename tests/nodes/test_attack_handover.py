"""A running compositor and a sender on the real bus."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.attack.artifact import face_texture, save_attack
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from calibration.schema import TargetCalibration, load_calibration
from nodes.runtime.bus import Bus
from nodes.runtime.messages import decode, encode, image_message, pose_message
from nodes.runtime.topics import status_topic
from nodes.runtime.transfer import chunk_messages
from tests.support.faces import face_attack

REPOSITORY = Path(__file__).parents[2]
CALIBRATION = REPOSITORY / "calibration" / "twin"
TARGET = load_calibration(TargetCalibration, CALIBRATION / "board.yaml")
BOARD = make_transform(rotation_z(np.deg2rad(172)), [3.15, -1.75, 0.42])
INPUTS = ("/camera/image_raw", "/vicon/car", "/vicon/board", "/attack/file")


def attack(folder, seed):
    theta = np.random.default_rng(seed).normal(size=(8, 8, 3)).astype(np.float32)
    made = face_attack(
        method="gradient",
        theta=theta,
        texture=face_texture(theta),
        size_m=(1.0, 1.0),
        T_world_from_object=BOARD,
        subject="board",
        corners_in_subject=TARGET.corners,
        seed=seed,
        predicted_total_cte_m=1.0,
    )
    file = folder / f"{seed}.safetensors"
    return file, save_attack(file, made)


class Drive:
    """Plays camera, motion capture and attack node to a compositor."""

    def __init__(self, run_dir, file):
        self.bus, self.labels, self.images, self.status = Bus(run_dir), [], [], None
        config = run_dir / "compositor.yaml"
        files = {
            "attack": str(file),
            "camera": str(CALIBRATION / "camera.yaml"),
            "target": str(CALIBRATION / "board.yaml"),
        }
        config.write_text(yaml.safe_dump(files))
        command = [
            sys.executable,
            "-m",
            "nodes.compositor",
            "--config",
            str(config),
            "--folder",
            str(run_dir),
        ]
        self.process = subprocess.Popen(command, cwd=REPOSITORY)
        for topic in INPUTS:
            self.bus.publisher(topic)
        for topic in ("/compositor/attack", "/compositor/image"):
            self.bus.subscribe(topic, queue=100)
        self.bus.subscribe(status_topic("compositor"))
        self.bus.wait_for_subscribers(INPUTS, 20.0)

    def frame(self):
        now = time.time_ns()
        for stamp in (now - 20_000_000, now):
            self.bus.publish("/vicon/board", pose_message(BOARD, stamp))
            self.bus.publish("/vicon/car", pose_message(planar_pose(0.5, -2.0, 0.0), stamp))
        stamp = now - 10_000_000
        self.bus.publish(
            "/camera/image_raw", image_message(np.full((188, 336, 3), 90, np.uint8), stamp, "camera")
        )
        self.listen(0.1, lambda: self.labels and self.labels[-1].header.stamp.nanosec == stamp % 10**9)

    def listen(self, seconds, until):
        deadline = time.monotonic() + seconds
        while not until() and (left := deadline - time.monotonic()) > 0:
            self.bus.wait(left)
            for received in self.bus.receive():
                message = received.message()
                if received.topic == "/compositor/attack":
                    self.labels.append(message)
                elif received.topic == "/compositor/image":
                    self.images.append(message)
                else:
                    self.status = message

    def send(self, chunks):
        for chunk in chunks:
            self.bus.publish("/attack/file", chunk)
            self.frame()
        self.frame()

    def counter(self, name):
        return dict(zip(self.status.counter_names, self.status.counter_values, strict=True))[name]

    def close(self):
        self.process.send_signal(signal.SIGTERM)
        try:
            assert self.process.wait(120) == 0
        finally:
            self.process.kill()
            self.bus.close()


@pytest.fixture
def drive(tmp_path):
    made = Drive(tmp_path, attack(tmp_path, 1)[0])
    yield made
    made.close()


def test_only_a_whole_and_verified_attack_replaces_the_old_one_while_images_flow(drive, tmp_path):
    old, (file, new) = attack(tmp_path, 1)[1], attack(tmp_path, 2)
    chunks = [
        decode("advnerf_msgs/msg/FileChunk", encode(c)) for c in chunk_messages(file.read_bytes(), new, 0)
    ]
    assert len(chunks) >= 3
    drive.frame()
    broken = [*chunks[:2], replace(chunks[2], data=chunks[2].data ^ 1), *chunks[3:]]
    for wrong in (broken, chunks[:2], [chunks[1], chunks[0], chunks[2]]):
        drive.send(wrong)
    assert {label.attack_id for label in drive.labels} == {old}
    drive.listen(1.0, lambda: drive.status is not None and "refused" in drive.status.text)
    assert "new attack refused" in drive.status.text
    assert drive.status.state == "active"
    drive.send(chunks)
    drive.frame()
    ids = [label.attack_id for label in drive.labels]
    assert ids[-1] == new
    assert ids.index(new) == len(ids) - ids.count(new)  # once, and for good
    assert all(label.drawn for label in drive.labels)
    assert len(drive.images) >= len(ids) - 1
    drive.listen(1.0, lambda: drive.counter("attacks_taken") == 1)
    assert drive.counter("attacks_taken") == 1
    assert drive.counter("attacks_refused") >= 2
