"""Questions that have no default: asked once in a terminal; without one, the error names the option that answers them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import typer

from advnerf_core.errors import AdvnerfError

T = TypeVar("T", str, float)


class UnansweredError(AdvnerfError):
    """A question has no default, and no user can be asked."""


def answer(given: T | None, option: str, question: str, kind: Callable[[str], T]) -> T:
    """The value of an option, or else the answer of a user at the terminal, converted by ``kind``.

    Raises:
        UnansweredError: The option was left out, and there is no terminal.
    """
    if given is not None:
        return given
    if not sys.stdin.isatty():
        raise UnansweredError(f"expected {option}, as no terminal can be asked: {question}")
    found: T = typer.prompt(f"{question} ({option})", type=kind)
    return found
