"""VICON packets against a hand-packed one, the forms of occlusion, and a real UDP socket."""

import math
import socket
import struct
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import make_transform, planar_pose
from hardware.errors import DeviceBusy, ProtocolError
from hardware.mocap.vicon import SubjectTracker, ViconConfig, ViconReceiver
from hardware.mocap.vicon_codec import ObjectPose, decode_block, encode_blocks, object_pose

pytestmark = pytest.mark.live

CONFIG = ViconConfig(subjects=("car", "board"), frozen_frames=4)


def by_hand(frame, items, block=1024):
    data = struct.pack("<I", frame) + bytes([len(items)])
    for name, numbers in items:
        data += b"\0" + struct.pack("<H", 72) + name.encode().ljust(24, b"\0")
        data += b"".join(struct.pack("<d", n) for n in numbers)
    return data.ljust(block, b"\0")


def at(frame, x=1.0, name="car"):
    return by_hand(frame, [(name, (x, 2.0, 3.0, 0.0, 0.0, 0.1))])


class Feed:
    def __init__(self, config=CONFIG):
        self.tracker = SubjectTracker(config)
        self.mono_ns = 10**9

    def __call__(self, datagram, after_s=0.01):
        self.mono_ns += round(after_s * 1e9)
        return self.tracker.update(datagram, self.mono_ns + 10**18, self.mono_ns)


@pytest.mark.parametrize("block", [256, 512, 1024])
def test_layout(block):
    items = [
        ("car", (1.5, -2.5, 3.5, 0.1, -0.2, 0.3)),
        ("a_name_of_24_characters_", (0.0, 1.0, 2.0, 0.0, 0.0, 0.0)),
    ]
    datagram = by_hand(7, items, block)
    objects = [ObjectPose(name, tuple(n[:3]), tuple(n[3:])) for name, n in items]
    assert decode_block(datagram).objects == tuple(objects)
    assert encode_blocks(7, objects, block) == [datagram]
    # Offsets as published: count at 4, name of the first item at 8, translation at 32, rotation at 56, second item at 80.
    assert struct.unpack_from("<d", datagram, 32)[0] == 1.5
    assert struct.unpack_from("<d", datagram, 56)[0] == 0.1
    assert datagram[83:107] == b"a_name_of_24_characters_"


@pytest.mark.parametrize(("block", "per_block"), [(256, 3), (512, 6), (1024, 13)])
def test_more_objects_than_a_block_holds(block, per_block):
    objects = [ObjectPose(f"s{i}", (i, 0.0, 0.0), (0.0, 0.0, 0.0)) for i in range(per_block + 1)]
    blocks = encode_blocks(9, objects, block)
    assert [len(b) for b in blocks] == [block, block]
    assert [len(decode_block(b).objects) for b in blocks] == [per_block, 1]


def test_rotation_convention_is_intrinsic_xyz():
    rng = np.random.default_rng(0)
    for _ in range(20):
        R = Rotation.random(random_state=rng)
        T = make_transform(R.as_matrix(), rng.normal(size=3))
        wire = object_pose("car", T)
        assert wire.rotation_rad == pytest.approx(tuple(R.as_euler("XYZ")), abs=1e-9)
        np.testing.assert_allclose(wire.T_world_from_subject, T, atol=1e-9)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_gimbal_lock_keeps_the_rotation(pitch):
    R = Rotation.from_euler("XYZ", [0.4, pitch, 0.3]).as_matrix()
    np.testing.assert_allclose(
        object_pose("car", make_transform(R, [0, 0, 0])).T_world_from_subject[:3, :3], R, atol=1e-7
    )


@pytest.mark.parametrize(
    "datagram",
    [b"", b"\0\0\0", by_hand(1, [("car", (0.0,) * 6)])[:60], struct.pack("<IB", 1, 3).ljust(256, b"\0")],
)
def test_cut_or_foreign_datagrams(datagram):
    with pytest.raises(ProtocolError):
        decode_block(datagram)
    feed = Feed()
    assert feed(datagram) == []
    assert feed.tracker.counts.refused == 1


def test_pose_in_metres_with_both_stamps():
    (pose,) = Feed(ViconConfig(subjects=("car",), latency_s=0.004))(at(5, x=1500.0))
    assert pose.T_world_from_subject[0, 3] == 1.5
    assert (pose.frame_number, pose.receive_mono_ns) == (5, 1_010_000_000)
    assert pose.stamp_real_ns == 10**18 + 1_006_000_000


@pytest.mark.parametrize(
    "lost",
    [
        by_hand(2, []),
        by_hand(2, [("car", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))]),
        by_hand(2, [("car", (0.0, 0.0, 0.0, 0.0, 0.0, 0.5))]),
        by_hand(2, [("car", (math.nan, 1.0, 1.0, 0.0, 0.0, 0.0))]),
        by_hand(2, [("car", (1.0, 1.0, 1.0, 0.0, 0.0, math.inf))]),
        by_hand(2, [("somebody", (1.0, 1.0, 1.0, 0.0, 0.0, 0.0))]),
    ],
)
def test_forms_of_occlusion(lost):
    feed = Feed()
    assert len(feed(at(1))) == 1
    assert feed(lost) == []
    assert len(feed(at(3, x=1.1))) == 1


def test_frozen_pose_is_lost_after_some_frames_and_comes_back_when_it_moves():
    feed = Feed()
    got = [len(feed(at(frame))) for frame in range(1, 9)]
    assert got == [1, 1, 1, 1, 0, 0, 0, 0]
    assert feed.tracker.counts.lost["car"] == 4
    assert len(feed(at(9, x=1.0001))) == 1


def test_duplicates_and_reordering_are_dropped():
    feed = Feed()
    assert len(feed(at(10))) == 1
    assert feed(at(10)) == []
    assert feed(at(9, x=2.0), after_s=0.001) == []
    assert feed.tracker.counts.late == 1
    assert len(feed(at(12, x=3.0))) == 1
    assert feed.tracker.counts.missed_frames == 1


def test_one_frame_in_two_datagrams():
    feed = Feed()
    assert [p.name for p in feed(at(3)) + feed(at(3, name="board"))] == ["car", "board"]


def test_wrap_of_the_frame_number():
    feed = Feed()
    assert len(feed(at(2**32 - 1))) == 1
    assert len(feed(at(0, x=2.0))) == 1
    assert (feed.tracker.counts.restarts, feed.tracker.counts.missed_frames) == (0, 0)


@pytest.mark.parametrize("before", [100_000, 20])
def test_restart_of_tracker(before):
    feed = Feed()
    feed(at(before))
    assert len(feed(at(1, x=2.0), after_s=2.0)) == 1
    assert feed.tracker.counts.restarts == 1


def test_receiver_on_a_real_socket():
    config = ViconConfig(subjects=("car",), port=0)
    with ViconReceiver(config) as receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        assert receiver.read(timeout_s=0.01) == []
        before = time.time_ns()
        for frame in range(20):
            pose = object_pose("car", planar_pose(0.1 * frame, 1.0, 0.3))
            for datagram in encode_blocks(frame, [pose], 256):
                sender.sendto(datagram, ("127.0.0.1", receiver.port))
        time.sleep(0.05)
        read_ns = time.time_ns()
        poses = receiver.read(timeout_s=60.0)
        assert [p.frame_number for p in poses] == list(range(20))
        assert poses[-1].T_world_from_subject == pytest.approx(planar_pose(1.9, 1.0, 0.3), abs=1e-9)
        # The stamp is the arrival, not the reading 50 ms later.
        assert all(before <= p.stamp_real_ns <= read_ns - 40_000_000 for p in poses)
        # Both clocks are read one after the other, and now and then something comes in between.
        offsets_ns = [time.time_ns() - time.monotonic_ns() for _ in range(10)]
        off_ns = np.subtract(offsets_ns, poses[0].stamp_real_ns - poses[0].receive_mono_ns)
        assert np.abs(off_ns).min() < 5e6


def test_port_in_use_is_one_clear_error():
    with (
        ViconReceiver(ViconConfig(subjects=("car",), port=0)) as first,
        pytest.raises(DeviceBusy, match="set another port"),
    ):
        ViconReceiver(ViconConfig(subjects=("car",), port=first.port))


# The whole way from the emulator's network to trusted poses.


def through_the_network(frames=2000, **network):
    from hardware.emulators.vicon_emulator import ViconEmulatorConfig, ViconFrames

    emulator = ViconFrames(ViconEmulatorConfig(noise_m=1e-4, noise_rad=1e-4, **network))
    feed = Feed(ViconConfig(subjects=("car", "a_name_of_24_characters_"), frozen_frames=5))
    poses = []
    for frame in range(frames):
        true = planar_pose(0.001 * frame, 1.0, 0.2)
        for datagram in emulator.next(
            {"stranger": true, "car": true, "a_name_of_24_characters_": true, "other": true}
        ):
            poses += feed(datagram, after_s=0.005)
    return feed, poses


def test_a_perfect_network_brings_every_pose_of_every_subject():
    feed, poses = through_the_network(block_bytes=256, shuffle=True)
    counts = feed.tracker.counts
    assert len(poses) == 2 * 2000  # four objects in blocks of three: two datagrams a frame
    assert (counts.datagrams, counts.late, counts.missed_frames, counts.restarts) == (4000, 0, 0, 0)


def test_a_bad_network_costs_poses_and_never_gives_a_wrong_or_an_old_one():
    feed, poses = through_the_network(loss=0.1, duplication=0.1, reordering=0.1, shuffle=True)
    cars = [p for p in poses if p.name == "car"]
    numbers = [p.frame_number for p in cars]
    assert numbers == sorted(set(numbers))  # no frame twice, none after a newer one
    assert all(abs(p.T_world_from_subject[0, 3] - 0.001 * p.frame_number) < 1e-3 for p in cars)
    assert 1500 < len(cars) < 1750  # 0.9 x 0.9, and what arrived a frame late is gone
    counts = feed.tracker.counts
    assert counts.late > 100
    assert counts.missed_frames + len(set(numbers)) == pytest.approx(2000, abs=2)
    assert counts.restarts == 0


@pytest.mark.parametrize("form", ["missing", "zeros", "nan", "frozen"])
def test_an_occluded_subject_is_lost_and_the_other_is_not(form):
    from hardware.emulators.vicon_emulator import ViconEmulatorConfig
    from tests.support.faulty_devices import FaultyViconFrames

    emulator, feed, seen = (
        FaultyViconFrames(ViconEmulatorConfig()),
        Feed(ViconConfig(("car", "board"), frozen_frames=5)),
        [],
    )
    for frame in range(60):
        if frame in (20, 40):
            emulator.occlude("car", form if frame == 20 else None)
        if frame == 50:
            emulator.frame_number = 0  # Tracker is started again
        for datagram in emulator.next(
            {"car": planar_pose(0.01 * frame, 1.0, 0.0), "board": planar_pose(3.0, 1.0, 0.0)}
        ):
            # A restart takes Tracker seconds.
            seen += [(frame, p.name) for p in feed(datagram, after_s=0.01 if frame != 50 else 2.0)]
    assert [f for f, name in seen if name == "board"] == list(range(60))
    hidden = [f for f in range(60) if (f, "car") not in seen]
    assert hidden == list(range(24 if form == "frozen" else 20, 40))
    assert feed.tracker.counts.restarts == 1
