"""The console of commands and stages."""

from __future__ import annotations

from typing import Any

from rich.console import Console


def plain_console(**settings: Any) -> Console:
    """A console that prints texts as they are: a unit such as ``[m]`` is no markup, and ``:Robot:`` in the name of a class no emoji.

    Args:
        settings: Other arguments of `rich.console.Console`.
    """
    return Console(markup=False, emoji=False, **settings)
