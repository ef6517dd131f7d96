"""The operator's input, in a form common to all devices."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Hands:
    """Input of a device at one time.

    Attributes:
        human: The button that lets the hand drive is held.
        autonomy: The button that lets the software drive is held.
        throttle: -1..1, forward positive.
        steering: -1..1, left positive.
        stops: Number of e-stop presses since the device was opened.
        rearms: Number of re-arm presses since then.
        connected: Whether the device is connected; a lost device holds no button.
        text: Description for people.
    """

    human: bool = False
    autonomy: bool = False
    throttle: float = 0.0
    steering: float = 0.0
    stops: int = 0
    rearms: int = 0
    connected: bool = True
    text: str = ""
