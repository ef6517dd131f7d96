"""Send a request to a node, and repeat it until the node answers.

A publisher does not know its subscribers: the only one may be a recorder, and the node that the request is for may join later or
be restarted. So every repeat of a request carries the same id, and the node puts that id into its answer.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any, TypeVar

from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import Now, SystemClock
from nodes.runtime.errors import BusError, LaunchError, MessageError
from nodes.runtime.requests import RequestIdentity

T = TypeVar("T")


class NoAnswerError(LaunchError):
    """The node did not answer a request in time."""


def ask(
    bus: Bus,
    topic: str,
    make: Callable[[RequestIdentity, Now], Any],
    answers: str,
    read: Callable[[str, Received], T | None],
    *,
    every_s: float,
    patience_s: float,
) -> T:
    """Publish a request repeatedly until it is answered.

    Args:
        bus: A bus of the calling thread. Messages of its other subscriptions that arrive meanwhile are also passed to `read`.
        make: Makes the message for one repeat from the identity of the request and the time.
        answers: Topic on which the node answers.
        read: Returns the answer if a received message answers this id, else None.
        every_s: Time between two repeats [s].
        patience_s: Time after which `NoAnswerError` is raised [s].

    Raises:
        NoAnswerError: No answer within the patience.
        BusError: Other processes published the topic during the whole time.
    """
    clock = SystemClock()
    bus.subscribe(answers)
    asked = RequestIdentity.at(clock.now())
    began = time.monotonic()
    next_s = began
    taken: BusError | None = None
    while True:
        now_s = time.monotonic()
        if now_s >= next_s:
            next_s, taken = now_s + every_s, None
            try:
                bus.publish(topic, make(asked, clock.now()))
            except BusError as error:
                taken = error  # all endpoints of the topic are in use; one may become free
        bus.wait(max(0.0, next_s - time.monotonic()))
        for received in bus.receive():
            # Invalid bytes must not end a request to stop the car.
            with contextlib.suppress(MessageError):
                if (answer := read(asked.ask_id, received)) is not None:
                    return answer
        if time.monotonic() - began > patience_s:
            raise taken or NoAnswerError(
                f"expected an answer on {answers} to the request on {topic} within {patience_s:g} s, got none"
            )
