"""A folder's history in git: which commits changed which file, and the order of the commits. Read only, in a few calls."""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.errors import AdvnerfError

_SEPARATOR = "\x01"


class NoHistory(AdvnerfError):
    """Git has no history of a folder."""


@dataclass(frozen=True)
class Change:
    """One commit's change of one file.

    Attributes:
        commit: Hash of the commit.
        status: ``A`` added, ``M`` modified, ``D`` deleted.
        blob: Hash of the file's new content.
    """

    commit: str
    status: str
    blob: str


class History:
    """The history of some files and folders of a repository, relative to one of its folders, from its current commit back.

    Raises:
        NoHistory: Git, a repository or a commit is missing, or the clone is shallow.
    """

    def __init__(self, folder: Path, paths: Sequence[str]) -> None:
        self.folder = folder
        known = self._git("rev-parse", "--is-shallow-repository", "--show-prefix", "--verify", "HEAD").split(
            "\n"
        )
        if known[0] != "false":
            raise NoHistory("this is a shallow clone; git fetch --unshallow gets the rest")
        self.prefix = known[1]
        inside = [path for path in paths if self.prefix or not path.startswith("..")]
        shown = (
            "--full-history",
            "--topo-order",
            "-c",
            "--raw",
            "--no-abbrev",
            "--no-renames",
            f"--format={_SEPARATOR}%H",
        )
        text = self._git("log", *shown, "--", *inside)
        self.changes = _changes(text)
        if not self.changes:
            raise NoHistory("nothing here was ever committed")  # fmt: skip

    def of(self, path: str) -> list[Change]:
        """Changes of a file below the folder, oldest first; empty if it was never committed."""
        return self.changes.get(os.path.normpath(self.prefix + path), [])

    def below(self) -> list[str]:
        """All files that ever were in the folder, relative to it."""
        return [name.removeprefix(self.prefix) for name in self.changes if name.startswith(self.prefix)]

    def contents(self, blobs: Iterable[str]) -> Iterator[bytes]:
        """The contents of some blobs, in order."""
        wanted = [blob for blob in blobs if set(blob) != {"0"}]
        data = self._run(["cat-file", "--batch"], "\n".join(wanted).encode()) if wanted else b""
        at = 0
        for blob in wanted:
            end = data.index(b"\n", at)
            head = data[at:end].split()
            if len(head) != 3:
                raise NoHistory(f"git has lost {blob}")
            size = int(head[2])
            yield data[end + 1 : end + 1 + size]
            at = end + size + 2

    def after(self, commit: str) -> set[str]:
        """All commits of the history that a commit is a proper ancestor of."""
        return set(self._git("rev-list", "--ancestry-path", f"{commit}..HEAD").split())

    def _git(self, *arguments: str) -> str:
        return self._run(arguments, b"").decode(errors="replace")

    def _run(self, arguments: Sequence[str], given: bytes) -> bytes:
        command = ["git", "-C", str(self.folder), "-c", "core.quotePath=off", *arguments]
        try:
            ended = subprocess.run(command, input=given, capture_output=True, check=False)
        except OSError as error:
            raise NoHistory(f"git cannot be run: {error.strerror}") from None
        if ended.returncode:
            lines = ended.stderr.decode(errors="replace").strip().splitlines()
            raise NoHistory(lines[0] if lines else f"git ended with {ended.returncode}")
        return ended.stdout


def last_commit(folder: Path) -> str:
    """The commit that last changed a file of a folder; empty if git does not know."""
    try:
        newest = next(iter(History(folder, ["."]).changes.values()))
    except NoHistory:
        return ""
    return newest[-1].commit


def blob_of(file: Path, like: str) -> str:
    """The hash that git gives a file's content, of the same kind as another hash."""
    data = file.read_bytes()
    kind = hashlib.sha1 if len(like) == 40 else hashlib.sha256
    return kind(b"blob %d\0" % len(data) + data).hexdigest()


def _changes(text: str) -> dict[str, list[Change]]:
    """Changes of each file, oldest first, from the raw log; a merge lists files that differ from all of its parents."""
    found: dict[str, list[Change]] = {}
    commit = ""
    for line in text.split("\n"):
        if line.startswith(_SEPARATOR):
            commit = line[1:]
        elif line.startswith(":"):
            head, _, name = line.partition("\t")
            parts = head.lstrip(":").split()
            # Modes and blobs before (one for each parent) and after, then the status.
            found.setdefault(name, []).insert(0, Change(commit, parts[-1][0], parts[-2]))
    return found
