"""Commands as a user gives them."""

import sys
from functools import cache

import pytest
from typer.main import get_command

from nodes.cli import main as command_line


@cache
def _declared():
    """All commands; typer declares them again at each call, which takes longer than most commands."""
    return get_command(command_line.app)


def advnerf(monkeypatch: pytest.MonkeyPatch, *words: object) -> object:
    """The exit code of a command."""
    monkeypatch.setattr(command_line, "app", _declared())
    monkeypatch.setattr(sys, "argv", ["advnerf", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    return ended.value.code
