"""Git as the witness of what the files themselves cannot show: what came first, what was changed, and what is gone.

By ancestry of commits, not by dates. Whoever can write the whole history again can still deceive it, but not those who have a clone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import parse_json, read_json
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.verifying.git import Change, History, NoHistory, blob_of
from advnerf_core.report.evidence.verifying.layout import cell_files, sets_in
from advnerf_core.report.evidence.verifying.removed import LOG, read_removed

LEDGER = "../results.json"
Log = Mapping[tuple[str, str], str]


@dataclass(frozen=True)
class Witnessed:
    """What git says of the published results.

    Attributes:
        not_checked: Why it says nothing; empty if it does.
        problems: What is wrong, in words.
        files: Files of sets whose past was looked at.
        removed: Logged removals, which readers should know of.
    """

    not_checked: str = ""
    problems: tuple[str, ...] = ()
    files: int = 0
    removed: int = 0


def verify_history(published: Path) -> Witnessed:
    """Hold the published results against the history of their repository.

    Raises:
        SetError: The log of removals is damaged.
    """
    log = read_removed(published)
    try:
        history = History(published, [".", LEDGER])
        problems = [
            problem
            for name in sets_in(published)
            for problem in _set_problems(history, published / name, log)
        ]
        problems += _gone(history, published, log)
        problems += _rows(history, published, log)
    except NoHistory as error:
        return Witnessed(not_checked=str(error))
    return Witnessed("", tuple(problems), len(history.below()), len(log))


def _set_problems(history: History, folder: Path, log: Log) -> Iterator[str]:
    """Whether the registration is as it was committed, before every cell, and no cell was changed since it was committed."""
    name = folder.name
    cells = {
        file.stem: (file, _since_added(history.of(f"{name}/{file.name}"))) for file in cell_files(folder)
    }
    registered = _since_added(history.of(f"{name}/{FILE}"))
    if not registered:
        if cells:
            yield f"{folder / FILE}: was not committed, so git cannot tell that it is older than the cells"
        return
    last = registered[-1]
    if blob_of(folder / FILE, last.blob) != last.blob:
        yield f"{folder / FILE}: is not the one that was committed in {last.commit[:9]}"
    if len(registered) > 1 and ("registration", name) not in log:
        yield f"{folder / FILE}: was changed in {last.commit[:9]} after it had been committed, and {LOG} does not say why"
    for cell, (file, changes) in cells.items():
        if not changes:
            continue  # not committed yet
        if not history.is_before(last.commit, changes[0].commit):
            yield f"{file}: was committed in {changes[0].commit[:9]}, which does not come after its registration in {last.commit[:9]}"
        changed = len(changes) > 1 or blob_of(file, changes[0].blob) != changes[0].blob
        if changed and ("cell", f"{name}/{cell}") not in log:
            yield f"{file}: was changed after it had been committed in {changes[0].commit[:9]}, and {LOG} does not say why"


def _since_added(changes: list[Change]) -> list[Change]:
    """Changes of a file since it was last added; empty if it is not there in the last commit."""
    if not changes or changes[-1].status == "D":
        return []
    added = [number for number, change in enumerate(changes) if change.status == "A"]
    return changes[added[-1] if added else 0 :]


def _gone(history: History, published: Path, log: Log) -> Iterator[str]:
    """Sets, their cells and registered scenarios that were committed once and are not there now, and whose removal is not logged."""
    for kind, names in (
        ("set", _sets_once(history) - {file.name for file in published.iterdir() if file.is_dir()}),
        ("cell", _cells_once(history) - _cells_now(published)),
        ("scenario", _scenarios_once(history) - _scenarios_now(published)),
    ):
        for name in sorted(names):
            gone_with_its_set = kind != "set" and ("set", name.split("/")[0]) in log
            if (kind, name) not in log and not gone_with_its_set:
                yield f"{published}: the {kind} {name} was published or registered once, is not there, and {LOG} does not say why"


def _sets_once(history: History) -> set[str]:
    return {name.split("/")[0] for name in history.below() if name.count("/") and name.endswith(".json")}


def _cells_once(history: History) -> set[str]:
    return {
        name.removesuffix(".json")
        for name in history.below()
        if name.count("/") == 1 and name.endswith(".json")
    }


def _cells_now(published: Path) -> set[str]:
    return {f"{file.parent.name}/{file.stem}" for file in published.glob("*/*.json")}


def _scenarios_once(history: History) -> set[str]:
    """Scenarios of all registrations that were ever committed, ``SET/SCENARIO``."""
    pairs = [
        (name.split("/")[0], change.blob)
        for name in history.below()
        if name.endswith(f"/{FILE}")
        for change in history.of(name)
        if change.status != "D"
    ]
    contents = history.contents(blob for _, blob in pairs)
    return {
        f"{name}/{each}" for (name, _), text in zip(pairs, contents, strict=True) for each in _scenarios(text)
    }


def _scenarios(text: bytes) -> Iterable[str]:
    try:
        return dict(parse_json(text, FILE)["scenarios"])
    except (ValueError, KeyError, TypeError):  # a registration that was damaged once
        return ()


def _scenarios_now(published: Path) -> set[str]:
    found = set()
    for name in sets_in(published):
        try:
            found |= {f"{name}/{each}" for each in read_json(published / name / FILE)["scenarios"]}
        except (OSError, ValueError, KeyError, TypeError):
            continue  # verifying the set says so
    return found


def _rows(history: History, published: Path, log: Log) -> Iterator[str]:
    """Missed rows of the ledger that are gone, or met now with nothing measured again."""
    changes = [change for change in history.of(LEDGER) if change.status != "D"]
    if not changes:
        return
    now = {row["line"]: row for row in read_json(published / LEDGER)} if (published / LEDGER).exists() else {}
    told: set[str] = set()
    for text in history.contents(dict.fromkeys(change.blob for change in changes)):
        for row in _missed(text):
            line = row["line"]
            if line in told or ("row", line) in log:
                continue
            if line not in now:
                told.add(line)
                yield f"{published / LEDGER}: the missed row {line!r} is gone, and {LOG} does not say why"
            elif now[line]["met"] is not False and _same_measurement(row, now[line]):
                told.add(line)
                yield f"{published / LEDGER}: the row {line!r} was missed and is not now, of the same measurement"


def _missed(text: bytes) -> list[dict[str, Any]]:
    try:
        return [row for row in parse_json(text, LEDGER) if row["met"] is False]
    except (ValueError, KeyError, TypeError):  # a ledger that was damaged once
        return []


def _same_measurement(row: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    keys = ("date", "machine", "command", "note")
    return all(row.get(key) == other.get(key) for key in keys)
