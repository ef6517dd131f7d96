"""Who may open the page: one-time codes, sessions, host names and origins. Times come as arguments.

A browser on the same computer needs no code if its process belongs to the user of the node, as for the Unix sockets of the bus.
Any other browser gives the code that is shown on the robot, once, and gets a session. A session is a cookie of 256 random bits that
scripts cannot read. It is bound to the browser's address and ends with the node.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import socket
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from nodes.runtime.clock import NS_PER_S

COOKIE = "advnerf_page"
# 32 letters and digits without those that look alike: 8 of them are 40 bits.
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"
_CODE_LENGTH = 8
# Checked codes per second, from all addresses together: in the 300 s of a code, guessing one of 2^40 succeeds once in
# 4 * 10^8. Codes that come faster wait for their turn, so strangers can slow the operator down, and cannot keep the operator out.
_GUESSES_HZ = 10.0
# Wrong codes of one address that cost nothing; each further one doubles the time until the next is looked at.
_FREE_GUESSES, _LONGEST_WAIT_S = 3, 30.0
_MOST_GUESSERS = 4096
_SESSIONS = 64
_SESSION_S = 12 * 3600.0


@dataclass
class _Guesser:
    wrong: int = 0
    free_ns: int = 0


@dataclass
class _Session:
    address: str
    since_ns: int
    name: str


@dataclass
class Sessions:
    """Gives out codes and sessions.

    Attributes:
        code_s: Time for which a code is valid [s].
    """

    code_s: float = 300.0
    code: str = ""
    _code_ns: int = 0
    _turn_ns: int = 0
    _guessers: dict[str, _Guesser] = field(default_factory=dict)
    _sessions: dict[str, _Session] = field(default_factory=dict)
    _admitted: int = 0

    def renew(self, mono_ns: int) -> bool:
        """Make a new code if the current one is missing or has expired. Returns whether it is new."""
        if self.code and mono_ns - self._code_ns <= self.code_s * NS_PER_S:
            return False
        self.code = "".join(secrets.choice(_LETTERS) for _ in range(_CODE_LENGTH))
        self._code_ns = mono_ns
        return True

    def wait_s(self, address: str, mono_ns: int) -> float:
        """Time that this address must wait after its wrong codes before another one is looked at [s]; 0 if it need not wait."""
        guesser = self._guessers.get(_network(address))
        return 0.0 if guesser is None else max(0.0, (guesser.free_ns - mono_ns) / NS_PER_S)

    def turn_s(self, address: str, mono_ns: int) -> float:
        """Take a turn for one code. Returns the time until it is looked at [s]."""
        self._turn_ns = max(mono_ns, self._turn_ns + round(NS_PER_S / _GUESSES_HZ))
        # The next code of this address waits at least until this one was looked at.
        self._guesser(address).free_ns = self._turn_ns
        return (self._turn_ns - mono_ns) / NS_PER_S

    def enter(self, code: str, address: str, mono_ns: int, name: str = "") -> str:
        """Exchange a code for a session. Returns its token; empty if the code is wrong, used or expired.

        A code is valid once. Wrong codes make their address wait, and do not void the code. The name is that of the person.
        """
        given = code.strip().upper().replace("-", "").replace(" ", "").encode()
        fresh = bool(self.code) and mono_ns - self._code_ns <= self.code_s * NS_PER_S
        right = hmac.compare_digest(given, self.code.encode())
        if not (fresh and right):
            guesser = self._guesser(address)
            guesser.wrong += 1
            if (excess := guesser.wrong - _FREE_GUESSES) >= 0:
                delay_s = min(2.0 ** min(excess, 10), _LONGEST_WAIT_S)
                guesser.free_ns = mono_ns + round(delay_s * NS_PER_S)
            return ""
        self._guessers.pop(_network(address), None)
        self.code = ""
        return self.admit(address, mono_ns, name)

    def admit(self, address: str, mono_ns: int, name: str = "") -> str:
        """Make a session for an address and return its token. Without a name of its person, the session is a numbered watcher."""
        while len(self._sessions) >= _SESSIONS:
            self._sessions.pop(next(iter(self._sessions)))
        token = secrets.token_hex(32)
        self._admitted += 1
        self._sessions[token] = _Session(address, mono_ns, name or f"watcher {self._admitted}")
        return token

    def name(self, token: str) -> str:
        """Name of the person of a session; empty for an unknown token."""
        session = self._sessions.get(token)
        return session.name if session else ""

    def rename(self, token: str, name: str) -> None:
        """Note the name that the person of a session gave."""
        if session := self._sessions.get(token):
            session.name = name

    def _guesser(self, address: str) -> _Guesser:
        network = _network(address)
        if network not in self._guessers:
            while len(self._guessers) >= _MOST_GUESSERS:
                self._guessers.pop(next(iter(self._guessers)))
            self._guessers[network] = _Guesser()
        return self._guessers[network]

    def knows(self, token: str, address: str, mono_ns: int) -> bool:
        """Whether a token is a session of this address."""
        found = self._sessions.get(token)
        if found is None:
            return False
        return found.address == address and mono_ns - found.since_ns <= _SESSION_S * NS_PER_S


def _network(address: str) -> str:
    """The network that guesses count for: an IPv4 address, or the first 64 bits of an IPv6 address, which one host can fill."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


def host_is_ours(host: str, names: tuple[str, ...] = ()) -> bool:
    """Whether a ``Host`` header names this computer: by an address, or by a name that only it has.

    A foreign page can point its own name at this computer (DNS rebinding), but not an address.
    """
    name = _hostname(host)
    if name is None:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        return name in ("localhost", own, f"{own}.local", *names)
    return True


def origin_is_ours(origin: str | None, host: str, tls: bool) -> bool:
    """Whether a request comes from the page itself: its origin is the address that it was sent to."""
    return origin == f"{'https' if tls else 'http'}://{host}"


def _hostname(host: str) -> str | None:
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # raises an error if it is not a number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == host and "@" not in host else None


def peer_is_same_user(peer: tuple[str, int], ours: tuple[str, int]) -> bool:
    """Whether the other end of a TCP connection on this computer belongs to a process of this user, or to root.

    Source: proc(5), ``/proc/net/tcp``: addresses in hexadecimal, in the order of the host's bytes, and the user of each socket.
    """
    wanted = (_proc_address(peer), _proc_address(ours))
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        try:
            rows = Path(table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for row in rows:
            cells = row.split()
            if (cells[1], cells[2]) == wanted:
                return int(cells[7]) in (0, os.getuid())
    return False


def _proc_address(address: tuple[str, int]) -> str:
    """An address and a port as ``/proc/net/tcp`` writes them."""
    packed = ipaddress.ip_address(address[0]).packed
    words = (int.from_bytes(packed[k : k + 4], "little") for k in range(0, len(packed), 4))
    return "".join(f"{word:08X}" for word in words) + f":{address[1]:04X}"
