"""Sections of the experiment file: what is captured, learned, attacked, measured and retrained, in settings."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from advnerf_core.attack.methods import GRADIENT_RATE
from advnerf_core.attack.objectives import CTE
from advnerf_core.policies.architecture import PILOTNET, Architecture, require_architecture
from advnerf_core.strict import Angle, AngularRate, LengthM, RightAngleRad, StrictModel, at_most
from nodes.experiment.plan.method_names import ArchitectureReference, ObjectiveReference
from nodes.experiment.plan.numbers import (
    Count,
    Delay,
    Distance,
    Length,
    NotNegative,
    Positive,
    PositiveNumber,
    Unit,
)

# Fields of the section policy that define the network; its description replaces them in keys.
NETWORK = {"architecture", "configuration", "hidden"}


class CaptureConfig(StrictModel):
    """Photographs of the world."""

    photos: Positive = Field(default=450, description="Posed photographs that the scene is learned from.")
    held_out: Annotated[int, Field(ge=3)] = Field(
        default=36, description="Views of the driving camera along the paths that nothing learns from."
    )
    colour_pairs: Count = Field(
        default=0,
        description="Views of the driving camera that fit a colour map, where photographs have colours of their own.",
    )
    driven_m: PositiveNumber = Field(
        default=36.0,
        description="Views of the driving camera lie so far along each path that does not close [m].",
    )
    seed: Count = 0


class SceneConfig(StrictModel):
    """Training of the radiance field; the length is in steps, so that the result does not depend on the machine."""

    steps: Positive = Field(default=1500, description="Training iterations.")
    levels: Annotated[int, Field(ge=1, le=20)] = Field(default=8, description="Levels of the hash grid.")
    finest: Positive = Field(
        default=2048, description="Cells of its finest level along the box's longest side."
    )
    log2_entries: Annotated[int, Field(ge=10, le=24)] = Field(
        default=18, description="Entries of a level of the hash grid, as a power of two."
    )
    occupancy: Positive = Field(
        default=128, description="Cells of the occupancy grid along the box's longest side."
    )
    refine_depth: PositiveNumber = Field(
        default=0.005, description="Optical depth from which rendering looks into a cell; see TrainConfig."
    )
    margin_m: Distance = Field(
        default=0.5,
        description="The learned box reaches so far beyond the world's, if that is not contracted [m].",
    )
    near_m: Length = Field(default=0.3, description="Nothing stands nearer to the cameras [m].")
    interval_px: PositiveNumber | None = Field(
        default=None,
        description="Sample intervals in pixels of the policy's view; none: the default of pixel_intervals.",
    )
    decay: Literal["exponential", "cosine"] = Field(
        default="cosine",
        description="How the learning rate falls; cosine stays high for longer.",
    )
    learning_rate: PositiveNumber = Field(
        default=0.02,
        description="Learning rate at the start.",
    )
    exposure: bool = Field(
        default=False,
        description="Learn a gain per channel for each photograph; for worlds whose camera chooses its exposure.",
    )
    seed: Count = 0
    bake_unbounded: bool = Field(
        default=False,
        description="Bake the scene too if it extends outside its box, so that searches in it are faster.",
    )


# Whether an unbounded scene is baked. The scene itself does not depend on it.
UNBOUNDED = {"bake_unbounded"}


class ViewConfig(StrictModel):
    """The policy's window of the driving camera's image, resized to 200 x 66; the default fits 336 x 188."""

    crop_top_px: Count = Field(default=24, description="First row that is kept.")
    crop_height_px: Positive = Field(default=111, description="Number of rows that are kept.")
    crop_left_px: Count = Field(default=0, description="First column that is kept.")
    crop_width_px: Positive | None = Field(
        default=None, description="Number of columns that are kept; none: all to the right edge."
    )


TextureFamily = Literal["random", "patterns"]


class PolicyConfig(StrictModel):
    """Training of the goal-conditioned policy: frames per path and domain, rounds, optimiser steps."""

    stiffness_1pm: PositiveNumber = Field(
        default=0.2, description="How firmly the expert returns to the path [1/m]; see ExpertConfig."
    )
    feed_forward: Unit = Field(
        default=1.0, description="Share of the path's curvature that the expert steers ahead."
    )
    delay_s: Delay = Field(
        default=0.1,
        description="What the expert looks ahead by: half a tick and part of the deployed car's lag [s].",
    )
    smoothing_m: Length | None = Field(
        default=None,
        description="The expert averages the path's curvature over this [m]; none: the way of one tick.",
    )
    driven_m: PositiveNumber | None = Field(
        default=44.0, description="Frames are taken so far along each path [m]; none: all along."
    )
    drives_from_m: PositiveNumber | None = Field(
        default=12.0,
        description="DAgger drives start so far along each path at most, so that they pass the junction [m]; none: anywhere.",
    )
    stills_heading_rad: RightAngleRad = Field(
        default=0.3, gt=0.0, description="Stills are turned up to this much from the path [rad]."
    )
    drives_heading_rad: RightAngleRad = Field(
        default=0.12, gt=0.0, description="DAgger drives start turned up to this much [rad]."
    )
    own_car: bool = Field(
        default=False,
        description="Drives in the deployment scene are those of its own car, with its lag, one after another; else the surrogate's.",
    )
    learns_in: tuple[tuple[str, ...], ...] = Field(
        default=(),
        description="Places that the victim learns in instead of the attacked one and its learned scene: changes of the section world, as --set takes "
        "them, one list per place. deployed_stills and deployed_drives are then those of each place, and half of them show no object.",
    )
    deployed_stills: Count = Field(default=320, description="Poses about each path in the deployment scene.")
    surrogate_stills: Count = Field(default=240, description="The same in the surrogate.")
    deployed_drives: Count = Field(
        default=3, description="Drives on each path in the deployment scene, per DAgger round."
    )
    surrogate_drives: Count = Field(default=3, description="The same in the surrogate.")
    drive_steps: Positive = Field(
        default=60, description="Control ticks of such a drive; finer ticks need more."
    )
    dagger_rounds: Count = Field(default=2, description="Rounds of DAgger.")
    first_steps: Positive = Field(default=800, description="Optimiser steps of behaviour cloning.")
    round_steps: Positive = Field(default=300, description="Optimiser steps after each round.")
    naive_steps: Count = Field(
        default=1400,
        description="Optimiser steps of the victim that never sees a random texture, as many as the hardened one's in all; 0: none.",
    )
    hidden: tuple[int, int, int] = Field(
        default=(200, 100, 20),
        description="Widths of PilotNet's linear layers; other architectures do not read them.",
    )
    architecture: ArchitectureReference = Field(
        default=PILOTNET,
        description="pilotnet, resnet, vit_tiny, an installed package's, or file.py:Class relative to the experiment file.",
    )
    configuration: dict[str, Any] = Field(
        default={},
        description="Settings of the architecture; those of pilotnet are the key hidden.",
    )
    families: tuple[TextureFamily, ...] = Field(
        default=("random",),
        min_length=1,
        description="Random textures that it sees, each of one of these families; baselines are then searches of other ones. patterns are stripes, checks and "
        "areas of one colour, which no search draws.",
    )
    seed: Count = 0

    @model_validator(mode="after")
    def _fits_the_architecture(self) -> PolicyConfig:
        if self.architecture == PILOTNET and self.configuration:
            raise ValueError(
                f"expected no configuration with the architecture pilotnet, got {', '.join(self.configuration)}; set hidden"
            )
        require_architecture(self.architecture, None, self.configuration)
        return self

    @property
    def network(self) -> Architecture:
        """The architecture with its settings."""
        own = {"hidden": self.hidden} if self.architecture == PILOTNET else self.configuration
        return Architecture(self.architecture, own)

    @property
    def learns_from_drives(self) -> bool:
        """Whether it learns from its own drives."""
        return bool(self.dagger_rounds and (self.deployed_drives or self.surrogate_drives))

    @property
    def recipe(self) -> dict[str, Any]:
        """Training settings of a policy, as JSON data; for a user's architecture its code, not the path of its file."""
        return self.model_dump(mode="json", exclude=NETWORK) | self.network.described()


class ObjectConfig(StrictModel):
    """Settings for building the objects; their places are in the section objects."""

    car_resolution: Annotated[int, Field(ge=8, le=128)] = Field(
        default=64, description="Voxels along a car's longest side."
    )
    hydrant_resolution: Annotated[int, Field(ge=8, le=128)] = Field(
        default=48, description="The same of a hydrant."
    )
    mesh_resolution: Annotated[int, Field(ge=8, le=128)] = Field(
        default=48, description="The same of a mesh of your own."
    )
    fit_steps: Count = Field(default=300, description="Steps that refine the voxels on pictures of the mesh.")
    panel_resolution: Annotated[int, Field(ge=2, le=128)] = Field(
        default=64, description="Colours along each edge of a panel."
    )
    panel_rgb: tuple[Unit, Unit, Unit] = Field(
        default=(0.5, 0.5, 0.5),
        description="Colour of a panel without an attack.",
    )


class MeasureConfig(StrictModel):
    """Starts from which finished attacks are measured, in both domains: the same for all methods and seeds."""

    starts: Positive = Field(default=5, description="Starts, none of which a search had.")
    seed: Count = Field(default=10_000, description="Of the starts.")
    scene: Literal["field", "baked"] = Field(
        default="field",
        description="The learned scene of the drives: the field itself, or the baked one that searches use, several times as fast.",
    )


class ResponseConfig(StrictModel):
    """Response of the searched car beyond its calibration; the car needs wheels that steer."""

    delay_s: Delay = Field(default=0.0, description="From image to wheels, fractions of a tick allowed [s].")
    lag_s: Delay = Field(default=0.0, description="Time constant of the steering [s].")
    slew_radps: AngularRate | None = Field(
        default=None, gt=0.0, description="Limit of the wheels' rate [rad/s]; none: no limit."
    )


class RobustnessConfig(StrictModel):
    """Disturbances that the attack must withstand: the loss is an expectation over these, with new draws in every evaluation."""

    noise: Unit = Field(default=0.0, description="Pixel noise, standard deviation in 0..1.")
    gain: Unit = Field(default=0.0, description="Spread of the logarithm of the exposure of a drive.")
    brightness: Unit = Field(default=0.0, description="Spread of a drive's additive brightness, in 0..1.")
    jitter_m: Annotated[float, at_most(1.0, "m", "cm or mm")] = Field(
        default=0.0, ge=0.0, description="Spread of the camera's position in each frame [m]."
    )
    jitter_rad: RightAngleRad = Field(
        default=0.0, ge=0.0, description="Spread of the camera's rotation in each frame [rad]."
    )
    draws: Positive = Field(
        default=1, description="Drives of each start pose per evaluation, each drawn by itself."
    )
    smoothness: NotNegative = Field(
        default=0.0, description="Weight of the texture's total variation in the loss [m per unit of colour]."
    )

    @property
    def spreads(self) -> dict[str, float]:
        """Spreads of all disturbances, as `advnerf_core.attack.robustness.Disturbances` names them."""
        return self.model_dump(exclude={"draws", "smoothness"})

    @property
    def disturbed(self) -> bool:
        """Whether any disturbance is drawn."""
        return any(self.spreads.values())

    @property
    def repeats(self) -> int:
        """Drives of each start pose per evaluation."""
        return self.draws if self.disturbed else 1


class AttackConfig(StrictModel):
    """The adversary, its objective and its budget: all methods evaluate equally often."""

    objective: ObjectiveReference = Field(
        default=CTE,
        description="What is maximised: cte, run_wide, drift_left, drift_right, peak, time_off_track, collision, or file.py:Class, relative to this file.",
    )
    evaluations: Positive = Field(
        default=50, description="Closed-loop evaluations of each search; an iteration of the gradient is one."
    )
    population: Annotated[int, Field(ge=4)] = Field(default=10, description="Candidates of a generation.")
    time_batch: Positive = Field(default=16, description="Frames per gradient batch.")
    cache_mib: NotNegative = Field(
        default=512.0, description="Budget of the frames kept for the gradient [MiB]."
    )
    starts: Positive = Field(
        default=1, description="Start poses optimised together; the first of seed 0 is the nominal one."
    )
    nominal_start: bool = Field(
        default=False, description="The first start of every seed is the nominal one, not of seed 0 alone."
    )
    start_sigma: Distance = Field(
        default=0.1, description="Spread of starts [m and rad]; headings a quarter of it."
    )
    start_poses: tuple[tuple[float, float, Angle], ...] = Field(
        default=(), description="x [m], y [m], yaw [rad] of each start; if given, nothing is drawn."
    )
    goals: tuple[tuple[float, ...], ...] = Field(
        default=(),
        description="What a goal-conditioned policy is told from each start pose; none: what the path says.",
    )
    horizon: Positive | None = Field(
        default=None,
        description="Control ticks of the drives that are optimised; none: all that are measured.",
    )
    response: ResponseConfig = Field(
        default=ResponseConfig(), description="How late and slowly the searched car's wheels obey."
    )
    learning_rate: PositiveNumber = Field(default=GRADIENT_RATE, description="Adam's step along a gradient.")
    random_sigma: PositiveNumber = Field(default=5.0, description="Spread of the random textures' theta.")
    step: PositiveNumber | None = Field(
        default=None,
        description="Step of whichever method searches: if not given, 0.3 for guided, 0.5 for evolution, and learning_rate for gradients.",
    )
    sigma: PositiveNumber | None = Field(
        default=None,
        description="Spread of whichever method searches: if not given, 3 to begin with for cem, 1 for evolution, and random_sigma for random.",
    )
    probes: Positive | None = Field(
        default=None,
        description="Pairs of textures asked about after each drive: 3 for guided, 1 for distilled.",
    )
    warm_pairs: Positive | None = Field(
        default=None, description="Pairs of the first lesson of distilled and guided; 300 if not given."
    )
    options: dict[str, Any] = Field(default={}, description="What the method alone knows.")
    together: bool = Field(
        default=False,
        description="'advnerf attack run' searches all seeds in one batch, not one after the other; gradient only.",
    )
    robustness: RobustnessConfig = Field(
        default=RobustnessConfig(),
        description="What the attacks shall bear, in expectation.",
    )

    @model_validator(mode="after")
    def _a_goal_for_each_start(self) -> AttackConfig:
        count = len(self.start_poses)
        if len(self.goals) not in (0, count):
            raise ValueError(
                f"expected no attack.goals, or one for each of {count} start_poses, got {len(self.goals)}"
            )
        return self


class RetrainConfig(StrictModel):
    """The defence: how often the victim is retrained against the attack, and its training data."""

    rounds: Positive = Field(default=1, description="Rounds of attack and retraining, at most.")
    pays_m: LengthM | None = Field(
        default=None,
        description="The loop ends when no attack's excess |CTE| per tick in the surrogate is above this [m]; none: what counts as no effect, a tenth of "
        "the off-track distance. Below zero, all rounds are run.",
    )
    stills: Positive = Field(
        default=120, description="Poses about each path, per domain, seen plain and with a found texture."
    )
    drives: Positive = Field(
        default=2,
        description="Pairs of the victim's drives on each path, per domain: past plain objects and past a found texture.",
    )
    drive_steps: Positive = Field(
        default=60, description="Control ticks of such a drive; finer ticks need more."
    )
    placements: Count = Field(
        default=0,
        description="Random places of all objects in random colours that the victim also learns from; see poses.py.",
    )
    steps: Positive = Field(default=500, description="Optimiser steps of the fine-tuning.")
    new_share: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.4, description="Share of new frames in the training."
    )
    seed: Count = 0
