"""Uses git as the witness for what the files cannot show: what came first, what was changed, and what is gone.

It relies on ancestry of commits, not on dates. A full rewrite of the history can deceive it, but not readers with a clone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import parse_json, read_json
from advnerf_core.report.evidence.kept_build import BUILD
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.verifying.git import Change, History, NoHistory, blob_of
from advnerf_core.report.evidence.verifying.layout import SET, cell_files, sets_in
from advnerf_core.report.evidence.verifying.removed import LOG, read_removed, value_entry

LEDGER = "../results.json"
# Keys that identify one measurement of a row.
_MEASUREMENT = ("date", "machine", "command", "note", "unit")
Log = Mapping[tuple[str, str], str]


@dataclass(frozen=True)
class Witnessed:
    """Git's evidence about the published results.

    Attributes:
        not_checked: Reason why there is none; else empty.
        problems: Problems as text.
        files: Number of checked files of sets.
        removed: Logged removals, which readers should know of.
    """

    not_checked: str = ""
    problems: tuple[str, ...] = ()
    files: int = 0
    removed: int = 0


def verify_history(published: Path) -> Witnessed:
    """Compare the published results with the history of their repository.

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
        problems += _changed(history, published, log)
        problems += _gone(history, published, log)
        problems += _rows(history, published, log)
    except NoHistory as error:
        return Witnessed(not_checked=str(error))
    return Witnessed("", tuple(problems), len(history.below()), len(log))


def _set_problems(history: History, folder: Path, log: Log) -> Iterator[str]:
    """Whether the registration is unchanged since its commit, which precedes every cell."""
    name = folder.name
    cells = [(file, _since_added(history.of(f"{name}/{file.name}"))) for file in cell_files(folder)]
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
    later = history.after(last.commit)
    for file, changes in cells:
        if changes and changes[0].commit not in later:
            yield f"{file}: was committed in {changes[0].commit[:9]}, which does not come after its registration in {last.commit[:9]}"


def _changed(history: History, published: Path, log: Log) -> Iterator[str]:
    """Files of registered sets and of the reference build, and films, that were changed after their commit without a log entry."""
    folders = [published / name for name in (*sets_in(published), BUILD)]
    for part in (*(folder.rglob("*") for folder in folders), published.glob("*.webp")):
        for file in sorted(path for path in part if path.is_file()):
            path = file.relative_to(published).as_posix()
            changes = _since_added(history.of(path))
            if not changes or path.endswith((f"/{SET}", f"/{FILE}")) or ("file", path) in log:
                continue
            if len(changes) > 1 or blob_of(file, changes[0].blob) != changes[0].blob:
                yield f"{file}: was changed after it had been committed in {changes[0].commit[:9]}, and {LOG} does not say why"


def _since_added(changes: list[Change]) -> list[Change]:
    """Changes of a file since it was last added; empty if the last commit does not have it."""
    if not changes or changes[-1].status == "D":
        return []
    added = [number for number, change in enumerate(changes) if change.status == "A"]
    return changes[added[-1] if added else 0 :]


def _gone(history: History, published: Path, log: Log) -> Iterator[str]:
    """Sets, their files and registered scenarios that were committed once and are now missing without a log entry."""
    once = [name for name in history.below() if _is_kept(name)]
    for kind, names in (
        ("set", {name.split("/")[0] for name in once if not (published / name.split("/")[0]).is_dir()}),
        ("file", {name for name in once if not (published / name).exists()}),
        ("scenario", _scenarios_once(history) - _scenarios_now(published)),
    ):
        for name in sorted(names):
            gone_with_its_set = kind != "set" and not (published / name.split("/")[0]).is_dir()
            if (kind, name) not in log and not gone_with_its_set:
                yield f"{published}: the {kind} {name} was committed once, is not there, and {LOG} does not say why"


def _is_kept(name: str) -> bool:
    """Whether a published file belongs to a set and is not generated from its other files."""
    return (
        "/" in name
        and name.endswith(".json")
        and not name.startswith(f"{BUILD}/")
        and not name.endswith(f"/{SET}")
    )


def _scenarios_once(history: History) -> set[str]:
    """Scenarios of all registrations ever committed, ``SET/SCENARIO``."""
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
            continue  # verifying the set reports it
    return found


def _rows(history: History, published: Path, log: Log) -> Iterator[str]:
    """Missed rows of the ledger that are gone, and rows with another value or verdict of the same measurement."""
    changes = [change for change in history.of(LEDGER) if change.status != "D"]
    if not changes:
        return
    now = {row["line"]: row for row in read_json(published / LEDGER)} if (published / LEDGER).exists() else {}
    told: set[str] = set()
    for text in history.contents(dict.fromkeys(change.blob for change in changes)):
        for row in _ledger(text):
            line = row["line"]
            there = now.get(line)
            entry = ("row", line) if there is None else value_entry(line, there["value"])
            if line in told or entry in log:
                continue
            if problem := _row_problem(row, there):
                told.add(line)
                yield f"{published / LEDGER}: the row {line!r} {problem}, and {LOG} does not say why"


def _row_problem(once: Mapping[str, Any], now: Mapping[str, Any] | None) -> str:
    """The change of a row that must be logged; empty if nothing."""
    if now is None:
        return "was missed and is gone" if once["met"] is False else ""
    if any(once.get(key) != now.get(key) for key in _MEASUREMENT):
        return ""  # it was measured again
    if once["value"] != now["value"]:
        return f"had the value {once['value']} and has {now['value']}, of one measurement"
    if once["met"] != now["met"] and once["target"] == now["target"]:
        return "has another verdict on the same value"
    return ""


def _ledger(text: bytes) -> list[dict[str, Any]]:
    try:
        return [row for row in parse_json(text, LEDGER) if row.keys() >= {"line", "value", "met", "target"}]
    except (ValueError, KeyError, TypeError, AttributeError):  # a ledger that was damaged once
        return []
