"""What this machine has and what it lacks: each check says what to do about it."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nodes.runtime.errors import BusError, SecurityError
from nodes.runtime.launch import active_launches
from nodes.runtime.paths import user_folder
from nodes.runtime.security import DRIVE, KeyFolder, default_folder

OK, WARNING, FAILURE = "ok", "warning", "failure"
_DISK_WARNING_BYTES, _DISK_FAILURE_BYTES = 5 * 2**30, 2**29
_MEMORY_WARNING_BYTES = 4 * 2**30
# Beyond it the safety node does not arm with two hosts.
_CLOCK_ERROR_S = 0.005
# A broken driver may end the process that tries it, so the attempt has a process of its own.
_RENDER = (
    "import os; os.environ.setdefault('MUJOCO_GL', 'egl'); import mujoco; context = mujoco.GLContext(16, 16); "
    "context.make_current(); print(mujoco.__version__)"
)
_TORCH = "import torch; print(torch.__version__, 'CUDA' if torch.cuda.is_available() else 'CPU only')"


@dataclass(frozen=True)
class Check:
    """Outcome of one check.

    Attributes:
        name: What was looked at.
        state: ``ok``, ``warning`` (something will not work) or ``failure`` (nothing will).
        text: What was found, and what to do.
    """

    name: str
    state: str
    text: str


def examine(folder: Path, vicon_port: int) -> list[Check]:
    """Run all checks.

    Args:
        folder: Where results will be written.
        vicon_port: UDP port of the motion-capture stream.
    """
    checks: list[Callable[[], Check]] = [
        _python, _machine, _render, _torch, lambda: _disk(folder), _sockets, lambda: _udp_port(vicon_port), _serial_ports,
        _keys, _clock, _launches,
    ]  # fmt: skip
    return [check() for check in checks]


def _python() -> Check:
    found = platform.python_version()
    if not (3, 10) <= sys.version_info[:2] <= (3, 12):
        return Check("python", WARNING, f"{found}; tested are 3.10, 3.11 and 3.12")
    return Check("python", OK, f"{found}, advnerf {importlib.metadata.version('advnerf')}")


def _machine() -> Check:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    text = f"{os.cpu_count()} cores, {memory / 2**30:.0f} GiB memory"
    if memory < _MEMORY_WARNING_BYTES:
        return Check("machine", WARNING, f"{text}; training wants {_MEMORY_WARNING_BYTES // 2**30} GiB")
    return Check("machine", OK, text)


def _render() -> Check:
    done, text = _try(_RENDER)
    if done:
        return Check("EGL", OK, f"MuJoCo {text} renders off-screen")
    return Check(
        "EGL", WARNING,
        f"the simulated lab cannot render: {text}. pip install 'advnerf[twin]'; on Debian or Ubuntu: "
        "apt-get install libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0",
    )  # fmt: skip


def _torch() -> Check:
    done, text = _try(_TORCH)
    if done:
        return Check("torch", OK, text)
    return Check("torch", WARNING, f"no training and no policy node: {text}. pip install 'advnerf[core]'")


def _disk(folder: Path) -> Check:
    existing = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.is_dir())
    free = shutil.disk_usage(existing).free
    text = f"{free / 2**30:.1f} GiB free in {existing}"
    if not os.access(existing, os.W_OK):
        return Check("disk", FAILURE, f"{existing} cannot be written to; choose another folder")
    if free < _DISK_FAILURE_BYTES:
        return Check("disk", FAILURE, f"{text}; free some, recording the 336 x 188 camera at 10 Hz takes 14 GB an hour")
    return Check("disk", WARNING if free < _DISK_WARNING_BYTES else OK, text)


def _sockets() -> Check:
    try:
        return Check("sockets", OK, f"in {user_folder()}")
    except (BusError, OSError) as error:
        return Check("sockets", FAILURE, str(error))


def _udp_port(port: int) -> Check:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))
        except OSError as error:
            return Check(
                "VICON port", WARNING, f"UDP {port}: {error.strerror}; stop what uses it, or choose another port"
            )
    return Check("VICON port", OK, f"UDP {port} is free")


def _serial_ports() -> Check:
    from serial.tools import list_ports

    # Ports without hardware behind them have no vendor; every board has a row of those.
    ports = [port for port in list_ports.comports() if port.vid is not None]
    denied = [port.device for port in ports if not os.access(port.device, os.R_OK | os.W_OK)]
    if denied:
        return Check(
            "serial", WARNING, f"no permission for {', '.join(denied)}: add yourself to the group dialout, log in again"
        )
    found = ", ".join(f"{port.device} ({port.description})" for port in ports)
    return Check("serial", OK, found or "no USB serial device; the twin brings its own")


def _keys() -> Check:
    folder = default_folder()
    keys = KeyFolder(folder)
    try:
        rows = keys.rows()
        for row in rows:
            if row.ours:
                keys.secret(row.name)
    except (SecurityError, OSError) as error:
        return Check("keys", WARNING, str(error))
    ours = ", ".join(row.name for row in rows if row.ours)
    drivers = ", ".join(row.name for row in rows if DRIVE in row.rights) or "nobody"
    if not ours:
        return Check("keys", OK, f"none in {folder}; two hosts need them: advnerf keys new NAME")
    return Check("keys", OK, f"ours: {ours}; {drivers} may drive over the network")


def _clock() -> Check:
    """Whether this computer's clock is kept by somebody: ages between hosts are no better than their clocks."""
    seconds = _adjtimex_error_s()
    if seconds is None:
        return Check(
            "clock",
            WARNING,
            "not synchronised, says the kernel; with two hosts install chrony on both: apt-get install chrony",
        )
    if seconds > _CLOCK_ERROR_S:
        return Check("clock", WARNING, f"may be off by {seconds * 1e3:.0f} ms; wait for chrony, see: chronyc tracking")
    return Check("clock", OK, f"synchronised, off by at most {seconds * 1e3:.1f} ms")


def _adjtimex_error_s() -> float | None:
    """Estimated error of the clock [s] from adjtimex(2); None when the kernel calls it unsynchronised."""
    # struct timex of 64-bit Linux: modes, offset, freq, maxerror, esterror, status, ...; 208 bytes in all.
    buffer = ctypes.create_string_buffer(208)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(buffer)
    esterror_us, status = struct.unpack_from("<qi", buffer, 32)
    unsynchronised = 0x0040
    return None if state < 0 or status & unsynchronised else float(esterror_us) / 1e6


def _launches() -> Check:
    launches = active_launches()
    found = ", ".join(f"{launch['name']} in {launch['run_dir']} (process {launch['pid']})" for launch in launches)
    return Check("launches", WARNING if launches else OK, f"running: {found}" if launches else "none running")


def _try(program: str) -> tuple[bool, str]:
    """Whether a small Python program works, with its output or the last line of its error."""
    try:
        result = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return False, "no answer within 60 s"
    lines = (result.stdout if result.returncode == 0 else result.stderr).strip().splitlines()
    return result.returncode == 0, lines[-1] if lines else f"exit code {result.returncode}"
