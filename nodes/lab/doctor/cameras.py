"""Camera checks: which cameras exist, and whether the one of a launch file delivers the configured frames."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibration.schema import CameraCalibration
from hardware.cameras.v4l2.negotiation import identify, modes
from hardware.cameras.v4l2.port import KernelPort, VideoPort, open_device
from hardware.errors import DeviceBusy, HardwareError, ProtocolError
from nodes.lab.camera_tools import CameraToolError, SourceTrial, try_source
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, in_child, report
from nodes.lab.doctor.motor import permission_cure

_NAME = "camera"
_FRAMES, _TRY_S = 12, 8.0
_SLOW, _DARK, _BRIGHT = 0.8, 8.0, 247.0
# The camera node does not publish frames that are older than this on arrival.
_OLD_MS = 200.0
_OAK_S = 20.0


def video_devices(port: VideoPort | None = None) -> list[CheckResult]:
    """List every video device of Linux with its formats."""
    port = port or KernelPort()
    rows = [row for name in port.names() if (row := _device(port, Path(name))) is not None]
    return rows or report(
        _NAME, ABSENT, "no video device", "check its USB cable, then run advnerf car camera list"
    )


def _device(port: VideoPort, path: Path) -> CheckResult | None:
    try:
        fd = open_device(port, path)
    except DeviceBusy as error:
        return CheckResult(_NAME, WARNING, str(error))
    except HardwareError as error:
        denied = path.exists() and not os.access(path, os.R_OK | os.W_OK)
        return CheckResult(_NAME, WARNING, str(error), permission_cure("video") if denied else "")
    try:
        identity = identify(port, fd, path)
        return CheckResult(
            _NAME, OK, f"{path}: {identity.card} ({identity.driver}), {'; '.join(modes(port, fd))}"
        )
    except ProtocolError:
        return None  # not a camera: the second device of a webcam, or a decoder
    except HardwareError as error:
        return CheckResult(_NAME, WARNING, str(error), "use another USB port, without a hub")
    finally:
        port.close(fd)


def oaks(required: bool = False, timeout_s: float = _OAK_S) -> list[CheckResult]:
    """List OAK cameras, from a separate process, because depthai may hang."""
    answer = in_child("oaks", timeout_s=timeout_s)
    absent = FAILURE if required else ABSENT
    if answer.data is None:
        if "ModuleNotFoundError" in answer.trouble:
            return report("OAK", absent, "depthai is missing", "pip install 'advnerf[oak]'")
        do = "unplug it and plug it in again; install the udev rule of docs/cameras.md"
        return report("OAK", FAILURE if required else WARNING, f"depthai: {answer.trouble}", do)
    if not answer.data:
        do = "check the USB 3 cable, the power supply and the udev rule of docs/cameras.md"
        return report("OAK", absent, "none found", do)
    return [CheckResult("OAK", OK, str(line)) for line in answer.data]


def source(
    config: Any, calibration: CameraCalibration | None = None, timeout_s: float = _TRY_S
) -> list[CheckResult]:
    """Take a few frames of a launch file's source, as the camera node does, and compare them with the configuration.

    Args:
        config: One of `hardware.cameras.sources`.
        calibration: Calibration that the images must fit; None if it cannot be read.
    """
    try:
        trial = try_source(config, _FRAMES, timeout_s)
    except (HardwareError, CameraToolError) as error:
        do = (
            "stop the launch or program that uses it"
            if "in use" in str(error)
            else "run advnerf car camera list; see docs/cameras.md"
        )
        return report(_NAME, FAILURE, str(error), do)
    return [*_measured(config, trial, calibration), *_stable(getattr(config, "device", None))]


def _measured(
    config: Any, trial: SourceTrial, calibration: CameraCalibration | None
) -> Sequence[CheckResult]:
    height, width = trial.picture.shape[:2]
    text = f"{config.kind}: {width} x {height}, {trial.rate_hz:.1f} Hz, age {trial.age_ms[0]:.0f} ms, brightness {trial.brightness:.0f} of 255"
    rows = []
    if calibration is not None and (calibration.width, calibration.height) != (width, height):
        do = "set the size of the source, or calibrate at this size; the camera node refuses these images"
        rows += report(_NAME, FAILURE, f"calibrated for {calibration.width} x {calibration.height}", do)
    if (period_s := config.period_s()) and trial.rate_hz < _SLOW / period_s:
        do = "add light (long exposures reduce the rate), or use another USB port or format"
        rows += report(_NAME, WARNING, f"expected {1.0 / period_s:.1f} Hz", do)
    if trial.age_ms[0] > _OLD_MS:
        do = "reduce size or rate, or close other programs; the camera node drops such frames"
        rows += report(_NAME, FAILURE, f"frames are {trial.age_ms[0]:.0f} ms old", do)
    if not _DARK < trial.brightness < _BRIGHT:
        rows += report(_NAME, WARNING, "the image is black or white", "check lens cap, light and exposure")
    return [CheckResult(_NAME, OK, text), *rows]


def _stable(device: Any) -> Sequence[CheckResult]:
    path = str(device or "")
    if not path.startswith("/dev/video"):
        return []
    do = "use its name in /dev/v4l/by-id or by-path; numbers change when it is plugged in again"
    return report(_NAME, WARNING, f"{path} is not a stable name", do)
