"""When did the host withhold its processors? A heartbeat of real-time priority on each of them; needs root.

A virtual machine's processors may stand still for a tenth of a second because its host runs others. Nothing in the guest can run
then, so that a command grows old and the car stops as it should. A heartbeat with SCHED_FIFO is ahead of every ordinary process: if it
comes late, no load inside the machine explains it. The kernel's own count of such time is "steal" in ``/proc/stat``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

_PERIOD_S, _LATE_S = 0.005, 0.03
# What came late within this time before a stop counts, and so much of it explains one [s].
_BEFORE_S, _ENOUGH_S = 0.5, 0.1
_PRIORITY = 50


@dataclass(frozen=True)
class Pause:
    """One processor stood still.

    Attributes:
        cpu: Which.
        mono_s: When it went on, monotonic time [s].
        length_s: How long it stood still [s].
    """

    cpu: int
    mono_s: float
    length_s: float


class HostPauses:
    """Heartbeats in processes of their own; use it as a context manager.

    Args:
        folder: For what they note.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._began = stolen()

    def __enter__(self) -> HostPauses:
        for cpu in sorted(os.sched_getaffinity(0)):
            command = [sys.executable, "-m", "tests.campaigns.host_pauses", str(cpu), str(self._file(cpu))]
            self._processes.append(subprocess.Popen(command))
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._processes:
            process.terminate()
            process.wait()

    def _file(self, cpu: int) -> Path:
        return self._folder / f"host_pauses_{cpu}.txt"

    def found(self) -> list[Pause]:
        """All pauses so far."""
        pauses = []
        for file in sorted(self._folder.glob("host_pauses_*.txt")):
            cpu = int(file.stem.rpartition("_")[2])
            for line in file.read_text(encoding="ascii").splitlines():
                mono_s, length_s = map(float, line.split())
                pauses.append(Pause(cpu, mono_s, length_s))
        return pauses

    def explain(self, mono_s: float) -> bool:
        """Whether a processor stood still for 0.1 s in all during the half second before a moment (monotonic time [s])."""
        lengths: dict[int, float] = {}
        for pause in self.found():
            if mono_s - _BEFORE_S <= pause.mono_s <= mono_s:
                lengths[pause.cpu] = lengths.get(pause.cpu, 0.0) + pause.length_s
        return max(lengths.values(), default=0.0) >= _ENOUGH_S

    def describe(self) -> str:
        """The pauses in words."""
        pauses, (withheld, spent) = self.found(), stolen()
        share = 100.0 * (withheld - self._began[0]) / max(1, spent - self._began[1])
        longest_s = max((pause.length_s for pause in pauses), default=0.0)
        return (
            f"the host withheld {share:.1f} % of the processors' time: {len(pauses)} pauses of {1e3 * _LATE_S:g} ms and more, "
            f"longest {1e3 * longest_s:.0f} ms"
        )


def stolen() -> tuple[int, int]:
    """Time stolen by the host, and all time, of all processors together since the start [jiffies]."""
    numbers = [
        int(word) for word in Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:9]
    ]
    return numbers[7], sum(numbers)


def beat(cpu: int, file: Path) -> None:
    """Note when this processor stood still, until the process is ended."""
    os.sched_setaffinity(0, {cpu})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    last_s = time.monotonic()
    with file.open("w", buffering=1, encoding="ascii") as log:
        while True:
            time.sleep(_PERIOD_S)
            now_s = time.monotonic()
            if now_s - last_s >= _LATE_S:
                log.write(f"{now_s:.6f} {now_s - last_s - _PERIOD_S:.6f}\n")
            last_s = now_s


if __name__ == "__main__":
    beat(int(sys.argv[1]), Path(sys.argv[2]))
