"""Numbers with a unit on hand-written pages: of a published row, a setting, or measured once. ``python -m benchmarks.page_numbers``.

A page may hold numbers of three kinds. A result stands in a row of ``docs/results.json`` or in a published set, rounded as it may be. A
setting or a limit is no result; pages of nothing else are listed in `SETTINGS`. A page with any other number says `MARK` at its head.
The command lists the numbers of all pages in `LIST`, by kind: a number that is edited is then not listed, and one whose row has changed is
not published any more.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_json

MARK = "measured once, not kept"
_SETTING = "settings"
LIST = "page_numbers.json"  # in the folder of the pages
_HEAD_LINES = 8
# Made from rows and code by commands, which tests hold them to.
_GENERATED = ("results.md", "api.md")
# How-to and reference pages: their other numbers are settings, limits, formats and sizes of devices.
SETTINGS = frozenset(
    """attacks.md audit.md bag_format.md bags.md calibration.md cameras.md carla.md cars.md driving.md evidence.md experiments.md
    faults.md first_day.md foreign_worlds.md intersection.md methods.md objects.md operator_page.md performance.md policies.md
    policy_contract.md poses.md room.md ros2.md scaling.md scene_files.md scenes.md trials.md troubleshooting.md two_hosts.md
    victims.md was_not_run.md wiring.md worlds.md""".split()  # noqa: SIM905
)
# Settings on pages that lead to results.
_SETTINGS_ON = {"README.md": {("250", "ms")}}
_UNIT = r"%|dB|ms|us|s|min|h|x|×|mm|cm|m|MB|GB|kB|MiB|GiB|rad|degrees|Hz"  # noqa: RUF001
_NUMBER = re.compile(rf"(?<![\w.#/=-])(-?\d[\d,]*(?:\.\d+)?) ?({_UNIT})(?![\w/])")
_CODE = re.compile(r"^(?: {4}.*|```[\s\S]*?```)$|`[^`]*`|\]\([^)]*\)", re.MULTILINE)
_DECIMALS = range(5)
Number = tuple[str, str]  # as it is written, and its unit


@dataclass(frozen=True)
class Counted:
    """Numbers of the hand-written pages.

    Attributes:
        published: Results that a published row or set has.
        marked: Others, on pages that say they were measured once.
        settings: Those of pages of settings, and single ones on other pages.
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
    known = _known(docs, rows)
    listed = read_json(docs / LIST) if (docs / LIST).exists() else {}
    counts = {"published": 0, "marked": 0, "settings": 0}
    problems: list[str] = []
    for page in _pages(docs):
        text = page.read_text(encoding="utf-8")
        for number in numbers_in(text):
            if page.name in SETTINGS or number in _SETTINGS_ON.get(page.name, ()):
                counts["settings"] += 1
            else:
                counts["published" if number in known else "marked"] += 1
        problems += _problems(page, text, known, listed.get(page.name, {}))
    return Counted(**counts, problems=tuple(problems))


def list_numbers(docs: Path, rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, list[str]]]:
    """Every number of each page, as often as it is there, by kind."""
    known, found = _known(docs, rows), {}
    for page in _pages(docs):
        numbers = _results_on(page, page.read_text(encoding="utf-8"))
        if numbers:
            kinds: dict[str, list[str]] = {}
            for number in sorted(numbers):
                kind = _SETTING if page.name in SETTINGS else "published" if number in known else MARK
                kinds.setdefault(kind, []).append(" ".join(number))
            found[page.name] = kinds
    return found


def write_list(docs: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the list of numbers beside the pages."""
    write_json(docs / LIST, list_numbers(docs, rows))


def _problems(
    page: Path, text: str, known: Collection[Number], listed: Mapping[str, Sequence[str]]
) -> Iterator[str]:
    found, published = Counter(map(" ".join, _results_on(page, text))), set(map(" ".join, known))
    there = Counter(each for numbers in listed.values() for each in numbers)
    if wrong := sorted(each for each in found | there if found[each] != there[each]):
        yield f"{page}: {wrong[0]} is not as often on the page as in {LIST}; python -m benchmarks.page_numbers writes it"
    elif wrong := sorted(set(listed.get("published", ())) - published):
        yield f"{page}: {wrong[0]} is in no published row or set any more; correct the page, then run python -m benchmarks.page_numbers"
    elif page.name not in SETTINGS and not is_marked(text) and (wrong := sorted(found.keys() - published)):
        yield f"{page}: {wrong[0]} is in no published row or set; say at the head of the page that figures were {MARK!r}"


def _results_on(page: Path, text: str) -> list[Number]:
    settings = _SETTINGS_ON.get(page.name, set())
    return [number for number in numbers_in(text) if number not in settings]


def _known(docs: Path, rows: Iterable[Mapping[str, Any]]) -> set[Number]:
    return {*_of_rows(rows), *_of_sets(docs / "results")}


def _pages(docs: Path) -> Iterator[Path]:
    for page in [docs.parent / "README.md", *sorted(docs.glob("*.md"))]:
        if page.name not in _GENERATED and page.exists():
            yield page


def is_marked(text: str) -> bool:
    """Whether a page says at its head that figures were measured once."""
    return MARK in " ".join(text.splitlines()[:_HEAD_LINES])


def numbers_in(text: str) -> Iterator[Number]:
    """Numbers of a text with their units, code and links left out."""
    for number, unit in _NUMBER.findall(_CODE.sub(" ", text)):
        yield number.replace(",", ""), unit.replace("×", "x")  # noqa: RUF001


def _of_rows(rows: Iterable[Mapping[str, Any]]) -> Iterator[Number]:
    """Numbers of the ledger as a page may write them: rounded values, and those in targets and notes."""
    for row in rows:
        yield from numbers_in(f"{row['target']}; {row['note']}; {row['value']} {row['unit']}")
        unit = row["unit"].split(" ")[0]
        if isinstance(row["value"], int | float):
            yield from _rounded(row["value"], unit)


def _of_sets(published: Path) -> Iterator[Number]:
    """Lengths and shares of the published sets."""
    for file in sorted(published.glob("*/set/set.json")):
        data = read_json(file)
        for row in (row for part in ("rows", "primary", "contrasts", "claims") for row in data.get(part, ())):
            for key, value in row.items():
                if key.endswith("_m") and value is not None:
                    yield from _rounded(value, "m")
                elif key.endswith("_share"):
                    yield from _rounded(100.0 * value, "%")


def _rounded(value: float, unit: str) -> Iterator[Number]:
    return ((f"{value:.{decimals}f}", unit) for decimals in _DECIMALS)


def main() -> None:
    """Write the list of numbers."""
    from benchmarks.results import REPOSITORY, read_rows

    docs = REPOSITORY / "docs"
    write_list(docs, read_rows())
    print(docs / LIST)


if __name__ == "__main__":
    main()
