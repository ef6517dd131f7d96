"""Arguments and options that the commands about logs of drives share."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import typer

from advnerf_core.data.logs.choice import LogChoice, LogError, LogRequest


def log_argument(text: str) -> LogRequest:
    """Log of an argument, which must be there."""
    try:
        return LogRequest.parsed(text)
    except LogError as error:
        raise typer.BadParameter(str(error)) from None


_METAVAR = "LOG[,SETTING=VALUE...]"
_HELP = (
    "Log of a drive: a bag, a Donkeycar tub, a CSV file, or a LeRobot data set. Settings, such as steering-full-rad=0.3, "
    "replace the options of the same names for this log."
)
OneLog = Annotated[LogRequest, typer.Argument(metavar=_METAVAR, parser=log_argument, help=_HELP)]
Logs = Annotated[list[LogRequest], typer.Argument(metavar=_METAVAR, parser=log_argument, help=_HELP)]


@dataclass(frozen=True)
class LogOptions:
    """What the format of a log leaves open."""

    images: Annotated[
        str | None,
        typer.Option(
            help="Topic, column, feature or camera of the images.", show_default="the format's first"
        ),
    ] = None
    steering: Annotated[
        str | None,
        typer.Option(help="Topic, column or feature of the steering.", show_default="the format's"),
    ] = None
    steering_full_rad: Annotated[
        float | None,
        typer.Option(
            help="Wheel angle at a recorded steering of 1 [rad]; 1 for a log in radians.",
            show_default="the format's",
        ),
    ] = None
    steering_positive: Annotated[
        Literal["left", "right"] | None,
        typer.Option(help="Side to which positive steering turns.", show_default="the format's"),
    ] = None
    steering_offset_rad: Annotated[
        float | None,
        typer.Option(
            help="Added to the steering, left positive [rad]: what a camera at the side needs.",
            show_default="0",
        ),
    ] = None

    def choice(self) -> LogChoice:
        """The answers about all logs."""
        return LogChoice(**asdict(self))
