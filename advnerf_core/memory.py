"""The peak of this process's resident memory, from the kernel."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_KIB_PER_MIB = 1024.0
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
