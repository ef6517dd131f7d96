"""Two network namespaces joined by a bad cable: real kernels' TCP at both ends, packets lost, late or held up in between.

Each namespace gets a TUN device; a thread here carries the IP packets from one to the other. Needs root, ``/dev/net/tun`` and
iproute2; the kernel's own netem is not needed.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_MTU = 1500
ADDRESSES = ("10.199.0.1", "10.199.0.2")


@dataclass
class Cable:
    """What happens to packets; may be changed while it works.

    Attributes:
        loss: Fraction of packets lost, each way.
        delay_s: Time on the way, each way [s].
        stalled_until: Monotonic time until which everything is held up [s].
        carried: Packets delivered.
        lost: Packets lost.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    stalled_until: float = 0.0
    carried: int = 0
    lost: int = 0
    names: tuple[str, str] = ("", "")
    _stop: threading.Event = field(default_factory=threading.Event)

    def stall(self, duration_s: float) -> None:
        """Hold everything up for a while [s]."""
        self.stalled_until = time.monotonic() + duration_s

    def inside(self, host: int) -> list[str]:
        """What to put before a command so that it runs on a host (0 or 1)."""
        return ["ip", "netns", "exec", self.names[host]]

    def carry(self, ends: tuple[int, int], seed: int) -> None:
        """Carry packets until told to stop."""
        random_, count = random.Random(seed), 0
        waiting: list[tuple[float, int, int, bytes]] = []
        while not self._stop.is_set():
            now = time.monotonic()
            late = max(0.0, waiting[0][0] - now) if waiting else 0.1
            for end in select.select(ends, [], [], min(0.1, late))[0]:
                packet = os.read(end, 2 * _MTU)
                if random_.random() < self.loss:
                    self.lost += 1
                    continue
                other = ends[1] if end == ends[0] else ends[0]
                count += 1
                heapq.heappush(waiting, (time.monotonic() + self.delay_s, count, other, packet))
            now = time.monotonic()
            while waiting and now >= self.stalled_until and waiting[0][0] <= now:
                _, _, other, packet = heapq.heappop(waiting)
                with contextlib.suppress(OSError):  # the other end is being taken down
                    os.write(other, packet)
                    self.carried += 1
            if waiting and now < self.stalled_until:
                time.sleep(0.005)


@contextlib.contextmanager
def two_hosts(cable: Cable, seed: int = 0) -> Iterator[Cable]:
    """Two namespaces with the addresses ``ADDRESSES``; gone afterwards."""
    tag = f"adv{os.getpid()}"
    cable.names = (f"{tag}a", f"{tag}b")
    ends: list[int] = []
    thread = None
    try:
        for index, name in enumerate(cable.names):
            _ip("netns", "add", name)
            ends.append(_tun(f"{tag}{index}"))
            _ip("link", "set", f"{tag}{index}", "netns", name)
            for command in (
                ("addr", "add", f"{ADDRESSES[index]}/24", "dev", f"{tag}{index}"),
                ("link", "set", f"{tag}{index}", "up"),
                ("link", "set", "lo", "up"),
            ):
                _ip("-n", name, *command)
            # The same on every computer: the algorithm decides how losses are borne. Reno may be chosen in any namespace, and
            # slows down for a loss at least as much as the cubic that most computers have.
            _ip("netns", "exec", name, "sysctl", "-qw", "net.ipv4.tcp_congestion_control=reno")
        thread = threading.Thread(target=cable.carry, args=((ends[0], ends[1]), seed), daemon=True)
        thread.start()
        yield cable
    finally:
        cable._stop.set()
        if thread is not None:
            thread.join()
        for end in ends:
            os.close(end)
        for name in cable.names:
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


def resend_early(cable: Cable, after_ms: int = 20) -> None:
    """Let TCP send again after so many milliseconds at the earliest, not the kernel's 200, as docs/two_hosts.md advises."""
    for index, (name, address) in enumerate(zip(cable.names, ADDRESSES, strict=True)):
        device = f"{name[:-1]}{index}"
        route = (f"{address.rsplit('.', 1)[0]}.0/24", "dev", device, "src", address)
        _ip("-n", name, "route", "replace", *route, "rto_min", f"{after_ms}ms")


def _tun(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return device


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(arguments)}: {done.stderr.strip()}; this needs root and iproute2")


def available() -> bool:
    """Whether this computer lets us make namespaces and TUN devices."""
    return (
        os.geteuid() == 0 and os.access("/dev/net/tun", os.R_OK | os.W_OK) and Path("/usr/sbin/ip").exists()
    )
