"""Checks of the computer: versions, memory, disk, sockets, keys, clock, and running launches."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from packaging.requirements import Requirement

from advnerf_core.errors import AdvnerfError
from advnerf_core.kernel_cache import use_own_folder
from advnerf_core.places import PlaceError, is_writable, user_place
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, report
from nodes.launching.running import active_launches
from nodes.linking.keys import DRIVE, KeyFolder, default_folder
from nodes.runtime.bus import Bus
from nodes.runtime.machine import memory_gib
from nodes.runtime.paths import user_folder
from nodes.safety import SafetyConfig

_MEMORY_WARNING_GIB = 4
# Shortest recording that should fit on the disk.
_RECORDING_MINUTES = 30.0
# A smaller clock offset does not matter for the age limits, which are about 0.2 s.
CLOCK_ERROR_S = 0.005
_UNSYNCHRONISED = 0x0040
_CHRONYC_S = 2.0
_OFFSET_WAIT_S = 0.8
_EXTRA = re.compile(r"extra == ['\"]([a-z0-9-]+)['\"]")
_NOT_OURS = ("all", "dev")


def versions() -> list[CheckResult]:
    """Check Python, advnerf, the required packages and the extras."""
    found = platform.python_version()
    tested = (3, 10) <= sys.version_info[:2] <= (3, 12)
    text = f"{found}, advnerf {importlib.metadata.version('advnerf')}, Linux {platform.release()} {platform.machine()}"
    do = "" if tested else "create the environment with Python 3.10, 3.11 or 3.12, which are tested"
    rows = report("python", OK if tested else WARNING, text, do)
    return rows + packages(importlib.metadata.requires("advnerf") or [])


def packages(requirements: Iterable[str]) -> list[CheckResult]:
    """Check a package's requirements: missing, too old or too new packages, and complete extras.

    What a marker asks for on other computers only is not looked for.
    """
    wrong: dict[str, list[str]] = {}
    for each in map(Requirement, requirements):
        extra = _extra(each)
        if extra in _NOT_OURS:
            continue
        found = wrong.setdefault(extra, [])
        if each.marker is None or each.marker.evaluate({"extra": extra}):
            found += _trouble(each)
    extras = [name for name in wrong if name and not wrong[name]]
    rows = report("extras", OK, f"complete: {', '.join(extras) or 'none'}")
    if base := wrong.get("", []):
        rows.insert(0, CheckResult("packages", FAILURE, "; ".join(base), "pip install advnerf"))
    for name in (name for name in wrong if name and wrong[name]):
        stale = [trouble for trouble in wrong[name] if not trouble.endswith("missing")]
        if stale:
            rows += report("extras", WARNING, "; ".join(stale), f"pip install 'advnerf[{name}]'")
    return rows


def _extra(requirement: Requirement) -> str:
    """The extra that a requirement is of; empty for one of the base."""
    match = _EXTRA.search(str(requirement.marker or ""))
    return match[1] if match else ""


def _trouble(requirement: Requirement) -> list[str]:
    name, wanted = requirement.name, requirement.specifier
    try:
        found = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return [f"{name} is missing"]
    return [] if wanted.contains(found, prereleases=True) else [f"{name} {found} is not {wanted}"]


def machine() -> list[CheckResult]:
    """Check cores and memory."""
    memory = memory_gib()
    text = f"{os.cpu_count()} cores, {memory:.0f} GiB memory"
    if memory < _MEMORY_WARNING_GIB:
        do = f"train and attack on another computer, which needs {_MEMORY_WARNING_GIB} GiB"
        return report("machine", WARNING, text, do)
    return report("machine", OK, text)


def disk(folder: Path, bytes_per_s: float) -> list[CheckResult]:
    """Check how many minutes of recording fit on the disk.

    Args:
        folder: Folder for bags, which need not exist.
        bytes_per_s: Data rate of a recording [bytes/s].
    """
    existing = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.is_dir())
    if not os.access(existing, os.W_OK):
        do = "choose another folder, or change its permissions"
        return report("disk", FAILURE, f"{existing} cannot be written to", do)
    free = shutil.disk_usage(existing).free
    lasts = free / bytes_per_s / 60.0
    hourly = bytes_per_s * 3600.0 / 1e9
    text = f"{free / 2**30:.1f} GiB free in {existing}: {lasts:.0f} minutes of recording at {hourly:.1f} GB an hour"
    if lasts < 1.0:
        return report("disk", FAILURE, text, "free some space, or give another --folder")
    if lasts < _RECORDING_MINUTES:
        return report("disk", WARNING, text, "free some space; advnerf bag info shows what a bag contains")
    return report("disk", OK, text)


def places() -> list[CheckResult]:
    """Check whether this user has a home, and where compiled kernels are kept, by writing there."""
    return [_home(), _cache()]


def _home() -> CheckResult:
    do = "set HOME to a folder of this user, or XDG_CONFIG_HOME (keys) and XDG_DATA_HOME (worlds)"
    try:
        folder = user_place("config")
    except PlaceError as error:
        return CheckResult("home", WARNING, str(error), do)
    above = next(path for path in (folder, *folder.parents) if path.is_dir())
    if not is_writable(above):
        return CheckResult("home", WARNING, f"{above} cannot be written", do)
    return CheckResult("home", OK, str(folder))


def _cache() -> CheckResult:
    do = "set NUMBA_CACHE_DIR to a folder of this user that stays"
    try:
        folder = use_own_folder()
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (PlaceError, OSError) as error:
        return CheckResult("cache", FAILURE, f"compiled kernels cannot be kept: {error}", do)
    if folder.is_relative_to(tempfile.gettempdir()):
        return CheckResult("cache", WARNING, f"{folder}, which a restart may empty", do)
    return CheckResult("cache", OK, str(folder))


def sockets() -> list[CheckResult]:
    """Check whether nodes can create their sockets."""
    try:
        return report("sockets", OK, f"in {user_folder()}")
    except (AdvnerfError, OSError) as error:
        do = "change the owner of that folder to your user, or set XDG_RUNTIME_DIR"
        return report("sockets", FAILURE, str(error), do)


def keys(folder: Path | None = None) -> list[CheckResult]:
    """Check the keys for a second host."""
    try:
        folder = folder or default_folder()
        store = KeyFolder(folder)
        rows = store.rows()
        for row in rows:
            if row.ours:
                store.secret(row.name)
    except (AdvnerfError, OSError) as error:
        return report("keys", WARNING, str(error))
    ours = ", ".join(row.name for row in rows if row.ours)
    drivers = ", ".join(row.name for row in rows if DRIVE in row.rights) or "no key"
    if not ours:
        return report("keys", ABSENT, f"none in {folder}", "two hosts need them: advnerf car keys new NAME")
    return report("keys", OK, f"ours: {ours}; {drivers} may drive over the network")


def clock() -> list[CheckResult]:
    """Check whether this computer's clock is synchronised. Ages across hosts are only as accurate as their clocks."""
    seconds, keeper = adjtimex_error_s(), _keeper()
    if seconds is None:
        do = "for two hosts, install chrony on both: sudo apt-get install chrony"
        return report(
            "clock",
            WARNING,
            f"not synchronised according to the kernel; {keeper or 'no time service found'}",
            do,
        )
    text = f"off by at most {seconds * 1e3:.1f} ms{', ' + keeper if keeper else ''}"
    if seconds > CLOCK_ERROR_S:
        return report("clock", WARNING, text, "wait for chrony; chronyc sources lists its time sources")
    return report("clock", OK, text)


def adjtimex_error_s() -> float | None:
    """Estimated error of the clock [s] from adjtimex(2); None if the kernel reports it as unsynchronised."""
    # struct timex of 64-bit Linux: modes, offset, freq, maxerror, esterror, status, ...; 208 bytes in all.
    buffer = ctypes.create_string_buffer(208)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(buffer)
    esterror_us, status = struct.unpack_from("<qi", buffer, 32)
    return None if state < 0 or status & _UNSYNCHRONISED else float(esterror_us) / 1e6


def _keeper() -> str:
    """Describe the time service: chrony or systemd-timesyncd."""
    if shutil.which("chronyc"):
        try:
            told = subprocess.run(
                ["chronyc", "-n", "-c", "tracking"],
                capture_output=True,
                text=True,
                timeout=_CHRONYC_S,
                check=False,
            )
        except (subprocess.TimeoutExpired, OSError):
            return "no answer from chronyc"
        fields = told.stdout.strip().split(",")
        if told.returncode or len(fields) < 6:
            return "chronyd is not running: sudo systemctl start chrony"
        return f"chrony follows {fields[1] or fields[0]}, offset {float(fields[4]) * 1e3:+.2f} ms"
    return "kept by systemd-timesyncd" if Path("/run/systemd/timesync/synchronized").exists() else ""


def launches() -> list[CheckResult]:
    """Check for running launches, which hold ports and devices, and report the clock offset of a second host."""
    rows = []
    for launch in active_launches():
        text = f"running: {launch['name']} in {launch['run_dir']} (process {launch['pid']})"
        do = "its devices are in use; stop it with Ctrl-C in its terminal"
        rows += report("launches", WARNING, text, do)
        rows += _offset(Path(launch["run_dir"]))
    return rows or report("launches", OK, "none running")


def _offset(run_dir: Path) -> Sequence[CheckResult]:
    """Check the clock offset of the other host, if a gateway of this launch measures it."""
    with Bus(run_dir) as bus:
        bus.subscribe("/clock/offset")
        deadline = time.monotonic() + _OFFSET_WAIT_S
        while (left_s := deadline - time.monotonic()) > 0.0:
            bus.wait(left_s)
            for received in bus.receive():
                message = received.message()
                return [offset_finding(str(message.peer), float(message.offset_s), float(message.error_s))]
    return []


def offset_finding(peer: str, offset_s: float, error_s: float) -> CheckResult:
    """Compare the clock offset of another host with the limits of the safety node."""
    text = f"{peer} is {offset_s * 1e3:+.1f} +- {error_s * 1e3:.1f} ms off"
    limit_s = SafetyConfig.model_fields["clock_offset_limit_s"].default
    if abs(offset_s) > limit_s:
        do = "install chrony on both hosts, then run chronyc makestep; until then the car cannot be armed"
        return CheckResult("clock offset", FAILURE, text, do)
    near = abs(offset_s) <= CLOCK_ERROR_S
    do = "" if near else "install chrony on both hosts"
    return CheckResult("clock offset", OK if near else WARNING, text, do)
