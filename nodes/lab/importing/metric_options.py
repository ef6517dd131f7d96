"""Facts that a user knows about the world of photographs: options of the commands ``advnerf scene from-...``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from nodes.lab.importing.errors import ImportRecordingError


@dataclass(frozen=True)
class MetricOptions:
    """Known facts about the world; the help of each option describes it. At most one of the first three gives the metre."""

    length: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            help="A known length [m]: between the cameras of two images, or between two of COLMAP's points.",
            metavar="A B METRES",
        ),
    ] = None
    positions: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of known camera positions, in a world with z up: image, x_m, y_m, z_m.",
            exists=True,
            dir_okay=False,
        ),
    ] = None
    marker_m: Annotated[
        float | None, typer.Option("--marker", min=0.001, help="Side of printed markers in the images [m].")
    ] = None
    dictionary: Annotated[str, typer.Option(help="OpenCV's name of the markers.")] = "DICT_APRILTAG_36h11"
    up: Annotated[
        Literal["auto", "ground", "cameras"],
        typer.Option(help="What z is: the ground if it is found, or the cameras' up."),
    ] = "auto"

    @property
    def gives_metre(self) -> bool:
        """Whether an option gives the metre."""
        return bool(self._given)

    @property
    def _given(self) -> list[str]:
        options = {"--length": self.length, "--positions": self.positions, "--marker": self.marker_m}
        return [name for name, value in options.items() if value is not None]

    def __post_init__(self) -> None:
        given = self._given
        if len(given) > 1:
            raise ImportRecordingError(
                f"expected one source of the scale, got {' and '.join(given)}; give one of them"
            )
        if self.length is not None and not self.length[2] > 0.0:
            raise ImportRecordingError(
                f"expected --length A B METRES with a length above 0 m, got {self.length[2]:g}; correct it"
            )
        if self.marker_m is None and self.dictionary != MetricOptions.dictionary:
            raise ImportRecordingError(
                f"expected --dictionary only with --marker, the size of its markers, got {self.dictionary}; add --marker METRES"
            )
