"""Facts that a user knows about a splat: options of ``advnerf scene from-splat``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from nodes.lab.importing.errors import ImportRecordingError

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class SplatOptions:
    """Known facts about a splat; the help of each option describes it."""

    images: Annotated[
        Path | None,
        typer.Option(
            help="Data set (of `advnerf scene from-scan`) whose images the splat was trained on: gives metres, up and ground.",
            exists=True,
        ),
    ] = None
    metres_per_unit: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Length of the file's unit [m]: a known length over its length in the file.",
            show_default="1 for .glb",
        ),
    ] = None
    up: Annotated[
        Axis | None,
        typer.Option(
            help="Axis of the file that points up.", show_default="y for .glb and .spz, -y otherwise"
        ),
    ] = None
    origin: Annotated[
        Point | None,
        typer.Option(
            metavar="X Y Z",
            help="Point of the file that becomes the origin, on the ground.",
            show_default="the file's",
        ),
    ] = None
    box_low: Annotated[
        Point | None,
        typer.Option(
            metavar="X Y Z",
            help="Low corner of the scene's box [m].",
            show_default="around nearly all Gaussians",
        ),
    ] = None
    box_high: Annotated[
        Point | None,
        typer.Option(metavar="X Y Z", help="High corner [m].", show_default="around nearly all Gaussians"),
    ] = None
    behind: Annotated[Point, typer.Option(metavar="R G B", help="Colour behind everything, 0..1.")] = (
        0.0,
        0.0,
        0.0,
    )
    keep_floaters: Annotated[
        bool, typer.Option("--keep-floaters", help="Keep Gaussians that are far from all others.")
    ] = False

    def __post_init__(self) -> None:
        """Check the colour."""
        if not all(0.0 <= channel <= 1.0 for channel in self.behind):
            raise ImportRecordingError(
                f"expected --behind as three numbers in 0..1, got {self.behind}; divide values of 0..255 by 255"
            )
