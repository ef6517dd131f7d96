"""Settings of a scene training: the options of ``advnerf scene train``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from advnerf_core.places import require_utf8
from nodes.runtime.errors import ConfigError

Corner = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="X Y Z", help="Corner of the scene box, in the unit of the file."),
]
_DEFAULT_STEPS = 1000


@dataclass(frozen=True)
class TrainingRequest:
    """Settings of a scene training; the help of each option describes it."""

    transforms: Annotated[Path, typer.Argument(help="A transforms.json, or its folder.", exists=True)]
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the results. A stopped training resumes there.")
    ]
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Steps of the optimiser.",
            show_default="1000 without --minutes; presets with a time: none",
        ),
    ] = None
    minutes: Annotated[
        float | None, typer.Option(min=0.01, help="Train for this many minutes instead of --steps.")
    ] = None
    box_low: Corner = None
    box_high: Corner = None
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="WIDTH HEIGHT",
            help="Resize the images to this width and height.",
            show_default="their size",
        ),
    ] = None
    open_scene: Annotated[bool, typer.Option("--open", help="Outdoor scene: rays may leave the box.")] = False
    every: Annotated[int, typer.Option(min=2, help="Every N-th image is held out.")] = 8
    near: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Learn nothing closer to a camera than this, in the unit of the file.",
            show_default="1/80 of the box's longest side",
        ),
    ] = None
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0
    checkpoint_every_s: Annotated[
        float,
        typer.Option(
            "--checkpoint-every",
            min=0.0,
            help="Time between checkpoints; the most training that a kill loses [s].",
        ),
    ] = 30.0
    unbounded: Annotated[
        bool | None,
        typer.Option(
            "--unbounded/--bounded",
            help="Also learn the scene outside the box, to the horizon, with detail that decreases with distance.",
            show_default="unbounded if aabb_scale in the file is more than 1, or the file has no box",
        ),
    ] = None
    preset: Annotated[
        str,
        typer.Option(
            help="room: for rooms and for training on a CPU (8 levels of 4 features, 2^17 entries, view-independent colours unless "
            "--open or --unbounded). instant-ngp: default sizes of instant-ngp (16 levels of 2 features, 2^19 entries, finest "
            "2048 x aabb_scale, directions to degree 4), for detail and comparisons; slower. minutes, best: for photographs of "
            "any place, sizes and training for 3 and 10 minutes on two cores (view-dependent colours); --minutes changes the time."
        ),
    ] = "room"
    interval_px: Annotated[
        float | None,
        typer.Option(
            help="Length of a sample interval in image pixels. Smaller values are finer and slower.",
            show_default="4; 1.5 if all cameras stand outside the box",
        ),
    ] = None
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure",
            help="Learn a gain per channel for each photograph, for cameras that choose exposure and white balance themselves.",
        ),
    ] = False

    def __post_init__(self) -> None:
        """Check the settings."""
        from advnerf_core.scene.presets import PRESETS as SCENE_PRESETS

        require_utf8(self.output.absolute())
        if self.steps is not None and self.minutes is not None:
            raise ConfigError("expected either --steps or --minutes; give exactly one of them")
        if (self.box_low is None) != (self.box_high is None):
            raise ConfigError("expected both --box-low and --box-high or neither, got one; add the other")
        if self.box_m is not None and not all(low < high for low, high in zip(*self.box_m, strict=True)):
            raise ConfigError(f"expected a box with low < high, got {self.box_m}")
        presets = ("room", "instant-ngp", *SCENE_PRESETS)
        if self.preset not in presets:
            raise ConfigError(f"expected a preset of {', '.join(presets)}, got {self.preset!r}")
        if self.interval_px is not None and not self.interval_px > 0.0:
            raise ConfigError(f"expected --interval-px above 0, got {self.interval_px}")

    @property
    def box_m(self) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
        """Low and high corner of the scene box, in the data set's unit; None uses Instant-NGP's box of the file."""
        return None if self.box_low is None or self.box_high is None else (self.box_low, self.box_high)

    @property
    def length(self) -> tuple[int | None, float | None]:
        """Steps and minutes of the training: the given ones, else the preset's minutes, else 1000 steps."""
        from advnerf_core.scene.presets import PRESETS as SCENE_PRESETS

        if self.steps is not None or self.minutes is not None:
            return self.steps, self.minutes
        if self.preset in SCENE_PRESETS:
            return None, SCENE_PRESETS[self.preset].minutes
        return _DEFAULT_STEPS, None
