"""Who may talk to a host over the network: key pairs, and two allow-lists - who may watch, and who may drive.

A key folder holds ``secret/NAME.key`` (ours, mode 0600), ``public/NAME.pub`` (of anybody we know), and the lists
``watch/NAME.pub`` and ``drive/NAME.pub``. Files hold one Z85 text of 40 characters (ZeroMQ RFC 32), nothing else. A running
gateway reads the lists at every handshake, and again twice a second: who is taken off them is cut off at once.
"""

from __future__ import annotations

import ipaddress
import os
import re
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zmq

from advnerf_core.files import write_atomically
from nodes.runtime.errors import SecurityError

WATCH, DRIVE = "watch", "drive"
RIGHTS = (WATCH, DRIVE)
_MAKE_KEYS = (
    "Make keys with advnerf keys new, allow the other host with advnerf keys allow, and name the folder under keys"
)
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


@dataclass(frozen=True)
class KeyRow:
    """One name of a key folder.

    Attributes:
        name: Name of the key, usually of a host or a person.
        public: Its public key, Z85.
        ours: Whether the secret half is here.
        rights: The lists it is on.
    """

    name: str
    public: str
    ours: bool
    rights: tuple[str, ...]


def default_folder() -> Path:
    """Key folder of this user."""
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "advnerf" / "keys"


class KeyFolder:
    """Keys and allow-lists of one host.

    Args:
        path: The folder; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path).expanduser()

    def new(self, name: str) -> str:
        """Make a key pair and return the public half; a name that has one is refused."""
        secret_file = self._file("secret", name, ".key")
        if secret_file.exists() or self._file("public", name).exists():
            raise SecurityError(
                f"{self.path} has a key {name} already; take another name, or revoke it and remove its files"
            )
        public, secret = (half.decode("ascii") for half in zmq.curve_keypair())
        _private_folder(self.path)
        _private_folder(secret_file.parent)
        descriptor = os.open(secret_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as stream:
            stream.write(secret + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        write_atomically(self._file("public", name), public + "\n")
        return public

    def add(self, name: str, public: str) -> None:
        """Remember the public key of another host; another key under a known name is refused."""
        known = self._file("public", name)
        if not _KEY.fullmatch(public):
            raise SecurityError(f"expected a public key of 40 Z85 characters for {name}, got {public!r:.60}")
        if known.exists() and _read_key(known) != public:
            raise SecurityError(f"{name} has another key in {known}; revoke {name} and remove that file first")
        write_atomically(known, public + "\n")

    def allow(self, name: str, right: str) -> None:
        """Put a known key on a list; who may drive may watch."""
        public = self.public(name)
        for granted in RIGHTS if right == DRIVE else (right,):
            write_atomically(self._file(granted, name), public + "\n")

    def revoke(self, name: str, right: str | None = None) -> tuple[str, ...]:
        """Take a key off a list; off both where no right is named, or the right to watch. Returns what was taken."""
        taken = []
        for lost in (DRIVE,) if right == DRIVE else RIGHTS:
            file = self._file(lost, name)
            if file.exists():
                file.unlink()
                taken.append(lost)
        if not taken:
            raise SecurityError(f"{name} is on no such list in {self.path}; see: advnerf keys list")
        return tuple(taken)

    def public(self, name: str) -> str:
        """Public key of a name."""
        file = self._file("public", name)
        if not file.exists():
            known = ", ".join(row.name for row in self.rows()) or "none"
            raise SecurityError(
                f"no public key {file}; known are {known}. Make one with: advnerf keys new {name}, or bring it from its host "
                f"with: advnerf keys allow {name} --public KEY"
            )
        return _read_key(file)

    def secret(self, name: str) -> str:
        """Secret key of a name; refused when others could read the file."""
        file = self._file("secret", name, ".key")
        if not file.exists():
            raise SecurityError(f"no secret key {file}; make one on this host with: advnerf keys new {name}")
        mode = stat.S_IMODE(file.stat().st_mode)
        if mode & 0o077:
            raise SecurityError(
                f"expected mode 0600 of {file}, got {mode:04o}: others may have read it; make a new key"
            )
        return _read_key(file)

    def allowed(self, right: str) -> dict[str, str]:
        """Names by public key of a list. A file that is no key allows nobody, and takes nobody else's right away."""
        found = {}
        for file in sorted((self.path / right).glob("*.pub")):
            try:
                found[_read_key(file)] = file.stem
            except (SecurityError, FileNotFoundError):
                continue
        return found

    def rows(self) -> list[KeyRow]:
        """Everything that is known, by name."""
        names = {file.stem for folder in ("public", *RIGHTS) for file in (self.path / folder).glob("*.pub")}
        rows = []
        for name in sorted(names):
            rights = tuple(right for right in RIGHTS if self._file(right, name).exists())
            file = next(f for f in map(lambda d: self._file(d, name), ("public", *RIGHTS)) if f.exists())
            rows.append(KeyRow(name, _read_key(file), self._file("secret", name, ".key").exists(), rights))
        return rows

    def _file(self, folder: str, name: str, suffix: str = ".pub") -> Path:
        if not _NAME.fullmatch(name):
            raise SecurityError(f"expected a name of at most 32 letters a-z, digits, - and _, got {name!r}")
        return self.path / folder / f"{name}{suffix}"


def is_loopback(address: str) -> bool:
    """Whether an address can be reached from this computer only."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def require_keys(address: str, keys: KeyFolder | None, commands: Sequence[str] = ()) -> None:
    """Without keys, refuse an address that other computers can reach, and refuse to carry anything but watching.

    Any process of this computer can connect to a TCP port of the loopback, whoever its user is. Commands therefore need keys
    there too; without them a person arms through the bus's own sockets, which only the same user can open.

    Args:
        address: Where the link listens, or connects to.
        keys: The key folder, if there is one.
        commands: Topics that would go by the drive door, towards the host that listens.

    Raises:
        SecurityError: Keys are needed and there are none.
    """
    if keys is not None:
        return
    if not is_loopback(address):
        raise SecurityError(
            f"{address} can be reached from other computers, and no keys are given: anybody could connect. {_MAKE_KEYS}; or use 127.0.0.1"
        )
    if commands:
        shown = ", ".join(sorted(commands)[:4]) + (f" and {len(commands) - 4} more" if len(commands) > 4 else "")
        raise SecurityError(
            f"without keys a link carries watching only, but this one would carry {shown} to the host that listens: any process on "
            f"{address} could drive the car. {_MAKE_KEYS}; or run everything on one computer with --host all"
        )


def _private_folder(path: Path) -> None:
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        path.chmod(0o700)


def _read_key(file: Path) -> str:
    with open(file, "rb") as stream:
        text = stream.read(100).decode("ascii", "replace").strip()
    if not _KEY.fullmatch(text):
        raise SecurityError(f"expected one key of 40 Z85 characters in {file}, got {text[:20]!r}")
    return text
