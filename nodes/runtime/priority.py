"""Share of the processors of a node's process.

Each node is a separate session. With autogrouping (sched(7)), the kernel first shares the processors between sessions, and the nice
value of a process counts only within its session. So both values are set. Real-time scheduling is not used: a node that spins would
then stop everything else.
"""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

# Nice values: the nodes that stop the car before all others, then the simulated lab, which a busy computer should not slow down more than
# it slows down a real one; helpers that the car does not need after them.
FIRST, WORLD, HELPER = -10, -5, 15
_NICE_OF = {"safety": FIRST, "motor": FIRST, "twin": WORLD, "attack": HELPER, "viewer": HELPER}
_AUTOGROUP = Path("/proc/self/autogroup")
_RATE_LIMIT_S = 0.15


@dataclass(frozen=True)
class Share:
    """The share that a process got.

    Attributes:
        autogroup: Nice value of its session; None without autogrouping, or in a session of other processes.
    """

    nice: int
    autogroup: int | None

    def reaches(self, nice: int) -> bool:
        """Whether both values are at least as good as the wanted one."""
        return self.nice <= nice and (self.autogroup is None or self.autogroup <= nice)

    def __str__(self) -> str:
        group = "" if self.autogroup is None else f", autogroup {self.autogroup}"
        return f"nice {self.nice}{group}"


def take_share_of(role: str) -> Share:
    """Set the share of a node's process by its role. Called once, at the start of the process."""
    nice = _NICE_OF.get(role)
    return share_now() if nice is None else take_share(nice)


def take_share(nice: int) -> Share:
    """Set the nice values of this process and of its session as far as the system lets it, and return what it got."""
    current = os.getpriority(os.PRIO_PROCESS, 0)
    for wanted in nices_to_try(nice, current, resource.getrlimit(resource.RLIMIT_NICE)[0]):
        try:
            os.setpriority(os.PRIO_PROCESS, 0, wanted)
            break
        except OSError:
            continue
    if os.getsid(0) == os.getpid():  # a shell's session holds other processes too
        _write_autogroup(os.getpriority(os.PRIO_PROCESS, 0))
    return share_now()


def nices_to_try(nice: int, current: int, limit: int) -> list[int]:
    """Return the values to try, best first. A helper is never raised, and a node that stops the car is never lowered.

    Args:
        limit: RLIMIT_NICE: without the privilege a process may go as far as 20 minus this limit (setrlimit(2)).
    """
    if nice >= 0:
        return [nice] if nice > current else []
    return [value for value in dict.fromkeys((nice, max(nice, 20 - limit))) if value < current]


def share_now() -> Share:
    """Return the nice values of this process."""
    return share_of("self", os.getsid(0) == os.getpid())


def share_of(pid: int | str, own_session: bool = True) -> Share:
    """Return the nice values of a process of this computer."""
    # proc(5): the nice value is field 19, counted from the process id.
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    nice = int(stat.rpartition(")")[2].split()[16])
    try:
        group = int(Path(f"/proc/{pid}/autogroup").read_text(encoding="ascii").split()[-1])
    except (OSError, ValueError, IndexError):
        return Share(nice, None)
    return Share(nice, group if own_session and _autogroups() else None)


def _autogroups() -> bool:
    try:
        switch = Path("/proc/sys/kernel/sched_autogroup_enabled").read_text(encoding="ascii")
    except OSError:
        return False
    return switch.strip() == "1"


def _write_autogroup(nice: int) -> None:
    for _ in range(2):
        try:
            _AUTOGROUP.write_text(f"{nice}\n", encoding="ascii")
            return
        except BlockingIOError:
            time.sleep(_RATE_LIMIT_S)  # the kernel limits the rate of changes
        except OSError:
            return
