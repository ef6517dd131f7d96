"""The ledger of measured claims: ``docs/results.json``, and ``docs/results.md`` made from it.

A row is written by the command that measured it (`record_row`), replaces the older row of the same line, and stays in when it
misses its target, with the reason. ``python -m benchmarks.results`` renders the page.
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
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from advnerf_core.files import write_atomically
from nodes.runtime.machine import memory_gib, processor_name

REPOSITORY = Path(__file__).resolve().parents[1]
LEDGER = REPOSITORY / "docs" / "results.json"
PAGE = REPOSITORY / "docs" / "results.md"

# An absolute path, but not the second half of a relative one, of a fraction or of a unit.
MACHINE_PATH = re.compile(r"(?<![\w.~$}<)/])/(?:tmp|var|home|root|work|opt|mnt|media|Users)/\S*")


def machine_description() -> str:
    """The machine in words: processor, cores usable, memory, accelerator if torch sees one."""
    return f"{processor_name()}, {len(os.sched_getaffinity(0))} cores, {memory_gib():.0f} GiB, Python {platform.python_version()}"


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
    """Write one measured claim into the ledger and render the page.

    Args:
        line: The line of the issue that asks for it, e.g. ``"#2 adjoint gradient against back-propagation"``; the row's key.
        value: What was measured.
        unit: Unit of ``value``.
        target: The target in words, e.g. ``">= 26 dB"``.
        met: Whether the target was met; None where the line has no target.
        command: The command that measured it, runnable from the project root.
        note: The reason for a miss, or what the reader must know.
        machine: Where it was measured; this machine if it is not said.
        date: When, ISO; today if it is not said.
        ledger: Where the ledger is kept.
        page: Where the page is written.
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
        "date": date or datetime.now(timezone.utc).date().isoformat(),
    }
    with _locked(ledger):
        rows = [r for r in read_rows(ledger) if r["line"] != line]
        rows.append(row)
        write_atomically(
            ledger, json.dumps(sorted(rows, key=lambda r: r["line"]), indent=1, ensure_ascii=False) + "\n"
        )
        write_atomically(page, render_page(read_rows(ledger)))


def read_rows(ledger: Path = LEDGER) -> list[dict[str, Any]]:
    """All rows of the ledger; an absent ledger has none."""
    if not ledger.exists():
        return []
    rows: list[dict[str, Any]] = json.loads(ledger.read_text())
    return rows


def render_page(rows: list[dict[str, Any]]) -> str:
    """The ledger as a Markdown page."""
    head = (
        "# Measured results\n\nMade from `docs/results.json` by `python -m benchmarks.results`; every row was measured by the "
        "command beside it, on that machine and day; rows of campaigns are gathered from its cells by `python -m benchmarks.transfer_table`, those of "
        "retraining by `python -m benchmarks.retraining`.\n\n| line | value | target | met | command | machine, date | note |\n|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_render_row(row) for row in rows)


def _render_row(row: dict[str, Any]) -> str:
    value = f"{row['value']:.4g}" if isinstance(row["value"], float) else str(row["value"])
    met = {True: "yes", False: "**no**", None: "-"}[row["met"]]
    cells = [
        row["line"],
        f"{value} {row['unit']}".strip(),
        row["target"],
        met,
        f"`{row['command']}`",
        f"{row['machine']}, {row['date']}",
        row["note"],
    ]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


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
    write_atomically(PAGE, render_page(read_rows()))
    print(f"wrote {PAGE} ({len(read_rows())} rows)")


if __name__ == "__main__":
    main()
