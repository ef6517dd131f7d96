"""Numbers with a unit on hand-written pages: of a published row, a setting, or measured once. ``python -m benchmarks.page_numbers``.

A page may hold numbers of three kinds. A result stands in a row of ``docs/results.json`` or in a published set, and is found there as it
is written. A setting or a limit is no result; pages of nothing else are listed in `SETTINGS`. A page with any other number says `MARK` at
its head, and its numbers are listed in `LIST`, which the command writes: a number that is edited is then in neither.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically

MARK = "measured once, not kept"
LIST = "measured_once.json"  # in the folder of the pages
_HEAD_LINES = 8
# Made from rows and code by commands, which tests hold them to.
_GENERATED = ("results.md", "api.md")
# How-to and reference pages: their other numbers are settings, limits, formats and sizes of devices.
SETTINGS = frozenset(
    """bags.md cameras.md carla.md cars.md driving.md faults.md first_day.md intersection.md operator_page.md policies.md policy_contract.md
    room.md ros2.md scene_files.md trials.md troubleshooting.md was_not_run.md wiring.md worlds.md""".split()  # noqa: SIM905
)
# Settings on pages that lead to results.
_SETTINGS_ON = {"README.md": {("250", "ms")}, "evidence.md": {("2", "kB")}}
_UNIT = r"%|dB|ms|us|s|min|h|x|×|mm|cm|m|MB|GB|kB|MiB|GiB|rad|degrees|Hz"  # noqa: RUF001
_NUMBER = re.compile(rf"(?<![\w.#/=-])(-?\d[\d,]*(?:\.\d+)?) ?({_UNIT})(?![\w/])")
_CODE = re.compile(r"^(?: {4}.*|```[\s\S]*?```)$|`[^`]*`|\]\([^)]*\)", re.MULTILINE)
_DECIMALS = range(5)


@dataclass(frozen=True)
class Counted:
    """Numbers of the hand-written pages.

    Attributes:
        published: Those that a published row or set has.
        marked: Others, on pages that say they were measured once.
        settings: Others, on pages of settings.
        problems: Pages with numbers that are none of these.
    """

    published: int
    marked: int
    settings: int
    problems: tuple[str, ...]


def count_numbers(docs: Path, rows: Iterable[Mapping[str, Any]]) -> Counted:
    """Sort the numbers of all hand-written pages.

    Args:
        docs: Folder of the pages; README.md lies beside it.
        rows: Of the ledger.
    """
    known = {*_of_rows(rows), *_of_sets(docs / "results")}
    listed = read_json(docs / LIST) if (docs / LIST).exists() else {}
    counts, problems = {"published": 0, "marked": 0, "settings": 0}, []
    for page in _pages(docs):
        text = page.read_text(encoding="utf-8")
        settings = _SETTINGS_ON.get(page.name, set())
        found = list(numbers_in(text))
        others = [each for each in found if each not in known | settings]
        counts["published"] += sum(each in known for each in found)
        counts["settings"] += sum(each in settings - known for each in found)
        if is_marked(text):
            counts["marked"] += len(others)
            problems += _not_listed(page, others, listed.get(page.name, []))
        elif page.name in SETTINGS:
            counts["settings"] += len(others)
        elif others:
            first = " ".join(others[0])
            problems.append(
                f"{page}: {first} is in no published row or set; say at its head that figures were {MARK!r}"
            )
    return Counted(**counts, problems=tuple(problems))


def measured_once(docs: Path, rows: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Numbers of marked pages that no row has, by page."""
    known, found = set(_of_rows(rows)), {}
    for page in _pages(docs):
        text = page.read_text(encoding="utf-8")
        if is_marked(text):
            found[page.name] = sorted({" ".join(each) for each in numbers_in(text) if each not in known})
    return found


def _not_listed(page: Path, others: Iterable[tuple[str, str]], listed: Iterable[str]) -> Iterator[str]:
    wrong = sorted({" ".join(each) for each in others} - set(listed))
    if wrong:
        yield f"{page}: {wrong[0]} is in no published row or set, and not in {LIST}; python -m benchmarks.page_numbers writes it"


def _pages(docs: Path) -> Iterator[Path]:
    for page in [docs.parent / "README.md", *sorted(docs.glob("*.md"))]:
        if page.name not in _GENERATED and page.exists():
            yield page


def is_marked(text: str) -> bool:
    """Whether a page says at its head that figures were measured once."""
    return MARK in " ".join(text.splitlines()[:_HEAD_LINES])


def numbers_in(text: str) -> Iterator[tuple[str, str]]:
    """Numbers of a text with their units, code and links left out."""
    for number, unit in _NUMBER.findall(_CODE.sub(" ", text)):
        yield number.replace(",", ""), unit.replace("×", "x")  # noqa: RUF001


def _of_rows(rows: Iterable[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Numbers of the ledger as a page may write them: rounded values, and those in targets and notes."""
    for row in rows:
        yield from numbers_in(f"{row['target']}; {row['note']}; {row['value']} {row['unit']}")
        unit = row["unit"].split(" ")[0]
        if isinstance(row["value"], int | float):
            yield from _rounded(row["value"], unit)


def _of_sets(published: Path) -> Iterator[tuple[str, str]]:
    """Lengths and shares of the published sets."""
    for file in sorted(published.glob("*/set/set.json")):
        data = read_json(file)
        for row in (*data.get("rows", ()), *data.get("primary", ()), *data.get("contrasts", ())):
            for key, value in row.items():
                if key.endswith("_m") and value is not None:
                    yield from _rounded(value, "m")
                elif key.endswith("_share"):
                    yield from _rounded(100.0 * value, "%")


def _rounded(value: float, unit: str) -> Iterator[tuple[str, str]]:
    return ((f"{value:.{decimals}f}", unit) for decimals in _DECIMALS)


def main() -> None:
    """Write the list of numbers that were measured once."""
    from benchmarks.results import REPOSITORY, read_rows

    docs = REPOSITORY / "docs"
    found = measured_once(docs, read_rows())
    write_atomically(docs / LIST, json.dumps(found, indent=1) + "\n")
    print(f"{docs / LIST}: {sum(map(len, found.values()))} numbers of {len(found)} pages")


if __name__ == "__main__":
    main()
