"""Commands as a user gives them."""

import sys

import pytest

from nodes.cli.main import main


def advnerf(monkeypatch: pytest.MonkeyPatch, *words: object) -> object:
    """The exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["advnerf", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code
