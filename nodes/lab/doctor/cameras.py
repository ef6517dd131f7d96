"""Cameras: which are there, and does the one of a launch file deliver what is configured?"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibration.schema import CameraCalibration
from hardware.cameras.v4l2.negotiation import identify, modes
from hardware.cameras.v4l2.port import KernelPort, VideoPort, open_device
from hardware.errors import DeviceBusy, HardwareError, ProtocolError
from nodes.lab.camera_tools import CameraToolError, Trial, try_source
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, Finding, in_child
from nodes.lab.doctor.motor import permission_cure

_NAME = "camera"
_FRAMES, _TRY_S = 12, 8.0
_SLOW, _DARK, _BRIGHT = 0.8, 8.0, 247.0
# A frame that is older than this when it arrives is not published by the camera node.
_OLD_MS = 200.0
_OAK_S = 20.0


def video_devices(port: VideoPort | None = None) -> list[Finding]:
    """Every video device of Linux with its formats."""
    port = port or KernelPort()
    rows = [row for name in port.names() if (row := _device(port, Path(name))) is not None]
    return rows or [Finding(_NAME, ABSENT, "no video device", "its USB cable; advnerf camera list")]


def _device(port: VideoPort, path: Path) -> Finding | None:
    try:
        fd = open_device(port, path)
    except DeviceBusy as error:
        return Finding(_NAME, WARNING, str(error))
    except HardwareError as error:
        denied = path.exists() and not os.access(path, os.R_OK | os.W_OK)
        return Finding(_NAME, WARNING, str(error), permission_cure("video") if denied else "")
    try:
        identity = identify(port, fd, path)
        return Finding(_NAME, OK, f"{path}: {identity.card} ({identity.driver}), {'; '.join(modes(port, fd))}")
    except ProtocolError:
        return None  # the second device of a webcam, a decoder: no camera
    except HardwareError as error:
        return Finding(_NAME, WARNING, str(error), "another USB port, without a hub")
    finally:
        port.close(fd)


def oaks(required: bool = False, timeout_s: float = _OAK_S) -> list[Finding]:
    """OAK cameras; asked in a process of its own, which may hang."""
    answer = in_child("oaks", timeout_s=timeout_s)
    bad = FAILURE if required else WARNING
    if answer.data is None:
        if "ModuleNotFoundError" in answer.trouble:
            return [Finding("OAK", FAILURE if required else ABSENT, "depthai is missing", "pip install 'advnerf[oak]'")]
        return [
            Finding(
                "OAK", bad, f"depthai: {answer.trouble}", "unplug it and plug it in again; udev rule of docs/cameras.md"
            )
        ]
    if not answer.data:
        do = "USB 3 cable, enough power, udev rule of docs/cameras.md"
        return [Finding("OAK", FAILURE if required else ABSENT, "none found", do)]
    return [Finding("OAK", OK, str(line)) for line in answer.data]


def source(config: Any, calibration: CameraCalibration | None = None, timeout_s: float = _TRY_S) -> list[Finding]:
    """Take a few frames of a launch file's source, as the camera node would, and compare them with what is configured.

    Args:
        config: One of `hardware.cameras.sources`.
        calibration: What the pictures must fit; None if it cannot be read.
        timeout_s: How long to wait for the frames [s].
    """
    try:
        trial = try_source(config, _FRAMES, timeout_s)
    except (HardwareError, CameraToolError) as error:
        do = (
            "stop the launch or program that uses it"
            if "in use" in str(error)
            else "advnerf camera list, docs/cameras.md"
        )
        return [Finding(_NAME, FAILURE, str(error), do)]
    return [*_measured(config, trial, calibration), *_stable(getattr(config, "device", None))]


def _measured(config: Any, trial: Trial, calibration: CameraCalibration | None) -> Sequence[Finding]:
    height, width = trial.picture.shape[:2]
    text = f"{config.kind}: {width} x {height}, {trial.rate_hz:.1f} Hz, age {trial.age_ms[0]:.0f} ms, brightness {trial.brightness:.0f} of 255"
    rows = []
    if calibration is not None and (calibration.width, calibration.height) != (width, height):
        do = "the size of the source, or a calibration at that size: the camera node refuses these pictures"
        rows.append(Finding(_NAME, FAILURE, f"calibrated for {calibration.width} x {calibration.height}", do))
    if (period_s := config.period_s()) and trial.rate_hz < _SLOW / period_s:
        do = "light (long exposures slow it down), another USB port, another format"
        rows.append(Finding(_NAME, WARNING, f"expected {1.0 / period_s:.1f} Hz", do))
    if trial.age_ms[0] > _OLD_MS:
        do = "the camera node drops such frames: lower size or rate, other programs off"
        rows.append(Finding(_NAME, FAILURE, f"frames are {trial.age_ms[0]:.0f} ms old", do))
    if not _DARK < trial.brightness < _BRIGHT:
        rows.append(Finding(_NAME, WARNING, "the picture is black or white", "lens cap, light, exposure"))
    return [Finding(_NAME, OK, text), *rows]


def _stable(device: Any) -> Sequence[Finding]:
    path = str(device or "")
    if not path.startswith("/dev/video"):
        return []
    do = "take its name in /dev/v4l/by-id or by-path: numbers change when it is plugged in again"
    return [Finding(_NAME, WARNING, f"{path} is no stable name", do)]
