"""Commands as a user gives them."""

import sys

import pytest

from nodes.cli.main import main


def advnerf(monkeypatch: pytest.MonkeyPatch, *words: str) -> object:
    """The exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["advnerf", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code
