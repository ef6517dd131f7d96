"""Emulated devices with faults on request: a noisy serial line, a jammed car, hidden or displaced subjects, a camera that hangs."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from advnerf_core.geometry import Array, VehicleState
from hardware.cameras.interface import Frame
from hardware.emulators.frame_server import FrameServer
from hardware.emulators.live import LiveLab, LiveLabConfig
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.emulators.vicon_emulator import ViconEmulator, ViconEmulatorConfig, ViconFrames
from hardware.mocap.vicon_codec import ObjectPose
from hardware.motor.vesc_codec import FrameDecoder
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.furniture import obstacles
from hardware.worlds.lab.vehicle import TwinVehicle

JAMS = ("locked", "spinning")
WIRE_FAULTS = ("dribble", "noise", "garbage", "bad_crc", "silent")
CAMERA_FAULTS = ("silent", "repeated")
OCCLUSION_FORMS = ("missing", "zeros", "nan", "frozen")
# A frame's last byte but one: half of its CRC.
_CRC_OFFSET = -2
_NOWHERE_ELSE = np.eye(4)


def _require_one_of(fault: str | None, known: Collection[str], what: str) -> None:
    if fault is not None and fault not in known:
        raise ValueError(f"expected {what} of {', '.join(known)}, got {fault!r}")


class JammableVehicle(TwinVehicle):
    """A car that can be held in place."""

    _jam: str | None = None

    def jam(self, how: str | None) -> None:
        """Hold the car in place, with its wheels ``locked`` or ``spinning`` on the spot; None releases it."""
        _require_one_of(how, JAMS, "a jam")
        self._jam = how

    def _substep(self, dt_s: float) -> None:
        if self._jam is None:
            super()._substep(dt_s)
            return
        kept, speed = (self._x, self._y, self._yaw, self.odometer_m), self._next_speed(dt_s)
        super()._substep(dt_s)
        self._x, self._y, self._yaw, self.odometer_m = kept
        self._speed, self.blocked = speed if self._jam == "spinning" else 0.0, True


class FaultyVescEmulator(VescEmulator):
    """A controller whose line, firmware and car have faults on request."""

    vehicle: JammableVehicle

    def __init__(
        self,
        config: VescEmulatorConfig,
        vehicle: JammableVehicle | None = None,
        link: Path | None = None,
        log: Path | None = None,
    ) -> None:
        self._pending_jam: tuple[str | None, int] | None = None
        self._fault: str | None = None
        self._rng = random.Random(0)  # repeatable noise on the wire
        super().__init__(config, vehicle or JammableVehicle(LabConfig().car), link, log)

    def jam(self, how: str | None) -> None:
        """Jam the car from now on; None releases it.

        A delayed step up to an earlier time is made without the jam: the log must not show an effect before its cause.
        """
        _require_one_of(how, JAMS, "a jam")
        with self._lock:
            self._pending_jam = how, time.monotonic_ns()

    def disturb(self, fault: str | None) -> None:
        """Let replies reach the computer with a fault of `WIRE_FAULTS`; None repairs the wire."""
        _require_one_of(fault, WIRE_FAULTS, "a fault")
        with self._lock:
            self._fault = fault

    def report_fault(self, code: int) -> None:
        """Make the controller report a fault and ignore commands to move; 0 ends it."""
        with self._lock:
            self.firmware.fault = code
            if code:
                self.vehicle.command(current_a=0.0)

    def advance(self, dt_s: float, mono_ns: int) -> VehicleState:
        with self._lock:
            if self._pending_jam is not None and mono_ns >= self._pending_jam[1]:
                self.vehicle.jam(self._pending_jam[0])
                self._pending_jam = None
            return super().advance(dt_s, mono_ns)

    def _reply(self, data: bytes) -> None:
        with self._lock:
            chunks = wire_chunks(data, self._fault, self._rng)
        for chunk in chunks:
            super()._reply(chunk)


def wire_chunks(reply: bytes, fault: str | None, rng: random.Random) -> list[bytes]:
    """Pieces in which a reply of whole frames reaches the computer.

    Args:
        reply: One or more frames.
        fault: ``dribble``: byte by byte; ``noise``: random bytes between intact frames; ``garbage``: random bytes instead of
            them, many of them start and end bytes; ``bad_crc``: every frame with a wrong sum; ``silent``: nothing; None: unchanged.
        rng: Source of random bytes.
    """
    if fault is None or not reply:
        return [reply] if reply else []
    if fault == "dribble":
        return [reply[i : i + 1] for i in range(len(reply))]
    if fault == "noise":
        return [_noise(rng), reply, _noise(rng)]
    if fault == "garbage":
        return [_noise(rng, len(reply))]
    if fault == "bad_crc":
        return [_damaged(reply)]
    return []


def _noise(rng: random.Random, length: int | None = None) -> bytes:
    length = rng.randint(1, 40) if length is None else length
    return bytes(rng.choice((2, 3, rng.randrange(256))) for _ in range(length))


def _damaged(reply: bytes) -> bytes:
    damaged = bytearray(reply)
    end = 0
    for payload in FrameDecoder().feed(reply):
        end += len(payload) + (5 if len(payload) <= 255 else 6)
        damaged[end + _CRC_OFFSET] ^= 0xFF
    return bytes(damaged)


class FaultyViconFrames(ViconFrames):
    """Frames in which subjects are hidden or displaced on request."""

    def __init__(self, config: ViconEmulatorConfig) -> None:
        super().__init__(config)
        self._occluded: dict[str, str] = {}
        self._displaced: dict[str, Array] = {}
        self._last: dict[str, ObjectPose] = {}

    def occlude(self, name: str, form: str | None) -> None:
        """Hide a subject in one of `OCCLUSION_FORMS`, or show it again with None."""
        _require_one_of(form, OCCLUSION_FORMS, "a form of occlusion")
        if form is None:
            self._occluded.pop(name, None)
        else:
            self._occluded[name] = form

    def displace(self, name: str, T_there_from_true: Array | None) -> None:
        """Report a subject displaced by a transform ``[4, 4]`` in the world; None reports the truth again."""
        if T_there_from_true is None:
            self._displaced.pop(name, None)
        else:
            self._displaced[name] = np.array(T_there_from_true, dtype=np.float64)

    def next(self, T_world_from_subject: Mapping[str, Array]) -> list[bytes]:
        shown = {name: T for name, T in T_world_from_subject.items() if self._occluded.get(name) != "missing"}
        return super().next(shown)

    def _measured(self, name: str, T: Array) -> ObjectPose:
        form = self._occluded.get(name)
        if form == "zeros":
            found = ObjectPose(name, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        elif form == "nan":
            found = ObjectPose(name, (math.nan,) * 3, (math.nan,) * 3)
        elif form == "frozen" and name in self._last:
            found = self._last[name]
        else:
            found = super()._measured(name, self._displaced.get(name, _NOWHERE_ELSE) @ T)
        self._last[name] = found
        return found


class FaultyViconEmulator(ViconEmulator):
    """Motion capture that hides or displaces subjects on request."""

    _frames: FaultyViconFrames

    def __init__(self, config: ViconEmulatorConfig, poses: Callable[[int], Mapping[str, Array]]) -> None:
        with patch("hardware.emulators.vicon_emulator.ViconFrames", FaultyViconFrames):
            super().__init__(config, poses)

    def occlude(self, name: str, form: str | None) -> None:
        """See `FaultyViconFrames.occlude`."""
        self._frames.occlude(name, form)

    def displace(self, name: str, T_there_from_true: Array | None) -> None:
        """See `FaultyViconFrames.displace`."""
        self._frames.displace(name, T_there_from_true)


class FaultyFrameServer(FrameServer):
    """A camera that gives nothing, or again and again its last frame.

    Attributes:
        fault: One of `CAMERA_FAULTS`; None for a camera in order.
    """

    fault: str | None = None
    _good: Frame | None = None

    def publish(self, frame: Frame) -> None:
        if self.fault is None:
            self._good = frame
            super().publish(frame)
        elif self.fault == "repeated" and self._good is not None:
            super().publish(replace(self._good))  # a new object: the server distinguishes frames by identity


class FaultyLab(LiveLab):
    """The live lab, made of devices with faults."""

    vesc: FaultyVescEmulator
    vicon: FaultyViconEmulator
    _frames: FaultyFrameServer

    def __init__(self, config: LiveLabConfig, run_dir: Path, socket_dir: Path | None = None) -> None:
        with patch.multiple(
            "hardware.emulators.live",
            FrameServer=FaultyFrameServer,
            VescEmulator=FaultyVescEmulator,
            ViconEmulator=FaultyViconEmulator,
            vehicle_in_room=_jammable_in_room,
        ):
            super().__init__(config, run_dir, socket_dir)

    def freeze_camera(self, fault: str | None) -> None:
        """Make the camera ``silent``, or make it repeat its last frame with its old stamp (``repeated``); None ends the fault."""
        _require_one_of(fault, CAMERA_FAULTS, "a fault")
        self._frames.fault = fault


def _jammable_in_room(config: LabConfig) -> JammableVehicle:
    return JammableVehicle(config.car, obstacles(config), 0.5 * config.room.side_m, config.start_pose)
