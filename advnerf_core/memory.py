"""The peak of this process's resident memory, from the kernel; and when freed memory is returned to it."""

from __future__ import annotations

import ctypes
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_KIB_PER_MIB = 1024.0
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # as in glibc's malloc.h
# For the environment of a process whose peak is measured. glibc raises its threshold for returning freed blocks as it goes, and what then counts
# as resident depends on the order of frees, by some 10 to 30 MiB from run to run. With fixed thresholds resident memory is what the process holds.
RETURNS_WHAT_IS_FREED = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


def restart_peak() -> float:
    """Reset the kernel's peak to the current resident size, if permitted, and return it [MiB]."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        print("cannot reset the peak: idle includes start-up", file=sys.stderr)
    return peak_mib()


def peak_mib() -> float:
    """Highest resident size since the start or the last `restart_peak` [MiB]."""
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / _KIB_PER_MIB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KIB_PER_MIB


@contextmanager
def freed_blocks_kept() -> Iterator[None]:
    """Keep freed blocks in the process until the end of the context, where glibc allocates.

    A training frees the same large blocks in each step. Returned to the kernel, each costs a page fault for every 4 KiB when it is next used.
    """
    process = ctypes.CDLL(None)
    if not hasattr(process, "mallopt"):  # another C library
        yield
        return
    process.mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    process.mallopt(_MMAP_THRESHOLD, 2**30)
    try:
        yield
    finally:
        # The values that glibc's own thresholds rise to.
        process.mallopt(_TRIM_THRESHOLD, 2**26)
        process.mallopt(_MMAP_THRESHOLD, 2**25)
        process.malloc_trim(0)
