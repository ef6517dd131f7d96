# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)
import io

import rich.console

from advnerf_core.report.text_table import Table, count, number


def test_a_table_shows_the_same_text_in_terminal_page_and_markdown():
    table = Table("Results", ("shown", "excess"), (("<a|b>", number(0.3304, 3)),), (False, True))
    terminal = io.StringIO()
    rich.console.Console(file=terminal, width=160).print(table.rich())
    assert "0.330" in terminal.getvalue()
    assert '<td>&lt;a|b&gt;</td><td class="number">0.330</td>' in table.html()
    assert "| <a\\|b> | 0.330 |" in table.markdown()


def test_numbers_and_counts_as_readers_see_them():
    assert (number(None), number(1.0, 1, " m")) == ("–", "1.0 m")
    assert (count(1, "drive"), count(2, "drive")) == ("1 drive", "2 drives")


def test_a_column_that_is_empty_in_all_rows_is_left_out():
    table = Table("", ("a", "b", "c"), (("1", "", ""), ("2", "", "x")), (False, True, True))
    assert (table.columns, table.rows, table.right) == (("a", "c"), (("1", ""), ("2", "x")), (False, True))
    assert Table("", ("a", "b"), (), (False, True)).columns == ("a", "b")
