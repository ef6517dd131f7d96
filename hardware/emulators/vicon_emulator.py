"""Motion capture of the twin: sends Vicon Tracker's object stream for poses from a function.

It adds the noise of a real measurement, without which a standing object would count as frozen, and the faults of a network.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Mapping

import numpy as np
from pydantic import Field

from advnerf_core.geometry import Array, make_transform, rotation_x, rotation_y, rotation_z
from advnerf_core.strict import StrictModel
from hardware.emulators.pacing import Pacer
from hardware.mocap.vicon_codec import ObjectPose, encode_blocks, object_pose


class ViconEmulatorConfig(StrictModel):
    """The twin's motion capture system.

    Attributes:
        host: Address to send to.
        port: UDP port to send to.
        rate_hz: Frames per second.
        block_bytes: Size of a datagram: 256, 512 or 1024.
        noise_m: Standard deviation of each coordinate [m].
        noise_rad: Standard deviation of each angle [rad].
        latency_s: From the instant of a measurement until it is sent [s].
        seed: Seed of the noise.
        shuffle: Whether objects come in another order in every frame.
        loss: Probability that a datagram is lost on the way.
        duplication: Probability that it comes twice.
        reordering: Probability that it comes only after its successor.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=51001, ge=1, le=65535)
    rate_hz: float = Field(default=100.0, gt=0.0, le=1000.0)
    block_bytes: int = 1024
    noise_m: float = Field(default=1e-4, ge=0.0)
    noise_rad: float = Field(default=3e-4, ge=0.0)
    latency_s: float = Field(default=0.0, ge=0.0, le=0.5)
    seed: int = 0
    shuffle: bool = False
    loss: float = Field(default=0.0, ge=0.0, le=1.0)
    duplication: float = Field(default=0.0, ge=0.0, le=1.0)
    reordering: float = Field(default=0.0, ge=0.0, le=1.0)


class ViconFrames:
    """Makes the datagrams of one frame after the other. Pure, so that faults can be tested without a network."""

    def __init__(self, config: ViconEmulatorConfig) -> None:
        self.config = config
        self.frame_number = 0
        self._rng = np.random.default_rng(config.seed)
        # A separate generator, so that network faults do not change the noise of the measurements.
        self._network = np.random.default_rng([config.seed, 1])
        self._held_back: list[bytes] = []

    def next(self, T_world_from_subject: Mapping[str, Array]) -> list[bytes]:
        """Datagrams of the next frame for true poses ``[4, 4]`` [m]."""
        objects = [self._measured(name, T) for name, T in T_world_from_subject.items()]
        if self.config.shuffle:
            objects = [objects[i] for i in self._network.permutation(len(objects))]
        datagrams = encode_blocks(self.frame_number, objects, self.config.block_bytes)
        self.frame_number = (self.frame_number + 1) % 2**32
        return self._transmit(datagrams)

    def _transmit(self, datagrams: list[bytes]) -> list[bytes]:
        config, late, sent = self.config, self._held_back, []
        self._held_back = []
        for datagram in datagrams:
            lost, twice, held = self._network.random(3) < (config.loss, config.duplication, config.reordering)
            if held and not lost:
                self._held_back.append(datagram)
            elif not lost:
                sent += [datagram] * (1 + int(twice))
        return sent + late

    def _measured(self, name: str, T: Array) -> ObjectPose:
        rx, ry, rz = self._rng.normal(0.0, self.config.noise_rad, 3) if self.config.noise_rad else np.zeros(3)
        noise = make_transform(
            rotation_z(rz) @ rotation_y(ry) @ rotation_x(rx),
            self._rng.normal(0.0, 1.0, 3) * self.config.noise_m,
        )
        noisy = T @ make_transform(noise[:3, :3], np.zeros(3))
        noisy[:3, 3] += noise[:3, 3]
        return object_pose(name, noisy)


class ViconEmulator:
    """Sends frames from a separate thread.

    Args:
        poses: Called from the sending thread for the true poses at a monotonic time [ns].
    """

    def __init__(self, config: ViconEmulatorConfig, poses: Callable[[int], Mapping[str, Array]]) -> None:
        self.config = config
        self._frames = ViconFrames(config)
        self._poses = poses
        self._stop = threading.Event()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._pacer = Pacer(config.rate_hz)
        self._thread = threading.Thread(target=self._run, name="vicon emulator", daemon=True)
        self._thread.start()

    @property
    def missed(self) -> int:
        """Number of skipped frames because the thread was delayed."""
        return self._pacer.missed

    def close(self) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._socket.close()

    def _run(self) -> None:
        latency_ns = round(1e9 * self.config.latency_s)
        while (tick_ns := self._pacer.wait(self._stop)) is not None:
            for datagram in self._frames.next(self._poses(tick_ns - latency_ns)):
                with contextlib.suppress(ConnectionRefusedError):  # there is no receiver yet
                    self._socket.sendto(datagram, (self.config.host, self.config.port))
