"""A table of text: made once, for the terminal, the page and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import rich.box
import rich.table
from markupsafe import Markup
from rich.text import Text


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A formatted number; an en dash for None."""
    return "–" if value is None else f"{value:.{digits}f}{unit}"  # noqa: RUF001 (typography for readers)


def count(number_of: int, noun: str) -> str:
    """A count with its noun, such as ``3 drives``."""
    return f"{number_of} {noun}" if number_of == 1 else f"{number_of} {noun}s"


@dataclass(frozen=True)
class Table:
    """A table of text with its output formats.

    Attributes:
        title: Heading in the terminal.
        columns: Column headings.
        rows: Cells, one text per column.
        right: Columns with numbers, aligned right.
        groups: Rows before which a new group starts.
        classes: One CSS class per row, or "" (page only).
        drops_empty: Whether columns that are empty in all rows are left out.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]
    groups: tuple[int, ...] = ()
    classes: tuple[str, ...] = ()
    drops_empty: bool = True

    def __post_init__(self) -> None:
        all_kept = not (self.rows and self.drops_empty)
        kept = [i for i in range(len(self.columns)) if all_kept or any(row[i] for row in self.rows)]
        for name in ("columns", "right"):
            object.__setattr__(self, name, tuple(getattr(self, name)[i] for i in kept))
        object.__setattr__(self, "rows", tuple(tuple(row[i] for i in kept) for row in self.rows))

    def html(self) -> Markup:
        """The table as HTML; every cell is escaped."""
        head = Markup("").join(
            Markup('<th scope="col"{}>{}</th>').format(self._align(i), c) for i, c in enumerate(self.columns)
        )
        body = Markup("").join(self._html_row(i, row) for i, row in enumerate(self.rows))
        return Markup(
            '<div class="scroll"><table><thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>'
        ).format(head, body)

    def _html_row(self, index: int, row: Sequence[str]) -> Markup:
        names = [self.classes[index]] if index < len(self.classes) and self.classes[index] else []
        names += ["group"] if index in self.groups else []
        cells = Markup("").join(
            Markup("<td{}>{}</td>").format(self._align(i), cell) for i, cell in enumerate(row)
        )
        return (
            Markup('<tr class="{}">{}</tr>').format(" ".join(names), cells)
            if names
            else Markup("<tr>{}</tr>").format(cells)
        )

    def _align(self, column: int) -> Markup:
        return Markup(' class="number"') if self.right[column] else Markup("")

    def markdown(self) -> str:
        """The table in Markdown, without its title; ends with a line break."""
        rule = "|" + "|".join("---:" if right else "---" for right in self.right) + "|"
        return "\n".join([_markdown_row(self.columns), rule, *map(_markdown_row, self.rows), ""])

    def rich(self) -> rich.table.Table:
        """The table for the terminal; `Text` keeps rich from parsing units in brackets as markup."""
        table = rich.table.Table(title=self.title or None, box=rich.box.SIMPLE_HEAD, title_justify="left")
        for heading, right in zip(self.columns, self.right, strict=True):
            table.add_column(Text(heading), justify="right" if right else "left")
        for i, row in enumerate(self.rows):
            if i in self.groups and i > 0:
                table.add_section()
            table.add_row(*(Text(cell) for cell in row))
        return table


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
