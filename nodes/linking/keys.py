"""Keys for network access to a host: key pairs, and two allow-lists for the rights to watch and to drive.

A key folder holds ``secret/NAME.key`` (own keys, mode 0600), ``public/NAME.pub`` (all known keys), and the lists
``watch/NAME.pub`` and ``drive/NAME.pub``. Each file holds one Z85 text of 40 characters (ZeroMQ RFC 32). A running gateway reads the
lists at every handshake and twice a second, and disconnects keys that were removed.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import zmq

from advnerf_core.files import write_atomically
from advnerf_core.places import expanded, private_folder, user_place
from nodes.runtime.descriptors import has_run_out
from nodes.runtime.errors import SecurityError

WATCH, DRIVE = "watch", "drive"
RIGHTS = (WATCH, DRIVE)
_MAKE_KEYS = "Create keys with advnerf car keys new, allow the other host with advnerf car keys allow, and set keys to the folder"
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")
_LABEL = re.compile(
    r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
)  # of a name of a computer (RFC 1123; many have _)
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


@dataclass(frozen=True)
class KeyRow:
    """An entry of a key folder.

    Attributes:
        name: Name of the key, usually of a host or a person.
        public: Public key, Z85.
        ours: Whether the folder has the secret key.
        rights: The lists that contain the key.
    """

    name: str
    public: str
    ours: bool
    rights: tuple[str, ...]


def default_folder() -> Path:
    """Default key folder of this user."""
    return user_place("config") / "keys"


class KeyFolder:
    """Keys and allow-lists of one host.

    Args:
        path: The folder; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = expanded(path)

    def new(self, name: str) -> str:
        """Create a key pair and return the public key. A name that already has one is refused."""
        secret_file = self._file("secret", name, ".key")
        if secret_file.exists() or self._file("public", name).exists():
            raise SecurityError(
                f"{self.path} already has a key {name}; use another name, or revoke the key and remove its files"
            )
        public, secret = (half.decode("ascii") for half in zmq.curve_keypair())
        private_folder(self.path.resolve())
        private_folder(secret_file.parent)
        descriptor = os.open(secret_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as stream:
            stream.write(secret + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        write_atomically(self._file("public", name), public + "\n")
        return public

    def add(self, name: str, public: str) -> None:
        """Store the public key of another host. A different key under a known name is refused, and so is a known key under another name: its rights
        are those of the key, and revoking one name would leave it the other's.
        """
        known = self._file("public", name)
        if not _KEY.fullmatch(public):
            raise SecurityError(f"expected a public key of 40 Z85 characters for {name}, got {public!r:.60}")
        if known.exists() and _read_key(known) != public:
            raise SecurityError(
                f"{name} has another key in {known}; revoke {name} and remove that file first"
            )
        if other := next((row for row in self.rows() if row.public == public and row.name != name), None):
            if other.ours:
                raise SecurityError(
                    f"expected the public key of {name}, got {other.name}, a key of this host itself; give the one that advnerf car keys new {name} "
                    "printed on the other host"
                )
            raise SecurityError(f"this public key is known as {other.name}; allow or revoke {other.name}")
        write_atomically(known, public + "\n")

    def allow(self, name: str, right: str) -> tuple[str, ...]:
        """Give a known key a right: to drive, which includes to watch, or to watch alone. Returns the rights that it had and loses."""
        _require_right(right)
        public = self.public(name)
        lost = self.revoke(name, DRIVE) if right == WATCH and self._file(DRIVE, name).exists() else ()
        for granted in RIGHTS if right == DRIVE else (right,):
            write_atomically(self._file(granted, name), public + "\n")
        return lost

    def revoke(self, name: str, right: str | None = None) -> tuple[str, ...]:
        """Remove a key from the drive list, or from both lists if the right is watch or None. Returns the revoked rights."""
        if right is not None:
            _require_right(right)
        taken = []
        for lost in (DRIVE,) if right == DRIVE else RIGHTS:
            file = self._file(lost, name)
            if file.exists():
                file.unlink()
                taken.append(lost)
        if not taken:
            raise SecurityError(f"{name} has no such right in {self.path}; see advnerf car keys list")
        return tuple(taken)

    def public(self, name: str) -> str:
        """Public key of a name."""
        file = self._file("public", name)
        if not file.exists():
            known = ", ".join(row.name for row in self.rows()) or "none"
            raise SecurityError(
                f"expected a public key at {file}, found none; known are {known}. Create it with advnerf car keys new {name}, or copy it from its "
                f"host with advnerf car keys allow {name} --public KEY"
            )
        return _read_key(file)

    def secret(self, name: str) -> str:
        """Secret key of a name. A file that other users can read is refused."""
        file = self._file("secret", name, ".key")
        if not file.exists():
            raise SecurityError(
                f"expected a secret key at {file}, found none; create it on this host with advnerf car keys new {name}"
            )
        mode = stat.S_IMODE(file.stat().st_mode)
        if mode & 0o077:
            raise SecurityError(
                f"expected mode 0600 of {file}, got {mode:04o}: other users may have read it; create a new key"
            )
        return _read_key(file)

    def allowed(self, right: str) -> dict[str, str]:
        """Names of a list by public key. What cannot be read, or has no valid key, allows nobody.

        Raises:
            OSError: Descriptors or memory have run out, so that the list is not known now; see `has_run_out`.
        """
        found: dict[str, str] = {}
        with _ignoring_what_is_no_key():
            for name in sorted(os.listdir(self.path / right)):
                file = self.path / right / name
                if file.suffix == ".pub":
                    with _ignoring_what_is_no_key():
                        found[_read_key(file)] = file.stem
        return found

    def rows(self) -> list[KeyRow]:
        """All keys of the folder, by name."""
        names = {file.stem for folder in ("public", *RIGHTS) for file in (self.path / folder).glob("*.pub")}
        rows = []
        for name in sorted(names):
            rights = tuple(right for right in RIGHTS if self._file(right, name).exists())
            file = next(f for f in map(lambda d: self._file(d, name), ("public", *RIGHTS)) if f.exists())
            rows.append(KeyRow(name, _read_key(file), self._file("secret", name, ".key").exists(), rights))
        return rows

    def _file(self, folder: str, name: str, suffix: str = ".pub") -> Path:
        require_name(name)
        return self.path / folder / f"{name}{suffix}"


def require_name(name: str) -> None:
    """Raise `SecurityError` for a name that no key has."""
    if not _NAME.fullmatch(name):
        raise SecurityError(f"expected a name of at most 32 letters a-z, digits, - and _, got {name!r}")


def require_address(text: str) -> None:
    """Raise for what is neither an IP address nor a name of a computer.

    Raises:
        SecurityError: It is neither, such as ``192.168.1.300``.
    """
    try:
        ipaddress.ip_address(text)
    except ValueError:
        labels = text.split(".")
        if not all(map(_LABEL.fullmatch, labels)) or labels[-1].isdecimal():
            raise SecurityError(f"expected an IP address, or the name of a computer, got {text!r}") from None


def is_loopback(address: str) -> bool:
    """Whether an address can only be reached from this computer."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def require_keys(address: str, keys: KeyFolder | None, commands: Sequence[str] = ()) -> None:
    """Without keys, refuse addresses that other computers can reach, and refuse topics that command the car.

    Any process of any user on this computer can connect to a TCP port of the loopback. So commands need keys there too. Without
    keys, the operator arms through the bus's Unix sockets, which only the same user can open.

    Args:
        address: Address on which the link listens, or to which it connects.
        keys: The key folder, or None.
        commands: Topics that would be sent through the drive door to the listening host.

    Raises:
        SecurityError: Keys are needed but not given.
    """
    if keys is not None:
        return
    if not is_loopback(address):
        raise SecurityError(
            f"{address} can be reached from other computers, and no keys are given, so any computer could connect. {_MAKE_KEYS}; or use 127.0.0.1"
        )
    if commands:
        shown = ", ".join(sorted(commands)[:4]) + (
            f" and {len(commands) - 4} more" if len(commands) > 4 else ""
        )
        raise SecurityError(
            f"without keys a link can only be used to watch, but this one would carry {shown} to the listening host, so any process on "
            f"{address} could drive the car. {_MAKE_KEYS}; or run all nodes on one computer with --host all"
        )


@contextlib.contextmanager
def _ignoring_what_is_no_key() -> Iterator[None]:
    try:
        yield
    except SecurityError:
        return
    except OSError as error:
        if has_run_out(error.errno):
            raise


def _require_right(right: str) -> None:
    if right not in RIGHTS:
        raise SecurityError(f"expected the right {' or '.join(RIGHTS)}, got {right}")


def _read_key(file: Path) -> str:
    with open(file, "rb") as stream:
        text = stream.read(100).decode("ascii", "replace").strip()
    if not _KEY.fullmatch(text):
        raise SecurityError(f"expected one key of 40 Z85 characters in {file}, got {text[:20]!r}")
    return text
