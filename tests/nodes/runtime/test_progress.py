import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from nodes.runtime import progress, terminal
from nodes.runtime.progress import ProgressDisplay
from nodes.runtime.terminal import coloured, print_table, table

pytestmark = pytest.mark.live


@pytest.fixture
def moments(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_a_line_now_and_then_with_the_time_left(moments):
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=False)) as display:
        report = display.start("scene")
        moments[0] = 1.0
        report(0.05, "step 5")
        moments[0] = 20.0
        report(0.25, "step 25")
        display.finish("scene", 80.0, cached=False)
        display.finish("policy", 9.0, cached=True)
    assert out.getvalue().splitlines() == [
        "scene: started",
        "scene: 25 % step 25, about 60 s left",
        "scene: done in 80.0 s",
        "policy: unchanged, reused",
    ]


def test_a_terminal_gets_a_bar_that_fills():
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=True, width=120)) as display:
        report = display.start("scene")
        report(0.5, "step 1")
        report(1.5, "step 2")
    assert "100 %" in out.getvalue()
    assert "step 2" in out.getvalue()


@pytest.mark.parametrize("terminal", [False, True])
def test_brackets_are_no_markup(terminal, moments):
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=terminal, width=120, no_color=True)) as display:
        report = display.start("bake")
        moments[0] = 20.0
        report(0.25, "cell [m] of /data/[/room]")
    assert "cell [m] of /data/[/room]" in out.getvalue()


def test_tables_show_what_is_in_brackets(capsys):
    rows = table("x [m]", "state")
    rows.add_row("of [/room]", coloured("[met]", "green"))
    print_table(rows)
    assert capsys.readouterr().out.split() == ["x", "[m]", "state", "of", "[/room]", "[met]"]


def test_the_name_of_a_class_is_no_emoji(capsys):
    rows = table("error")
    rows.add_row("my.py:Robot: failed")
    print_table(rows)
    with ProgressDisplay() as display:
        display.start("my.py:Robot: failed")
    assert capsys.readouterr().out.count("my.py:Robot: failed") == 2


def test_every_console_prints_texts_as_they_are():
    nodes = Path(terminal.__file__).parents[1]
    made = {file.name for file in nodes.rglob("*.py") if re.search(r"\bConsole\((?!quiet)", file.read_text())}
    assert made == {"console.py"}


def test_no_command_escapes_what_tables_print_as_it_is():
    """`print_table` reads no markup, so that an escape would be shown. Help alone is escaped, in one place."""
    nodes = Path(terminal.__file__).parents[1]
    escaping = [
        file.name
        for file in nodes.rglob("*.py")
        if re.search(r"""["']\[["'], r?["']\\{1,2}\[["']""", file.read_text())
    ]
    assert escaping == []
    assert re.search(r"""["']\[["'], r?["']\\{1,2}\[["']""", 'text.replace("[", r"\\[")'), "it would be found"
