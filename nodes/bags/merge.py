"""Merges the messages of several files in order of time. A file is opened only when its first message is due."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class MergeSource(Generic[T]):
    """The messages of one file.

    Attributes:
        start_ns: Lower bound of the times of its messages [ns since 1970].
        open: Opens the file and yields its messages in order of time.
    """

    start_ns: int
    open: Callable[[], Iterator[T]]


def merge_by_time(sources: Sequence[MergeSource[T]], time_ns: Callable[[T], int]) -> Iterator[T]:
    """Yield all messages in order of time. Of two with the same time, the earlier source's comes first.

    Args:
        sources: The files, in the order of their recording.
        time_ns: Returns the time of a message [ns since 1970].
    """
    if len(sources) == 1:
        yield from sources[0].open()
        return
    closed = sorted(range(len(sources)), key=lambda number: (sources[number].start_ns, number), reverse=True)
    # The numbers are unique, so that neither messages nor iterators are compared.
    waiting: list[tuple[int, int, T, Iterator[T]]] = []
    while waiting or closed:
        while closed and (not waiting or sources[closed[-1]].start_ns <= waiting[0][0]):
            number = closed.pop()
            _wait(waiting, number, sources[number].open(), time_ns)
        if waiting:
            _, number, message, rest = heappop(waiting)
            yield message
            _wait(waiting, number, rest, time_ns)


def _wait(
    waiting: list[tuple[int, int, T, Iterator[T]]],
    number: int,
    messages: Iterator[T],
    time_ns: Callable[[T], int],
) -> None:
    for message in messages:
        heappush(waiting, (time_ns(message), number, message, messages))
        return
