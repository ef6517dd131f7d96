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
        stops: How often e-stop was pressed since the device was opened.
        rearms: How often re-arm was pressed.
        connected: Whether the device is there; nothing is held where it is not.
        text: For people.
    """

    human: bool = False
    autonomy: bool = False
    throttle: float = 0.0
    steering: float = 0.0
    stops: int = 0
    rearms: int = 0
    connected: bool = True
    text: str = ""
