"""The ledger of measured claims: ``docs/results.json``, and the pages made from it, one for each question.

A row is written by the command that measured it (`record_row`), replaces the older row of the same line, and stays in when it
misses its target, with the reason. ``python -m benchmarks.results`` renders the pages.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.evidence.registration import launch_file
from benchmarks.answers import Answer, answers, sets_table, table
from benchmarks.kept_commands import NOT_KEPT, kept_by
from benchmarks.questions import OTHER, QUESTIONS, Question, question_of
from nodes.runtime.machine import memory_gib, processor_name

REPOSITORY = Path(__file__).resolve().parents[1]
LEDGER = REPOSITORY / "docs" / "results.json"
PAGE = REPOSITORY / "docs" / "results.md"
_PICTURE = """![All deployed drives in Duckietown's simulator from above, and what the camera saw](results/gap_duckietown_robust_above.webp)

*One registered set, in Duckietown's simulator. [Each set](results/transfer.md) has this picture. No real car
was driven: [what was and was not run](was_not_run.md).*

"""

# Names in recorded rows, and those on pages.
_NAMES = {
    "surrogate": "learned scene",
    "surrogates": "learned scenes",
    "no attack": "plain object",
}
_NAMES_IN_ROWS = re.compile(rf"\b({'|'.join(_NAMES)})\b")

# An absolute path, but not the second half of a relative one, of a fraction or of a unit.
MACHINE_PATH = re.compile(r"(?<![\w.~$}<)/])/(?:tmp|var|home|root|work|opt|mnt|media|Users)/\S*")


def machine_description() -> str:
    """The machine in words: processor, cores usable, memory, accelerator if torch sees one."""
    return f"{processor_name()}, {len(os.sched_getaffinity(0))} cores, {memory_gib():.0f} GiB, Python {platform.python_version()}"


@dataclass(frozen=True)
class LedgerRow:
    """One measured claim; see `record_row`."""

    line: str
    value: float | str
    unit: str
    target: str
    met: bool | None
    command: str
    note: str = ""
    machine: str = ""
    date: str = ""

    def record(self, ledger: Path = LEDGER, page: Path = PAGE) -> None:
        """Write it into a ledger."""
        record_row(**vars(self), ledger=ledger, page=page)


def record_row(
    line: str,
    value: float | str,
    unit: str,
    target: str,
    met: bool | None,
    command: str,
    note: str = "",
    *,
    machine: str = "",
    date: str = "",
    ledger: Path = LEDGER,
    page: Path = PAGE,
) -> None:
    """Write one measured claim into the ledger and render the pages.

    Args:
        line: What was measured, e.g. ``"adjoint gradient against back-propagation"``; the row's key.
        value: What was measured.
        unit: Unit of ``value``.
        target: The target in words, e.g. ``">= 26 dB"``.
        met: Whether the target was met; None where the line has no target.
        command: The command that measured it, runnable from the project root.
        note: The reason for a miss, or what the reader must know.
        machine: Where it was measured; this machine if it is not said.
        date: When, ISO; now if it is not said.
        ledger: Where the ledger is kept.
        page: Where the index of the pages is written; the questions and the published sets lie beside it in ``results/``.
    """
    if found := MACHINE_PATH.search(f"{line} {value} {target} {command} {note}"):
        raise ValueError(
            f"expected a row without paths of this machine, got {found[0]!r} in {line!r}; name files relative to the project"
        )
    row = {
        "line": line,
        "value": value,
        "unit": unit,
        "target": target,
        "met": met,
        "command": command,
        "note": note,
        "machine": machine or machine_description(),
        # To the second: it names one measurement, so that a changed value is told from one that was measured again.
        "date": date or datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    with _locked(ledger):
        rows = [r for r in read_rows(ledger) if r["line"] != line]
        rows.append(row)
        write_atomically(
            ledger, json.dumps(sorted(rows, key=lambda r: r["line"]), indent=1, ensure_ascii=False) + "\n"
        )
        write_pages(read_rows(ledger), page, page.parent / "results")


def read_rows(ledger: Path = LEDGER) -> list[dict[str, Any]]:
    """All rows of the ledger; an absent ledger has none."""
    if not ledger.exists():
        return []
    rows: list[dict[str, Any]] = read_json(ledger)
    return rows


def write_pages(rows: list[dict[str, Any]], page: Path, published: Path = PAGE.parent / "results") -> None:
    """Write the index ``page``, and beside it ``results/<question>.md`` for each question that has rows.

    Args:
        rows: Of the ledger.
        page: The index.
        published: Folder of the published sets, which the index sums up.
    """
    asked: dict[Question, list[dict[str, Any]]] = {question: [] for question in (*QUESTIONS, OTHER)}
    for row in rows:
        asked[question_of(row["command"])].append(row)
    answered = {question: found for question, found in asked.items() if found}
    folder = page.parent / "results"
    folder.mkdir(parents=True, exist_ok=True)
    for question, found in answered.items():
        write_atomically(folder / f"{question.slug}.md", _question_page(question, found))
    write_atomically(folder / "missed.md", _missed_page(answered))
    write_atomically(page, _index_page(answered, answers(rows, published), sets_table(published)))


def _index_page(answered: dict[Question, list[dict[str, Any]]], found: list[Answer], sets: str) -> str:
    head = (
        "# Measured results\n\n"
        + (_PICTURE if sets else "")
        + "Each figure was written by the command beside it. `advnerf verify` computes "
        "rows of kept drives again; the others were measured once.\n\n## In short\n\n"
        + table(found)
        + (sets and f"\n{sets}")
        + "\n## All rows\n\nA row that misses its target stays: [missed targets](results/missed.md).\n\n"
        "| question | rows | with a target | missed |\n|---|---|---|---|\n"
    )
    lines = [
        f"| [{question.title}](results/{question.slug}.md) | {len(found)} "
        f"| {sum(row['met'] is not None for row in found)} | {sum(row['met'] is False for row in found)} |\n"
        for question, found in answered.items()
    ]
    return head + "".join(lines)


def _missed_page(answered: dict[Question, list[dict[str, Any]]]) -> str:
    """All rows that miss their targets, as a table."""
    missed = [
        f"| {_escaped(_renamed(row['line']))} | {_renamed(_value(row))} | {_escaped(_renamed(row['target']))} | [{question.slug.replace('_', ' ')}]({question.slug}.md) |\n"
        for question, found in answered.items()
        for row in found
        if row["met"] is False
    ]
    head = "# Missed targets\n\nRows that miss their targets. The reasons stand on the page of each row. [All questions](../results.md).\n\n"
    return head + (
        "| measured | value | target | page |\n|---|---|---|---|\n" + "".join(missed) if missed else "None.\n"
    )


def _question_page(question: Question, rows: list[dict[str, Any]]) -> str:
    """A page with one table for each command, in the order of the rows."""
    text = f"# {question.title}\n\n"
    text += f"![{question.title}]({question.picture})\n\n" if question.picture else ""
    text += f"{question.answers} [All questions](../results.md).\n"
    for command in dict.fromkeys(row["command"] for row in rows):
        kept = "Computed again by `advnerf verify`." if kept_by(command) else NOT_KEPT
        text += f"\n## `{launch_file(command)}`\n\n{kept}\n\n| measured | value | target | met | note | machine, date |\n|---|---|---|---|---|---|\n"
        text += "".join(_render_row(row) for row in rows if row["command"] == command)
    return text


def _value(row: dict[str, Any]) -> str:
    value = f"{row['value']:.4g}" if isinstance(row["value"], float) else str(row["value"])
    return f"{value} {row['unit']}".strip()


def _render_row(row: dict[str, Any]) -> str:
    met = {True: "yes", False: "**no**", None: "-"}[row["met"]]
    named = (row["line"], _value(row), row["target"], met, row["note"])
    cells = [*map(_renamed, named), f"{row['machine']}, {row['date'][:10]}"]
    return "| " + " | ".join(map(_escaped, cells)) + " |\n"


def _renamed(text: str) -> str:
    """The one name that pages have for each thing."""
    return _NAMES_IN_ROWS.sub(lambda found: _NAMES[found[0]], text)


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")


@contextmanager
def _locked(ledger: Path) -> Iterator[None]:
    """Two benchmarks may end at the same moment; neither may lose the other's row."""
    ledger.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(ledger.parent, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def main() -> None:
    """Render the page from the ledger."""
    argparse.ArgumentParser(description=main.__doc__).parse_args()
    write_pages(read_rows(), PAGE)
    print(f"wrote {PAGE} and its questions ({len(read_rows())} rows)")


if __name__ == "__main__":
    main()
