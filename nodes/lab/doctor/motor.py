"""Checks of serial ports and the motor controller: permissions, firmware, telemetry, and its own time-out."""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkTimeout, ProtocolError
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_settings import TimeoutSettings
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, report

# The VESC's USB port is ST's virtual COM port.
VESC_USB = (0x0483, 0x5740)
FIXED_NAME = Path("/dev/vesc")
BY_ID = Path("/dev/serial/by-id")
# The values of docs/wiring.md. A launch file may require others.
WANTED = TimeoutSettings(250, 20.0)
BATTERY_WARNING_V = 13.2
_SERIAL_GROUP = "dialout"


def ports() -> list[Any]:
    """Serial ports of USB devices."""
    from serial.tools import list_ports

    # Ports without hardware have no vendor id. Every mainboard has several of them.
    return [port for port in list_ports.comports() if port.vid is not None]


def serial_ports() -> list[CheckResult]:
    """Check USB serial devices: stable names and permissions."""
    found = ports()
    if not found:
        do = "check the USB cable of the VESC; the twin does not need one"
        return report("serial", ABSENT, "no USB serial device", do)
    rows = [_port(port) for port in found]
    if manager := _running("ModemManager"):
        do = 'ENV{ID_MM_DEVICE_IGNORE}="1" in the udev rule (docs/wiring.md), or: sudo apt-get purge modemmanager'
        rows += report(
            "serial", WARNING, f"ModemManager is running (process {manager}) and writes to serial devices", do
        )
    return rows


def _port(port: Any) -> CheckResult:
    names = stable_names(Path(port.device))
    text = f"{port.device} ({port.description})" + (f", {', '.join(map(str, names))}" if names else "")
    if not os.access(port.device, os.R_OK | os.W_OK):
        return CheckResult("serial", WARNING, f"no permission for {text}", permission_cure(_SERIAL_GROUP))
    if (port.vid, port.pid) == VESC_USB and FIXED_NAME not in names:
        do = f"install the udev rule of docs/wiring.md, so that {FIXED_NAME} is always the VESC"
        return CheckResult("serial", WARNING, text, do)
    return CheckResult("serial", OK, text)


def stable_names(device: Path, folders: Iterable[Path] = (BY_ID,), fixed: Path = FIXED_NAME) -> list[Path]:
    """Names of a device that survive replugging."""
    candidates = [
        fixed,
        *(link for folder in folders if folder.is_dir() for link in sorted(folder.iterdir())),
    ]
    return [link for link in candidates if link.is_symlink() and link.resolve() == device.resolve()]


def permission_cure(group: str) -> str:
    """Advice for a device of a group that cannot be opened."""
    try:
        entry = grp.getgrnam(group)
    except KeyError:
        return f"this system has no group {group}; ls -l shows who may open the device"
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # for the user of a container
        return f"start the container with --group-add {entry.gr_gid}, or give user {os.getuid()} a name and the group {group}"
    if entry.gr_gid in os.getgroups():
        return f"you are in the group {group}: ls -l shows who may open it; its udev rule sets GROUP and MODE"
    if user in entry.gr_mem:
        return f"you are in the group {group}, but only since your last login: log out and in again"
    return f"sudo usermod -aG {group} {user}, then log out and in again"


def find_vesc() -> str | None:
    """Port of the device that looks like a VESC; None without one."""
    if FIXED_NAME.exists():
        return str(FIXED_NAME)
    return next((str(port.device) for port in ports() if (port.vid, port.pid) == VESC_USB), None)


def vesc(
    port: str | None,
    wanted: TimeoutSettings = WANTED,
    battery_v: float = BATTERY_WARNING_V,
    required: bool = False,
) -> list[CheckResult]:
    """Check a motor controller: firmware, telemetry, faults, battery and its own time-out. No motor command is sent.

    Args:
        port: Serial device; None detects a VESC.
        wanted: Longest accepted time-out and smallest accepted brake current.
        battery_v: Supply voltage below which there is a warning [V].
        required: Whether its absence is a failure.
    """
    port = port or find_vesc()
    if port is None:
        do = "check its USB cable; see docs/wiring.md"
        return report("VESC", FAILURE if required else ABSENT, "none found", do)
    device = Vesc(port, VehicleGains(), DriveLimits())
    try:
        device.open()
    except DeviceBusy as error:
        return report("VESC", WARNING, str(error), "stop the launch, or close VESC Tool")
    except DeviceNotFound as error:
        denied = os.path.exists(port) and not os.access(port, os.R_OK | os.W_OK)
        do = (
            permission_cure(_SERIAL_GROUP) if denied else "check its USB cable and udev rule (docs/wiring.md)"
        )
        return report("VESC", FAILURE, str(error), do)
    try:
        return _ask(device, wanted, battery_v)
    except LinkTimeout as error:
        do = "connect the motor battery, check the port, and disconnect VESC Tool"
        return report("VESC", FAILURE, str(error), do)
    except HardwareError as error:
        do = "run advnerf car motor info, then check cable and firmware"
        return report("VESC", FAILURE, str(error), do)
    finally:
        device.abandon()


def _ask(device: Vesc, wanted: TimeoutSettings, battery_v: float) -> list[CheckResult]:
    firmware, values = device.identify(), device.read_values(0.5)
    rows = report("VESC", OK, f"{firmware} at {device.port}, telemetry {values.generation}")
    if values.fault:
        rows += report("VESC", WARNING, f"reports a fault: {values.fault_name}", "see docs/faults.md")
    rows.append(_time_out(device, wanted))
    low = values.v_in < battery_v
    do = "charge or connect the motor battery" if low else ""
    return rows + report("battery", WARNING if low else OK, f"{values.v_in:.1f} V at the VESC", do)


def _time_out(device: Vesc, wanted: TimeoutSettings) -> CheckResult:
    name = "VESC time-out"
    try:
        found = device.read_timeout()
    except (LinkTimeout, ProtocolError) as error:
        do = "check it in VESC Tool"
        return CheckResult(name, WARNING, f"this firmware does not report it: {error}", do)
    if found.at_least(wanted):
        return CheckResult(name, OK, f"{found}; required is at most {wanted}")
    do = (
        f"advnerf car motor set-timeout --vesc {device.port} --timeout-ms {wanted.timeout_ms} "
        f"--brake-current {wanted.brake_current_a:g}"
    )
    return CheckResult(
        name,
        FAILURE,
        f"{found}; required is at most {wanted}: the car would keep rolling if its computer failed",
        do,
    )


def _running(name: str) -> int | None:
    """Process id of a program, found by its name."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                if (folder / "comm").read_text().strip() == name:
                    return int(folder.name)
            except OSError:
                continue  # it ended in the meantime
    return None


def gamepads(required: bool) -> Sequence[CheckResult]:
    """Check which gamepads the teleop node can read."""
    found = sorted(Path("/dev/input/by-id").glob("*-event-joystick")) or sorted(
        Path("/dev/input").glob("js*")
    )
    if not found:
        do = "use advnerf car teleop with the keyboard, or plug in a gamepad (docs/driving.md)"
        return report("gamepad", WARNING if required else ABSENT, "none", do)
    denied = [str(path) for path in found if not os.access(path, os.R_OK)]
    if denied:
        return report("gamepad", WARNING, f"no permission for {', '.join(denied)}", permission_cure("input"))
    return report("gamepad", OK, ", ".join(map(str, found)))
