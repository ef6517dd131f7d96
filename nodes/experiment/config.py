"""The experiment file: what is captured, learned, attacked and deployed, in two settings (``demo`` and ``full``)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CaptureConfig(_Section):
    """How the room is photographed, by a phone for learning and by the driving camera for comparison."""

    walk_around: Positive = Field(default=140, description="Phone photographs on a walk around the room.")
    car_mounted: Positive = Field(default=120, description="Phone photographs with the phone on the car.")
    colour_pairs: Positive = Field(default=12, description="Driving-camera frames that fit the colour map.")
    held_out: Positive = Field(default=24, description="Driving-camera frames that nothing learns from.")
    seed: int = 0


class SceneConfig(_Section):
    """How the radiance field is trained; the length is in steps, so that the result does not depend on the machine."""

    steps: Positive = Field(default=700, description="Training iterations.")
    margin_m: Annotated[float, Field(ge=0)] = Field(
        default=0.1, description="How far the field's box reaches beyond the walls [m]."
    )
    interval_px: Annotated[float, Field(gt=0)] | None = Field(
        default=None,
        description="Sample intervals in pixels of the policy's view; none: the default of pixel_intervals.",
    )
    seed: int = 0


class PolicyConfig(_Section):
    """How the driving policy is trained: frames per domain, rounds, optimiser steps."""

    stiffness_1pm: Annotated[float, Field(gt=0)] = Field(
        default=0.75, description="How firmly the expert returns to the path [1/m]; see ExpertConfig."
    )
    feed_forward: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.97,
        description="Share of the path's curvature that the expert steers ahead; see ExpertConfig.",
    )
    lab_stills: Positive = Field(
        default=900, description="Lab poses around the path, each seen plain and with random textures."
    )
    surrogate_stills: Positive = Field(default=600, description="The same in the surrogate.")
    lab_drives: Positive = Field(default=6, description="Lab drives of each DAgger round.")
    surrogate_drives: Positive = Field(default=8, description="Surrogate drives of each DAgger round.")
    drive_steps: Positive = Field(default=40, description="Control ticks of a drive.")
    dagger_rounds: Count = Field(default=1, description="Rounds of DAgger.")
    first_steps: Positive = Field(default=350, description="Optimiser steps of behaviour cloning.")
    round_steps: Positive = Field(default=150, description="Optimiser steps after each round.")
    naive_steps: Count = Field(
        default=250, description="Optimiser steps of the victim that never sees a random texture; 0: none."
    )
    seed: int = 0


class ObjectConfig(_Section):
    """The attacked object: one face of a cube, projected where the green board stands or shown on the monitor."""

    target: Literal["board", "monitor"] = Field(
        default="board", description="What carries the face: the board, or the centre square of the monitor."
    )

    resolution: Annotated[int, Field(ge=2, le=128)] = Field(
        default=64, description="Grid cells along each side of the face."
    )
    plain_rgb: tuple[float, float, float] = Field(
        default=(0.25, 0.62, 0.3), description="Colour of the plain object, 0..1."
    )


class AttackConfig(_Section):
    """The adversary, and what it may spend."""

    starts: Positive = Field(
        default=1, description="Start poses optimised together; the first is the nominal one."
    )
    start_sigma: Annotated[float, Field(ge=0)] = Field(
        default=0.1, description="Spread of the other starts [m and rad]."
    )
    horizon: Positive = Field(default=40, description="Control ticks of the rollouts that are optimised (T).")
    iterations: Positive = Field(default=30, description="Gradient iterations.")
    random_evaluations: Positive = Field(default=10, description="Random textures tried.")
    learning_rate: Annotated[float, Field(gt=0)] = 0.1
    random_sigma: Annotated[float, Field(gt=0)] = Field(
        default=5.0, description="Spread of the random textures' theta."
    )
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1, description="One attack per seed.")
    time_batch: Positive = Field(default=16, description="Frames per gradient batch.")
    cache_mib: Annotated[float, Field(ge=0)] = Field(
        default=512.0, description="Budget of the frame cache [MiB]."
    )
    display_model: bool = Field(
        default=True,
        description="On a monitor: search with its measured colours in the loop; false takes it for ideal.",
    )


class DeployConfig(_Section):
    """The live runs through the node graph."""

    launch_file: str = Field(
        default="green_screen.launch.yaml", description="Node graph, beside the experiment file."
    )
    nodes: tuple[str, ...] = Field(
        default=("twin", "camera", "vicon", "compositor", "policy", "safety", "motor", "recorder"),
        description="Nodes that must be ready before the car moves.",
    )
    laps: Count = Field(default=0, description="Laps driven live without attack before the runs.")
    empty_scene: bool = Field(
        default=False, description="Also drive with the board, or the monitor, taken away."
    )
    ready_timeout_s: Annotated[float, Field(gt=0)] = Field(
        default=60.0, description="Time for the graph to become ready [s]."
    )


class ExperimentConfig(_Section):
    """One experiment, resolved: the file's values, one of its settings over them, then the command line."""

    name: str = Field(min_length=1)
    horizon: Positive = Field(
        default=60,
        description="Control ticks over which every drive is measured, learned or live (the protocol's 6 s).",
    )
    lab: dict[str, Any] = Field(default_factory=dict, description="Changes to the simulated lab.")
    capture: CaptureConfig = CaptureConfig()
    scene: SceneConfig = SceneConfig()
    policy: PolicyConfig = PolicyConfig()
    object: ObjectConfig = ObjectConfig()
    attack: AttackConfig = AttackConfig()
    deploy: DeployConfig = DeployConfig()
