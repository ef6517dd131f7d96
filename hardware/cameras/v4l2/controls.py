"""Sets exposure, white balance and other controls of a video device, and verifies them by reading them back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hardware.cameras.v4l2 import abi
from hardware.cameras.v4l2.port import VideoPort, request
from hardware.errors import HardwareError, ProtocolError

_POWER_LINE = {0: 0, 50: 1, 60: 2}
_EXPOSURE_UNIT_US = 100.0  # of V4L2_CID_EXPOSURE_ABSOLUTE


@dataclass(frozen=True)
class Controls:
    """Controls to fix; None does not change the device.

    A learned policy and a colour calibration are valid for one exposure and white balance, so fix both.

    Attributes:
        exposure_us: Exposure time [us]; also turns the automatic off, and with it the freedom to lower the frame rate.
        gain: Gain in the device's own units.
        white_balance_k: Colour temperature [K]; also turns the automatic off.
        power_line_hz: Mains frequency against which the device avoids flicker, 0 for off [Hz].
        others: More controls by name (`hardware.cameras.v4l2.abi.CONTROL_IDS`), in the device's own units.
    """

    exposure_us: float | None = None
    gain: int | None = None
    white_balance_k: int | None = None
    power_line_hz: int | None = None
    others: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.exposure_us is not None and not self.exposure_us > 0.0:
            raise ValueError(f"expected an exposure > 0 us, got {self.exposure_us}")
        if self.power_line_hz not in (None, *_POWER_LINE):
            raise ValueError(f"expected a mains frequency of 0, 50 or 60 Hz, got {self.power_line_hz}")
        if unknown := set(self.others) - set(abi.CONTROL_IDS):
            raise ValueError(
                f"unknown controls {', '.join(sorted(unknown))}; known: {', '.join(abi.CONTROL_IDS)}"
            )

    def settings(self) -> dict[str, int]:
        """Values by control, in the order of setting: automatic modes are disabled before their values are set."""
        wanted: dict[str, int] = {}
        if self.power_line_hz is not None:
            wanted["power_line_frequency"] = _POWER_LINE[self.power_line_hz]
        if self.exposure_us is not None:
            wanted["auto_exposure"] = abi.EXPOSURE_MANUAL
            wanted["exposure_absolute"] = max(round(self.exposure_us / _EXPOSURE_UNIT_US), 1)
        if self.gain is not None:
            wanted["gain"] = self.gain
        if self.white_balance_k is not None:
            wanted["auto_white_balance"] = 0
            wanted["white_balance_temperature"] = self.white_balance_k
        return {**wanted, **self.others}


def apply(port: VideoPort, fd: int, path: Path, controls: Controls) -> dict[str, int]:
    """Set controls and return their values read back. Raises `ProtocolError` if they differ from the requested ones."""
    wanted = controls.settings()
    if "auto_exposure" in wanted and query(port, fd, "exposure_auto_priority") is not None:
        # If it exists, this control allows the device to lengthen the frame period in the dark.
        wanted = {"exposure_auto_priority": 0, **wanted}
    return {name: _set(port, fd, path, name, value) for name, value in wanted.items()}


def verify(port: VideoPort, fd: int, path: Path, expected: Mapping[str, int]) -> None:
    """Read controls again, because some devices return to automatic when the stream starts."""
    for name, value in expected.items():
        if (got := read(port, fd, path, name)) != value:
            raise ProtocolError(
                f"{path} changed {name} from {value} to {got} by itself when the stream started; use a value that the device keeps"
            )


def query(port: VideoPort, fd: int, name: str) -> abi.QueryControl | None:
    """Return the range of a control, or None if the device lacks it."""
    found = abi.QueryControl(id=abi.CONTROL_IDS[name])
    try:
        port.ioctl(fd, abi.QUERYCTRL, found)
    except OSError:
        return None
    return None if found.flags & abi.CTRL_FLAG_DISABLED else found


def read(port: VideoPort, fd: int, path: Path, name: str) -> int:
    """Read the current value of a control."""
    control = abi.Control(id=abi.CONTROL_IDS[name])
    request(port, fd, path, abi.G_CTRL, control, f"reading {name}")
    return int(control.value)


def available(port: VideoPort, fd: int, path: Path) -> dict[str, tuple[int, int, int, int]]:
    """Return minimum, maximum, step and current value of every control of a device."""
    ranges = ((name, query(port, fd, name)) for name in abi.CONTROL_IDS)
    return {n: (q.minimum, q.maximum, q.step, read(port, fd, path, n)) for n, q in ranges if q is not None}


def _set(port: VideoPort, fd: int, path: Path, name: str, value: int) -> int:
    limits = query(port, fd, name)
    if limits is None:
        has = ", ".join(n for n in abi.CONTROL_IDS if query(port, fd, n) is not None) or "none"
        raise HardwareError(f"{path} has no control {name}; remove it. The device has {has}")
    if not limits.minimum <= value <= limits.maximum:
        raise HardwareError(
            f"expected {name} of {limits.minimum} to {limits.maximum} for {path}, got {value}"
        )
    control = abi.Control(id=abi.CONTROL_IDS[name], value=value)
    request(port, fd, path, abi.S_CTRL, control, f"setting {name} to {value}")
    got = read(port, fd, path, name)
    if abs(got - value) >= max(limits.step, 1):
        raise ProtocolError(f"expected {path} to set {name} to {value}, got {got}; its step is {limits.step}")
    return got
