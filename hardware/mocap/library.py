"""Motion capture through the library ``motioncapture``, one backend for Vicon's DataStream, OptiTrack, Qualisys and others.

The library is optional (``pip install 'advnerf[mocap]'``; Linux on x86 only) and is imported when it is used. It leaves subjects
out that it does not see; other forms of "lost" (zeros, not a number, the same bits again and again) are detected as for
Tracker's own stream. Its wait for a frame has no time-out when the host falls silent, so it runs in a separate thread.
"""

from __future__ import annotations

import contextlib
import importlib
import queue
import socket
import threading
import time
from dataclasses import dataclass
from typing import Any

from advnerf_core.geometry import make_transform, rotation_from_quaternion
from hardware.errors import DeviceNotFound, HardwareError
from hardware.mocap.vicon import SubjectPose, SubjectTracker, ViconConfig, ViconCounts

# Ports of the systems, so that a missing host is an error at once: the library would wait for ever.
_TCP_PORTS = {"vicon": 801, "qualisys": 22223}
SYSTEMS = ("vicon", "optitrack", "qualisys", "nokov", "vrpn", "fzmotion", "mock")
_PROBE_S = 2.0
_WAITING_FRAMES = 50


@dataclass(frozen=True)
class LibraryConfig:
    """Configuration of the receiver.

    Attributes:
        system: One of `SYSTEMS`.
        hostname: Host name of the system.
        subjects: Names to report; others are ignored.
        latency_s: From exposure to receipt, as measured in calibration [s].
        frozen_frames: Number of bit-identical frames after which a subject counts as lost.
    """

    system: str
    hostname: str
    subjects: tuple[str, ...]
    latency_s: float = 0.0
    frozen_frames: int = 5

    def __post_init__(self) -> None:
        if self.system not in SYSTEMS:
            raise ValueError(f"expected a motion capture system of {', '.join(SYSTEMS)}, got {self.system!r}")


class LibraryReceiver:
    """Receiver with the interface of `hardware.mocap.vicon.ViconReceiver`: `read`, `counts`, `fault`, `close`."""

    def __init__(self, config: LibraryConfig) -> None:
        self.config = config
        tracked = ViconConfig(config.subjects, latency_s=config.latency_s, frozen_frames=config.frozen_frames)
        self._tracker = SubjectTracker(tracked)
        self._connection = _connect(config)
        self._frames: queue.Queue[list[SubjectPose]] = queue.Queue(_WAITING_FRAMES)
        self._failure: Exception | None = None
        self._stop = threading.Event()
        # A daemon: a wait inside the library cannot be ended, only abandoned.
        self._thread = threading.Thread(target=self._run, name="motioncapture", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> ViconCounts:
        """Counts of frames and poses."""
        return self._tracker.counts

    @property
    def source(self) -> str:
        """Description of the source of poses."""
        return f"{self.config.system} at {self.config.hostname}"

    @property
    def silence(self) -> str:
        """What is missing while there are no frames."""
        return f"no datagrams on {self.source}"

    def fault(self, mono_ns: int) -> str:
        """Always empty, because the library receives from one system and numbers its frames."""
        del mono_ns
        return ""

    def read(self, timeout_s: float) -> list[SubjectPose]:
        """Return the reliable poses of the received frames, oldest first; empty on timeout."""
        poses: list[SubjectPose] = []
        with contextlib.suppress(queue.Empty):
            poses += self._frames.get(timeout=timeout_s)
            while True:
                poses += self._frames.get_nowait()
        if self._failure is not None and not poses:
            raise HardwareError(
                f"lost the motion capture system {self.source}: {self._failure}"
            ) from self._failure
        return poses

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join(timeout=0.2)

    def __enter__(self) -> LibraryReceiver:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _run(self) -> None:
        number = 0
        try:
            while not self._stop.is_set():
                self._connection.waitForNextFrame()
                self._take(number, time.time_ns(), time.monotonic_ns())
                number += 1
        except Exception as error:  # of a foreign library: the reader gets it
            self._failure = error

    def _take(self, number: int, real_ns: int, mono_ns: int) -> None:
        self.counts.datagrams += 1
        stamp_ns = real_ns - round(self.config.latency_s * 1e9)
        poses = []
        for name, body in dict(self._connection.rigidBodies).items():
            q = body.rotation
            position, rotation = (
                tuple(map(float, body.position)),
                (float(q.x), float(q.y), float(q.z), float(q.w)),
            )
            if self._tracker.is_real(number, name, (*position, *rotation)) and any(rotation):
                T = make_transform(rotation_from_quaternion(rotation), position)
                poses.append(SubjectPose(name, T, number, stamp_ns, mono_ns))
        if self._frames.full():
            with contextlib.suppress(queue.Empty):
                self._frames.get_nowait()
            self.counts.missed_frames += 1
        self._frames.put(poses)


def _connect(config: LibraryConfig) -> Any:
    try:
        library = importlib.import_module("motioncapture")
    except ImportError as error:
        raise DeviceNotFound(
            f"expected the Python package motioncapture for {config.system}, but it cannot be imported ({error}): pip install"
            " 'advnerf[mocap]' (Linux on x86), or use Tracker's UDP object stream, which needs no package"
        ) from error
    port = _TCP_PORTS.get(config.system)
    try:
        if port is not None:
            socket.create_connection((config.hostname, port), _PROBE_S).close()
        return library.connect(config.system, {"hostname": config.hostname})
    except Exception as error:  # of the system, or of a foreign library
        raise DeviceNotFound(
            f"expected a {config.system} system at {config.hostname}{f':{port}' if port else ''}, got: {error}; is it running,"
            " and is this computer in its network?"
        ) from error
