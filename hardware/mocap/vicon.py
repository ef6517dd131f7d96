"""Receives Vicon Tracker's object stream and returns reliable poses.

The stream has no time stamp and no documented sign of occlusion. Poses are therefore stamped on receipt (by the kernel where it
can) and taken as lost in every form seen in the field: object missing, exact zeros, not a number, or the same bits over and over,
which a real, noisy measurement never gives. A subject that two senders measure, or whose frame numbers go back and forth, is a
fault: its poses are withheld until only one of them is heard.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from advnerf_core.geometry import Array
from hardware.errors import DeviceBusy, ProtocolError
from hardware.mocap.vicon_codec import decode_block
from hardware.mocap.vicon_senders import Address, SenderWatch

DEFAULT_PORT = 51001
_SO_TIMESTAMPNS = 35  # Linux: real time of arrival as ancillary data; Python has no name for it
_TIMESPEC = struct.Struct("@qq")
_RECEIVE_BYTES = 4096
_MOST_DATAGRAMS = 200  # per read: a flood must not keep the reader in there
# Frames that arrive this much late are reordered datagrams; anything further back is a restarted Tracker.
_REORDER_WINDOW_FRAMES = 50
_RESTART_SILENCE_S = 0.1
# Number of senders that are distinguished, because other programs may also send to the port.
_MOST_STREAMS = 16
_NO_SENDER: Address = ("", 0)
_NUMBERS = struct.Struct("<6d")


@dataclass(frozen=True)
class SubjectPose:
    """One reliable measurement.

    Attributes:
        name: Subject.
        T_world_from_subject: Pose ``[4, 4]`` [m].
        frame_number: Tracker's frame.
        stamp_real_ns: Time of the measurement, in real time: receipt less the configured latency [ns].
        receive_mono_ns: Time of receipt, in monotonic time [ns].
    """

    name: str
    T_world_from_subject: Array
    frame_number: int
    stamp_real_ns: int
    receive_mono_ns: int


def free_udp_port() -> int:
    """A UDP port that nobody uses, for a simulated Tracker of one's own: a lab or another run on this computer does not send to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True)
class ViconConfig:
    """Configuration of the receiver.

    Attributes:
        subjects: Names to report; others are ignored.
        host: Local address to bind; empty for all.
        port: UDP port of the object stream; 0 lets the system choose (tests).
        latency_s: Time from exposure to receipt, measured in calibration [s].
        frozen_frames: Number of bit-identical frames after which a subject counts as lost.
        source: Accept datagrams of this address only; None accepts all.
    """

    subjects: tuple[str, ...]
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    latency_s: float = 0.0
    frozen_frames: int = 5
    source: str | None = None


@dataclass
class ViconCounts:
    """Counts of datagrams and poses. ``elsewhere`` are datagrams from other addresses than the configured one, the last of them `stranger`."""

    datagrams: int = 0
    elsewhere: int = 0
    stranger: str = ""
    refused: int = 0
    late: int = 0
    missed_frames: int = 0
    restarts: int = 0
    disputed: int = 0
    lost: dict[str, int] = field(default_factory=dict)


@dataclass
class _Subject:
    frame_number: int = -1
    bits: tuple[float, ...] = ()
    repeats: int = 0


@dataclass
class _Stream:
    frame_number: int
    mono_ns: int


class SubjectTracker:
    """Selects measurements that are new, real, and from one system. Pure: time comes as an argument."""

    def __init__(self, config: ViconConfig) -> None:
        self.config = config
        self.counts = ViconCounts(lost=dict.fromkeys(config.subjects, 0))
        self.senders = SenderWatch(config.subjects)
        self._subjects = {name: _Subject() for name in config.subjects}
        self._streams: dict[Address, _Stream] = {}

    def update(
        self, datagram: bytes, stamp_real_ns: int, mono_ns: int, sender: Address = _NO_SENDER
    ) -> list[SubjectPose]:
        """Return the poses of a datagram that are fresh, not lost, and of subjects that only this sender measures."""
        self.counts.datagrams += 1
        try:
            block = decode_block(datagram)
        except ProtocolError:
            self.counts.refused += 1
            return []
        new = self._accept_frame(block.frame_number, mono_ns, sender)
        for item in block.objects:
            numbers = _NUMBERS.pack(*item.translation_mm, *item.rotation_rad)
            self.senders.measured(item.name, sender, block.frame_number, numbers, mono_ns)
        if not new:
            self.counts.late += 1
            return []
        stamp = stamp_real_ns - round(self.config.latency_s * 1e9)
        seen = [
            item
            for item in block.objects
            if self.is_real(block.frame_number, item.name, (*item.translation_mm, *item.rotation_rad))
        ]
        trusted = [item for item in seen if not self.senders.fault(item.name, mono_ns)]
        self.counts.disputed += len(seen) - len(trusted)
        return [
            SubjectPose(item.name, item.T_world_from_subject, block.frame_number, stamp, mono_ns)
            for item in trusted
        ]

    def _accept_frame(self, frame_number: int, mono_ns: int, sender: Address) -> bool:
        # The oldest go first: an active sender moves to the end.
        stream = self._streams.pop(sender, None) or _Stream(frame_number, mono_ns)
        self._streams[sender] = stream
        while len(self._streams) > _MOST_STREAMS:
            del self._streams[next(iter(self._streams))]
        last, silence_s = stream.frame_number, (mono_ns - stream.mono_ns) / 1e9
        step = (frame_number - last + 2**31) % 2**32 - 2**31  # over the wrap of u32
        if -_REORDER_WINDOW_FRAMES <= step < 0 and silence_s < _RESTART_SILENCE_S:
            return False
        if step < 0 or step > 10 * _REORDER_WINDOW_FRAMES:
            self.counts.restarts += 1
            self._subjects = {name: _Subject() for name in self._subjects}
            self.senders.leapt(sender, last, frame_number, silence_s, mono_ns)
        else:
            self.counts.missed_frames += max(0, step - 1)
        stream.frame_number, stream.mono_ns = frame_number, mono_ns
        return True

    def is_real(self, frame_number: int, name: str, numbers: tuple[float, ...]) -> bool:
        """Whether a measurement of a subject is new and not occluded. ``numbers`` is the translation, then the rotation."""
        subject = self._subjects.get(name)
        if subject is None or subject.frame_number == frame_number:
            return False  # not asked for, or the same frame twice
        subject.frame_number = frame_number
        subject.repeats = subject.repeats + 1 if numbers == subject.bits else 0
        subject.bits = numbers
        finite = all(map(math.isfinite, numbers))
        real = finite and any(numbers[:3]) and subject.repeats < self.config.frozen_frames
        self.counts.lost[name] += not real
        return real


class ViconReceiver:
    """Receives the stream on a socket. Its owner reads it in a separate thread, so that other work does not delay poses."""

    def __init__(self, config: ViconConfig) -> None:
        self.config = config
        self._tracker = SubjectTracker(config)
        self._socket = _open_socket(config)

    @property
    def port(self) -> int:
        """UDP port on which the receiver listens."""
        return int(self._socket.getsockname()[1])

    @property
    def counts(self) -> ViconCounts:
        """Counts of datagrams and poses."""
        return self._tracker.counts

    @property
    def silence(self) -> str:
        """What is missing while there are no datagrams."""
        wanted = f"no datagrams on UDP port {self.port}"
        if not self.counts.elsewhere:
            return wanted
        return f"{wanted} from {self.config.source}, but {self.counts.elsewhere} from {self.counts.stranger}; correct source"

    def fault(self, mono_ns: int) -> str:
        """Describe which subjects are currently unreliable, and why; empty if none. Any thread."""
        return self._tracker.senders.faults(mono_ns)

    def read(self, timeout_s: float) -> list[SubjectPose]:
        """Return the reliable poses of all received datagrams, oldest first; empty on timeout."""
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return []
        poses: list[SubjectPose] = []
        for _ in range(_MOST_DATAGRAMS):
            try:
                data, ancillary, _, address = self._socket.recvmsg(_RECEIVE_BYTES, 64)
            except BlockingIOError:
                break
            if self.config.source in (None, address[0]):
                poses += self._tracker.update(data, *_arrival(ancillary), address)
            else:
                self.counts.elsewhere += 1
                self.counts.stranger = address[0]
        return poses

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def __enter__(self) -> ViconReceiver:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _open_socket(config: ViconConfig) -> socket.socket:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setblocking(False)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    with contextlib.suppress(OSError):  # not Linux: stamps are taken after the thread woke up
        receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    try:
        receiver.bind((config.host, config.port))
    except OSError as error:
        receiver.close()
        raise DeviceBusy(
            f"expected UDP {config.host or '*'}:{config.port} to be free for the VICON stream, got: {error.strerror};"
            " stop the other receiver or set another port here and in Tracker"
        ) from error
    return receiver


def _arrival(ancillary: Iterable[tuple[int, int, bytes]]) -> tuple[int, int]:
    """Real and monotonic time of arrival [ns]."""
    real_ns, mono_ns = time.time_ns(), time.monotonic_ns()
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            kernel_ns = seconds * 1_000_000_000 + nanoseconds
            return kernel_ns, mono_ns - max(0, real_ns - kernel_ns)
    return real_ns, mono_ns
