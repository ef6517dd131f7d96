"""Errors of a place where nothing can be driven or photographed: attacks are searched in its learned scene."""

from __future__ import annotations

from typing import ClassVar, NoReturn, TypeVar

from hardware.worlds.world import WorldError

T = TypeVar("T")


class Undriven:
    """Driving part of a world that cannot drive: it refuses to, and to take pictures."""

    known_by: ClassVar[str]

    def _refuse(self, *given: object, **named: object) -> NoReturn:
        raise WorldError(
            f"expected a place that can be driven and photographed anew, got one that is known by {self.known_by} alone; attacks are searched "
            "in what is learned from it"
        )

    state = blocked = property(_refuse)
    reset = step = observe = observe_at = photograph = _refuse

    def __enter__(self: T) -> T:
        return self

    def __exit__(self, *raised: object) -> None:
        return
