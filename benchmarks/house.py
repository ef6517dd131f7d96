"""How much is there to read, to learn and to clone? ``python -m benchmarks.house``.

Counts of the code of the four packages, of the pages that people read, of the command line, and of what git tracks.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import typer

from benchmarks.results import REPOSITORY, record_row
from docs.draw_rooms import PACKAGES
from nodes.cli.main import PANELS, app

COMMAND = "python -m benchmarks.house"
# Written by commands, so that nobody reads them from the first word to the last.
GENERATED = ("api.md", "results.md")
# Sizes on 2026-11-25, of which 70 % are wanted [kB].
_EXPERIMENT_KB, _REPORT_KB, _WANTED = 552, 219, 0.7
_LINES, _WORDS, _PAGE_WORDS, _TRACKED_MB, _ENTRIES, _FOLDERS, _MEANINGS = 91_000, 35_000, 1_500, 45, 12, 2, 15
_IDIOMS, _FRAGMENTS_PERCENT, _FILES_OF_A_TASK = 4, 8, 3
_LEAST_WORDS = 300  # of a sub-package; with fewer, one idiom is a high rate
# Words that a reader who is not a native speaker has to guess at, and descriptions of a parameter that are not sentences.
_IDIOM = re.compile(
    r"\b(anew|told|nobody|whoever|as (it|they) (is|are|was|were)|of (its|their) own|there is none|(goes?|gone|went) on|in words|"
    r"so (many|much|far)|whatever|where it is|is that of|those of|that of|of which|thing|things|is there already|lies? there|give[ns]? up|"
    r"elsewhere)\b",
    re.IGNORECASE,
)
_DESCRIPTION = re.compile(r"^\s+`{0,2}\w[\w*, `]*`{0,2}: ", re.MULTILINE)
_FRAGMENT = re.compile(
    r"^\s+`{0,2}[\w*, `]+`{0,2}: (Which|Whose|Of|Told|What|Where|How|In|As|It|Its|There)\b[^.]*\.?\s*$",
    re.MULTILINE,
)


def main() -> None:
    """Count, and write the rows."""
    sources = [file for package in PACKAGES for file in sorted((REPOSITORY / package).rglob("*.py"))]
    lines = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in sources)
    _row("lines of the four packages", lines, "lines", _LINES)
    for folder, before_kb in (("nodes/experiment", _EXPERIMENT_KB), ("advnerf_core/report", _REPORT_KB)):
        size_kb = sum(file.stat().st_size for file in (REPOSITORY / folder).rglob("*.py")) // 1000
        _row(f"Python of {folder}", size_kb, "kB", int(_WANTED * before_kb), f"it was {before_kb} kB")
    twice = [name for name, count in Counter(_classes(sources)).items() if count > 1]
    _row("class names that mean several classes", len(twice), "names", _MEANINGS, ", ".join(sorted(twice)))
    idioms, fragments = _prose(sources)
    _row("idioms per 1,000 words of docstrings and comments, worst sub-package", *idioms)
    _row("descriptions of parameters that are fragments, worst sub-package", *fragments)
    _row("files to open for one of five first tasks, most", *_first_tasks())
    pages = [file for file in (REPOSITORY / "docs").glob("*.md") if file.name not in GENERATED]
    words = {
        file.name: len(file.read_text(encoding="utf-8").split())
        for file in [*pages, REPOSITORY / "README.md"]
    }
    _row("words on pages that people read", sum(words.values()), "words", _WORDS, f"{len(words)} pages")
    long = [name for name, count in words.items() if count > _PAGE_WORDS]
    _row(f"pages over {_PAGE_WORDS:,} words", len(long), "pages", 0, ", ".join(long))
    _row("tracked files", round(_tracked_bytes() / 1e6, 1), "MB", _TRACKED_MB)
    _row(
        "entries at the top of --help",
        sum(map(len, PANELS.values())),
        "entries",
        _ENTRIES,
        f"in {len(PANELS)} panels",
    )
    parameters = list(_parameters(typer.main.get_command(app)))
    _row(
        "parameters of commands without help",
        sum(not (each.help or "").strip() for each in parameters),
        "parameters",
        0,
        f"of {len(parameters)}",
    )
    folders = {
        each.opts[0]
        for each in parameters
        if re.match(r"(New |Run |Key )?folder\b", each.help or "", re.IGNORECASE)
        and each.opts[0].startswith("--")
    }
    _row("names of options for folders", len(folders), "names", _FOLDERS, ", ".join(sorted(folders)))


def _row(line: str, value: float, unit: str, limit: float, note: str = "") -> None:
    record_row(f"size: {line}", value, unit, f"<= {limit:,}", value <= limit, COMMAND, note)


def _prose(sources: list[Path]) -> list[tuple[float, str, float, str]]:
    """Rates of idioms and of fragments of the sub-package with the most, each as value, unit, limit and note."""
    pieces: dict[str, list[str]] = {}
    for file in sources:
        room = "/".join(file.relative_to(REPOSITORY).parts[:2])
        pieces.setdefault(room, []).extend(_texts(file.read_text(encoding="utf-8")))
    idioms, fragments = {}, {}
    for room, texts in pieces.items():
        words = sum(len(text.split()) for text in texts)
        if words > _LEAST_WORDS:
            idioms[room] = 1000 * sum(len(_IDIOM.findall(text)) for text in texts) / words
            described = sum(len(_DESCRIPTION.findall(text)) for text in texts)
            fragments[room] = 100 * sum(len(_FRAGMENT.findall(text)) for text in texts) / max(described, 1)
    worst = [max(rates, key=rates.__getitem__) for rates in (idioms, fragments)]
    return [
        (round(idioms[worst[0]], 2), "per 1,000", _IDIOMS, worst[0]),
        (round(fragments[worst[1]], 2), "%", _FRAGMENTS_PERCENT, worst[1]),
    ]


def _texts(source: str) -> Iterator[str]:
    """Docstrings and comments of a file."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield ast.get_docstring(node) or ""
    yield from re.findall(r"#\s(.*)", source)


def _first_tasks() -> tuple[int, str, int, str]:
    """Most files that a row of "Where to look" in docs/architecture.md names: value, unit, limit and note."""
    page = (REPOSITORY / "docs/architecture.md").read_text(encoding="utf-8")
    section = page.partition("## Where to look")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ") and ".py`" in line]
    files = [len(set(re.findall(r"`[\w/]+\.py`", row))) for row in rows]
    return max(files), "files", _FILES_OF_A_TASK, f"{len(rows)} tasks in docs/architecture.md"


def _classes(sources: list[Path]) -> Iterator[str]:
    for file in sources:
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                yield node.name


def _parameters(group: Any) -> Iterator[Any]:
    below = getattr(group, "commands", {}).values()
    yield from chain(() if below else group.params, *map(_parameters, below))


def _tracked_bytes() -> int:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout
    return sum((REPOSITORY / name).stat().st_size for name in listed.split("\0") if name)


if __name__ == "__main__":
    main()
