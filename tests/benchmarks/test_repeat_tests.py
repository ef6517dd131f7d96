"""The loops beside repeated tests end with the benchmark."""

import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
HOLDS_TWO = """
import psutil, time
from benchmarks.repeat_tests import busy
with busy(2):
    print(*[child.pid for child in psutil.Process().children()], flush=True)
    time.sleep(600)
"""


def test_the_loops_of_a_killed_benchmark_end():
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS_TWO], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as holder:
        try:
            loops = [psutil.Process(int(pid)) for pid in holder.stdout.readline().split()]
            assert len(loops) == 2
            assert all(loop.is_running() for loop in loops)
        finally:
            holder.kill()
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s and any(running(loop) for loop in loops):
        time.sleep(0.05)
    assert not any(running(loop) for loop in loops)


def running(loop: psutil.Process) -> bool:
    """Whether a process still computes; one that nobody waits for stays in the table."""
    return loop.is_running() and loop.status() != psutil.STATUS_ZOMBIE
