"""The only reader of CSV tables: strict, and every error names its file and line."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.documents import is_real, raise_problems, read_text
from advnerf_core.errors import ConfigError


@dataclass(frozen=True)
class CsvRow:
    """One row of a CSV file.

    Attributes:
        place: ``file:line`` for error messages.
        values: Text by column.
    """

    place: str
    values: dict[str, str]

    def number(self, column: str, default: float | None = None) -> float:
        """Finite number in a column.

        Args:
            default: Value if the file lacks the column, or the row leaves it empty; None if that is an error.
        """
        text = self.values.get(column, "").strip()
        if not text and default is not None:
            return default
        value = float(text) if is_real(text) else math.nan
        if not math.isfinite(value):
            has_comma = "," in text and is_real(text.replace(",", ".", 1))
            advice = "; write a decimal point" if has_comma else "; correct the row"
            raise ConfigError(f"{self.place}: {column}: expected a number, got {text!r:.60}{advice}")
        return value


def read_csv(
    path: Path, columns: Sequence[str] = (), bare: Sequence[str] = (), cure: str = "correct the header"
) -> list[CsvRow]:
    """Rows of a CSV file whose header has some columns. Rows whose length differs from the header's are refused.

    Args:
        columns: Columns that the header must have.
        bare: Columns of a file without a header: one whose first row has this length, and a number in the last field.
        cure: What to do about a header without these columns.
    """
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    rows: list[CsvRow] = []
    problems: list[str] = []
    names: list[str] = []
    began = 1
    try:
        first = next(reader, [])
        is_bare = bool(bare) and len(first) == len(bare) and is_real(first[-1].strip())
        names = list(bare) if is_bare else [name.strip() for name in first]
        _require_commas(path, names, columns)
        raise_problems(_header_problems(path, names, columns, cure))
        began = reader.line_num + 1
        for values in itertools.chain([first] if is_bare else [], reader):
            place = f"{path}:{reader.line_num}"
            if len(values) not in (0, len(names)):
                problems.append(
                    f"{place}: expected {len(names)} fields as in the header, got {len(values)}; "
                    "write numbers with a decimal point, and put text with commas in quotes"
                )
            elif values:
                rows.append(CsvRow(place, dict(zip(names, values, strict=True))))
            began = reader.line_num + 1
    except csv.Error as error:
        problems.append(
            f"{path}:{began}: expected valid CSV: {error}; close each quote at the end of its field, or remove it"
        )
    is_remark = len(names) == 1 or "".join(names).startswith("#")
    if is_remark and not rows and len(problems) > 1:
        raise ConfigError(
            f"{path}:1: expected a header of as many fields as the rows have, got {', '.join(names):.80}; remove the lines before the header"
        )
    raise_problems(problems)
    return rows


def _require_commas(path: Path, names: Sequence[str], columns: Sequence[str]) -> None:
    """Raise for one column that holds other separators, once instead of for each row."""
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        raise ConfigError(
            f"{path}:1: expected columns {', '.join(columns) or 'with commas between them'}, got {names[0]}; "
            "separate the columns by commas, and write numbers with a decimal point"
        )


def _header_problems(path: Path, names: list[str], columns: Sequence[str], cure: str) -> list[str]:
    problems = [
        f"{path}:1: the column {name} is given twice; rename or remove one of them"
        for name in sorted({name for name in names if name and names.count(name) > 1})
    ]
    if any(column not in names for column in columns):
        got = ", ".join(names) or "an empty file"
        problems.append(f"{path}:1: expected columns {', '.join(columns)}, got {got}; {cure}")
    return problems
