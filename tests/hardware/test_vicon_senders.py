"""Two streams of one subject: by address, by frame number, behind one address; on real sockets and through the node."""

import contextlib
import socket
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advnerf_core.geometry import planar_pose
from hardware.emulators.vicon_emulator import ViconEmulator, ViconEmulatorConfig
from hardware.mocap.vicon import SubjectTracker, ViconConfig, ViconReceiver
from hardware.mocap.vicon_codec import decode_block, encode_blocks, object_pose
from tests.support.faulty_devices import FaultyViconFrames

pytestmark = pytest.mark.live

A, B = ("10.0.0.5", 51001), ("10.0.0.7", 40000)


class Feed:
    """A tracker that is fed every 10 ms."""

    def __init__(self, *subjects):
        self.tracker = SubjectTracker(ViconConfig(subjects=subjects or ("car",)))
        self.mono_ns = 10**12

    def __call__(self, frame, x=1.0, sender=A, name="car", after_s=0.01):
        self.mono_ns += round(after_s * 1e9)
        (datagram,) = encode_blocks(frame, [object_pose(name, planar_pose(x, 2.0, 0.1))])
        return self.tracker.update(datagram, self.mono_ns + 10**18, self.mono_ns, sender)

    @property
    def fault(self):
        return self.tracker.senders.faults(self.mono_ns)


@pytest.mark.parametrize("offset", [0, 3, -3, 40, 5000, -5000])
def test_two_senders_of_one_subject_are_named_and_neither_is_trusted(offset):
    feed = Feed()
    for k in range(20):
        assert len(feed(6000 + k, 1.0 + 0.001 * k)) == 1
    seen = []
    for k in range(20, 60):
        seen += feed(6000 + k, 1.0 + 0.001 * k, A, after_s=0.005)
        if k > 20:
            assert feed.fault == "two senders of subject car: 10.0.0.5:51001 and 10.0.0.7:40000"
        seen += feed(6000 + k + offset, 1.5, B, after_s=0.005)
    assert [pose.T_world_from_subject[0, 3] for pose in seen] == [pytest.approx(1.02)]
    assert feed.tracker.counts.restarts == 0


def test_a_second_sender_that_falls_silent_is_forgiven():
    feed = Feed()
    feed(1)
    feed(900, 1.5, B)
    assert feed.fault
    seen = [feed(2 + k, 1.0 + 0.001 * k) for k in range(250)]
    assert not feed.fault
    assert [len(poses) for poses in seen[-20:]] == [1] * 20


def test_two_computers_that_send_different_subjects_are_no_fault():
    feed = Feed("car", "board")
    for k in range(300):
        assert len(feed(5000 + k, 1.0 + 0.001 * k, A, "car")) == 1
        assert len(feed(10 + k, 2.0 + 0.001 * k, B, "board")) == 1
        assert not feed.fault
    assert (feed.tracker.counts.restarts, feed.tracker.counts.late) == (0, 0)


def test_a_stranger_with_other_subjects_is_no_fault():
    feed = Feed()
    for k in range(300):
        assert len(feed(5000 + k, 1.0 + 0.001 * k, A)) == 1
        feed(10 * k, 3.0, (f"10.0.1.{k % 250}", 1000 + k), "wand")
    assert not feed.fault
    assert feed.tracker.counts.missed_frames == 0
    assert len(feed.tracker._streams) <= 16


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        (0, "two different measurements of subject car in frame"),
        (-7, "two different measurements of subject car in frame"),
        (30, "two different measurements of subject car in frame"),
        (-400, "the frame numbers of 10.0.0.5:51001, which sends subject car, went from"),
        (4000, "the frame numbers of 10.0.0.5:51001, which sends subject car, went from"),
    ],
)
def test_two_streams_behind_one_address_are_a_fault(offset, words):
    feed, faulty = Feed(), []
    for k in range(100):
        feed(6000 + k, 1.0 + 0.001 * k, after_s=0.005)
        feed(6000 + k + offset, 1.5 + 0.001 * k, after_s=0.005)
        if feed.fault:
            faulty.append(k)
            assert words in feed.fault
    assert faulty[-1] == 99
    assert faulty[0] <= max(1, abs(offset) if abs(offset) < 50 else 1)


def test_a_restarted_tracker_is_a_fault_only_without_a_pause():
    feed = Feed()
    feed(100_000)
    assert feed(1, 2.0) == []
    assert "went from 100000 to 1 within 0.01 s" in feed.fault
    for k in range(2, 120):
        feed(k, 2.0 + 0.001 * k)
    assert not feed.fault
    assert len(feed(121, 2.5)) == 1
    # With the pause that a restart takes, and from a new port, nothing is wrong.
    assert len(feed(1, 2.0, ("10.0.0.5", 60123), after_s=3.0)) == 1
    assert not feed.fault


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    loss=st.floats(0.0, 0.3),
    duplication=st.floats(0.0, 0.3),
    reordering=st.floats(0.0, 0.3),
    form=st.sampled_from([None, "missing", "zeros", "nan", "frozen"]),
    block=st.sampled_from([256, 1024]),
)
def test_no_network_and_no_occlusion_looks_like_a_second_sender(
    seed, loss, duplication, reordering, form, block
):
    config = ViconEmulatorConfig(
        seed=seed, loss=loss, duplication=duplication, reordering=reordering, shuffle=True, block_bytes=block
    )
    frames, tracker, mono_ns = (
        FaultyViconFrames(config),
        SubjectTracker(ViconConfig(subjects=("car", "board"))),
        10**12,
    )
    subjects = {name: planar_pose(1.0, 2.0, 0.3) for name in ("a", "b", "c", "car", "board")}
    for k in range(150):
        if k in (50, 100):
            frames.occlude("car", form if k == 50 else None)
        for datagram in frames.next(subjects):
            mono_ns += 3_000_000
            tracker.update(datagram, mono_ns, mono_ns, A)
            assert tracker.senders.faults(mono_ns) == ""


def test_a_late_system_sends_where_the_car_was():
    began_ns = time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10.0)
        config = ViconEmulatorConfig(
            port=receiver.getsockname()[1], noise_m=0.0, noise_rad=0.0, latency_s=0.2
        )
        emulator = ViconEmulator(config, lambda ns: {"car": planar_pose(1e-9 * (ns - began_ns), 0.0, 0.0)})
        try:
            for _ in range(5):
                (seen,) = decode_block(receiver.recv(2048)).objects
                now_s = 1e-9 * (time.monotonic_ns() - began_ns)
                assert seen.translation_mm[0] / 1000.0 <= now_s - 0.2
        finally:
            emulator.close()


def test_two_real_senders():
    config = ViconConfig(subjects=("car",), port=0)
    with contextlib.ExitStack() as stack:
        receiver = stack.enter_context(ViconReceiver(config))
        senders = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for sender in senders:
            sender.bind(("127.0.0.1", 0))

        def send(sender, frame, x):
            for datagram in encode_blocks(frame, [object_pose("car", planar_pose(x, 1.0, 0.3))]):
                sender.sendto(datagram, ("127.0.0.1", receiver.port))

        for frame in range(10):
            send(senders[0], frame, 0.01 * frame)
        assert len(receiver.read(0.5)) == 10
        assert receiver.fault(time.monotonic_ns()) == ""
        for frame in range(10, 20):
            send(senders[1], frame + 500, 2.4)
            send(senders[0], frame, 0.01 * frame)
        assert receiver.read(0.5) == []
        names = " and ".join(f"127.0.0.1:{sender.getsockname()[1]}" for sender in senders)
        assert receiver.fault(time.monotonic_ns()) == f"two senders of subject car: {names}"
        assert receiver.counts.disputed == 20


def test_a_fault_ends_by_itself():
    feed = Feed()
    feed(1)
    feed(2, 1.5, B)
    assert feed.tracker.senders.fault("car", feed.mono_ns + 999_000_000)
    assert not feed.tracker.senders.fault("car", feed.mono_ns + 1_001_000_000)
