"""Tries of one drive: it is repeated until it counts, at most three times. The reasons of spoiled tries are kept.

`nodes.lab.trials.drive_health` decides what spoils a drive, before any result of it is computed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically, write_json
from nodes.lab.trials.trial import SpoiledError, TrialError

MOST_TRIES = 3
_TRIES = ".tries.json"


class NotDrivenError(TrialError):
    """All tries of a drive were spoiled.

    Attributes:
        spoiled: The reason of each try.
    """

    def __init__(self, name: str, spoiled: list[str]) -> None:
        super().__init__(f"{name} was spoiled {len(spoiled)} times, at last: {spoiled[-1]}")
        self.spoiled = tuple(spoiled)


def drive_with_tries(
    drive: Callable[[], dict[str, Any]], file: Path, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Drive until it counts, and keep the result with the reasons of the spoiled tries, as ``spoiled``.

    Args:
        drive: Drives once into the folder named like the file without its suffix, and returns the result as JSON data. Raises
            `SpoiledError` before it computes anything, if the drive does not count.
        file: File for the result. An existing result is returned.
        tell: Called with a message for each spoiled try.

    Raises:
        NotDrivenError: All tries were spoiled, now or in an earlier call.
    """
    if file.exists():
        found: dict[str, Any] = read_json(file)
        return found
    kept = file.with_suffix(_TRIES)
    rounds = _read(kept) or [[]]
    while len(rounds[-1]) < MOST_TRIES:
        shutil.rmtree(file.with_suffix(""), ignore_errors=True)  # from an interrupted or spoiled drive
        try:
            result = {**drive(), "spoiled": _all(rounds)}
        except SpoiledError as error:
            rounds[-1].append(" ".join(str(error).split()))
            write_json(kept, rounds)
            tell(f"{file.stem} does not count: {rounds[-1][-1]} (try {len(rounds[-1])} of {MOST_TRIES})")
            continue
        write_atomically(file, json.dumps(result) + "\n")
        return result
    shutil.rmtree(file.with_suffix(""), ignore_errors=True)  # no bag of a drive that does not count
    raise NotDrivenError(file.stem, _all(rounds))


def allow_more_tries(folder: Path) -> None:
    """Allow three more tries of each drive in a folder whose tries were all spoiled. Earlier reasons are kept."""
    for kept in folder.glob(f"*{_TRIES}"):
        rounds = _read(kept)
        if len(rounds[-1]) >= MOST_TRIES:
            write_json(kept, [*rounds, []])


def _read(kept: Path) -> list[list[str]]:
    """The reasons of spoiled tries: a list for each time that a person allowed three of them."""
    found: list[list[str]] = read_json(kept) if kept.exists() else []
    return found


def _all(rounds: list[list[str]]) -> list[str]:
    return [reason for each in rounds for reason in each]
