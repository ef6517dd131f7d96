"""The default tests in two halves at the same time: ``python -m tests.support.default_tests``, which is ``make test``.

Live tests run one after the other and mostly wait. Those that compute take what that leaves of the processors, and nothing else: the
kernel gives a process of the idle class no time that another one wants. On a busy machine, or on one core, that may be none at all.
So whatever has not passed in the idle class when the live tests are done runs (again) as an ordinary process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
DEFAULT = "not slow and not gpu and not hardware and not data and not browser and not ros2 and not timing and not campaign"
_ENVIRONMENT = Path(sys.prefix)
_KERNELS, _LOG = _ENVIRONMENT / ".kernels", _ENVIRONMENT / "computing-tests.log"
_PYTEST = (sys.executable, "-m", "pytest", "-q")
# Passed over: so much of the processors is too little to wait for, over so long a time [s].
_TOO_LITTLE, _LOOK_S = 0.5, 15.0
_IDLE, _NO_TESTS = "idle", 5


def live_tests() -> int:
    """Run the live half. Only files that mark a test as live are collected, which saves ten seconds of imports."""
    files = [
        str(file) for file in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.live" in file.read_text()
    ]
    return subprocess.call([*_PYTEST, "-m", f"({DEFAULT}) and live", *files], cwd=ROOT)


def computing_tests(passed: Path, idle: bool) -> int:
    """Compile the kernels once, otherwise each worker would, and run the other half but for the tests that have passed.

    Args:
        passed: File with the names of the tests that have passed; grows.
        idle: In the idle class; tests then have no limit of time, as they may get none.
    """
    if idle:
        _be_idle()
    os.environ["OMP_NUM_THREADS"] = "1"
    sources = [f for f in (ROOT / "advnerf_core").rglob("*.py") if "njit" in f.read_text()]
    if not _KERNELS.exists() or _KERNELS.stat().st_mtime < max(f.stat().st_mtime for f in sources):
        subprocess.run([sys.executable, "-m", "tests.support.warm_kernels"], cwd=ROOT, check=True)
        _KERNELS.touch()
    # A worker more than processors would import everything and make its set-ups too, for the little that the live tests leave.
    workers = min(len(os.sched_getaffinity(0)), 4)
    options = ("-n", str(workers), "--dist", "worksteal", "-p", "no:cacheprovider", f"--passed={passed}")
    limit = ("--timeout", "0") if idle else ()
    # The folder is named: pytest must find our option in its conftest.py before it reads the options.
    command = [*_PYTEST, *options, *limit, "-m", f"({DEFAULT}) and not live", "tests"]
    code = subprocess.call(command, cwd=ROOT)
    return 0 if code == _NO_TESTS and passed.exists() else code


def _be_idle() -> None:
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    os.nice(19)
    with contextlib.suppress(OSError):  # a kernel without autogroups
        # Each session has its share, however idle its processes are.
        Path("/proc/self/autogroup").write_text("19")


def _spent_s(pid: int) -> float:
    """Processor time of a process and all below it so far [s]."""
    total_s = 0.0
    with contextlib.suppress(psutil.NoSuchProcess):
        tree = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
        for process in tree:
            with contextlib.suppress(psutil.NoSuchProcess):
                total_s += sum(process.cpu_times()[:4])
    return total_s


def _wait_while_fed(process: subprocess.Popen[bytes]) -> int | None:
    """Wait for the idle half as long as it gets much of the processors; its exit code, None if it does not."""
    cores = len(os.sched_getaffinity(0))
    while True:
        before_s = _spent_s(process.pid)
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(_LOOK_S)
        if _spent_s(process.pid) - before_s < _TOO_LITTLE * cores * _LOOK_S:
            return None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and all below it: in the idle class it may get no time to end by itself."""
    with contextlib.suppress(psutil.NoSuchProcess):
        for each in [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
    process.wait()


def main() -> int:
    """Run both halves; 0 if all is green."""
    passed = _ENVIRONMENT / "computing-tests.passed"
    passed.unlink(missing_ok=True)
    command = [sys.executable, "-m", "tests.support.default_tests"]
    with _LOG.open("wb") as log:
        idle = subprocess.Popen(
            [*command, _IDLE, str(passed)], cwd=ROOT, stdout=log, stderr=log, start_new_session=True
        )
    began_s = time.monotonic()
    try:
        live = live_tests()
        print(f"live tests: {time.monotonic() - began_s:.0f} s; waiting for the tests that compute ({_LOG})")
        computing = _wait_while_fed(idle)
    finally:
        _end(idle)
    print(_LOG.read_text(errors="replace"), flush=True)
    if computing != 0:
        print("what has not passed while the live tests ran, now as ordinary processes:", flush=True)
        computing = computing_tests(passed, idle=False)
    print(f"live tests: {_word(live)}, tests that compute: {_word(computing)}", flush=True)
    return int(live != 0 or computing != 0)


def _word(code: int) -> str:
    return "green" if code == 0 else f"red (pytest says {code})"


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
    if sys.argv[1:2] == [_IDLE]:
        sys.exit(computing_tests(Path(sys.argv[2]), idle=True))
    sys.exit(main())
