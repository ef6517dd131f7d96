"""The experiment file: which world, what is captured, learned, attacked and deployed, in its settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from advnerf_core.attack.objectives import CTE
from advnerf_core.plugins import name_in_results
from advnerf_core.policies.architecture import PILOTNET, Architecture, require_architecture
from advnerf_core.report.conditions import CONTROLS, EMPTY
from advnerf_core.report.evidence.registration import Contrast
from advnerf_core.scene.gate_limits import GateLimits
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.deploy_config import DeployConfig
from nodes.experiment.plan.method_names import ArchitectureReference, ObjectiveReference
from nodes.experiment.plan.object_kinds import OBJECT_SUFFIX, PANEL, name_of
from nodes.experiment.plan.over import OverConfig
from nodes.experiment.plan.placed import PlacedObject, WantedObject
from nodes.experiment.plan.robustness_config import RobustnessConfig
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    FaceConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
    SpaceConfig,
)
from nodes.experiment.plan.victims import (
    HARDENED,
    NAIVE,
    RETRAINED,
    TRAINED,
    TRAINED_PLAIN,
    TrainedVictim,
    VictimConfig,
    VictimName,
)

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
PositiveNumber = Annotated[float, Field(gt=0)]
# Fields of the section policy that make the network; its description stands for them in keys.
NETWORK = {"architecture", "configuration", "hidden"}
Unit = Annotated[float, Field(ge=0, le=1)]


class CaptureConfig(StrictModel):
    """How the world is photographed."""

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
    seed: int = 0


class SceneConfig(StrictModel):
    """How the radiance field is trained; the length is in steps, so that the result does not depend on the machine."""

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
    margin_m: Annotated[float, Field(ge=0)] = Field(
        default=0.5,
        description="The learned box reaches so far beyond the world's, if that is not contracted [m].",
    )
    near_m: PositiveNumber = Field(default=0.3, description="Nothing stands nearer to the cameras [m].")
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
    seed: int = 0


class ViewConfig(StrictModel):
    """What the policy sees of the driving camera: a window of its image, resized to 200 x 66; the default fits 336 x 188."""

    crop_top_px: Count = Field(default=24, description="First row that is kept.")
    crop_height_px: Positive = Field(default=111, description="Number of rows that are kept.")
    crop_left_px: Count = Field(default=0, description="First column that is kept.")
    crop_width_px: Positive | None = Field(
        default=None, description="Number of columns that are kept; none: all to the right edge."
    )


class PolicyConfig(StrictModel):
    """How the goal-conditioned policy is trained: frames per path and domain, rounds, optimiser steps."""

    stiffness_1pm: PositiveNumber = Field(
        default=0.2, description="How firmly the expert returns to the path [1/m]; see ExpertConfig."
    )
    feed_forward: Annotated[float, Field(ge=0, le=1)] = Field(
        default=1.0, description="Share of the path's curvature that the expert steers ahead."
    )
    delay_s: Annotated[float, Field(ge=0)] = Field(
        default=0.1,
        description="What the expert looks ahead by: half a tick and part of the deployed car's lag [s].",
    )
    smoothing_m: PositiveNumber | None = Field(
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
    stills_heading_rad: PositiveNumber = Field(
        default=0.3, description="Stills are turned up to this much from the path [rad]."
    )
    drives_heading_rad: PositiveNumber = Field(
        default=0.12, description="DAgger drives start turned up to this much [rad]."
    )
    own_car: bool = Field(
        default=False,
        description="Drives in the deployment scene are those of its own car, with its lag, one after another; else the surrogate's.",
    )
    panels: Literal["composed", "native"] = Field(
        default="composed",
        description="How frames of the deployment scene show panels, as deploy.panels; all deployments share the victim.",
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
    seed: int = 0

    @model_validator(mode="after")
    def _fits_the_architecture(self) -> PolicyConfig:
        if self.architecture == PILOTNET and self.configuration:
            raise ValueError(
                f"expected no policy.configuration with the architecture pilotnet, got {', '.join(self.configuration)}; set policy.hidden"
            )
        require_architecture(self.architecture, None, self.configuration)
        return self

    @property
    def network(self) -> Architecture:
        """The architecture with its settings."""
        own = {"hidden": self.hidden} if self.architecture == PILOTNET else self.configuration
        return Architecture(self.architecture, own)

    @property
    def recipe(self) -> dict[str, Any]:
        """How a policy is trained, as JSON data: of a user's architecture its code, not the place of its file."""
        return self.model_dump(mode="json", exclude=NETWORK) | self.network.described()


class ObjectConfig(StrictModel):
    """How the objects are made; where they stand is the section objects."""

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
    panel_light: Literal["ideal", "measured"] = Field(
        default="ideal",
        description="How the learned scene shows a panel: in its own colours, or as the driving camera saw plain colours on it while the world was photographed.",
    )


class MeasureConfig(StrictModel):
    """From where finished attacks are measured, in both domains: the same starts for all methods and seeds."""

    starts: Positive = Field(default=5, description="Starts, none of which a search had.")
    seed: int = Field(default=10_000, description="Of the starts.")


class AttackConfig(StrictModel):
    """The adversary, and what it may spend: all methods evaluate equally often."""

    objective: ObjectiveReference = Field(
        default=CTE,
        description="What is maximised: cte, peak, time_off_track, collision, or file.py:Class, relative to the experiment file.",
    )
    starts: Positive = Field(
        default=1, description="Start poses optimised together; the first of seed 0 is the nominal one."
    )
    nominal_start: bool = Field(
        default=False, description="The first start of every seed is the nominal one, not of seed 0 alone."
    )
    start_sigma: Annotated[float, Field(ge=0)] = Field(
        default=0.1, description="Spread of starts [m and rad]; headings a quarter of it."
    )
    evaluations: Positive = Field(default=50, description="Closed-loop evaluations of each search.")
    horizon: Positive | None = Field(
        default=None,
        description="Control ticks of the drives that are optimised; none: all that are measured.",
    )
    learning_rate: PositiveNumber = 0.1
    random_sigma: PositiveNumber = Field(default=5.0, description="Spread of the random textures' theta.")
    cem_population: Annotated[int, Field(ge=4)] = Field(default=10, description="Candidates of a generation.")
    robustness: RobustnessConfig = Field(
        default=RobustnessConfig(),
        description="What the attacks shall bear, in expectation.",
    )
    time_batch: Positive = Field(default=16, description="Frames per gradient batch.")
    cache_mib: Annotated[float, Field(ge=0)] = Field(
        default=512.0, description="Budget of the frame cache [MiB]."
    )


class RetrainConfig(StrictModel):
    """The defence: how often the victim answers the attack, and what it learns from."""

    rounds: Positive = Field(default=1, description="Rounds of attack and retraining, at most.")
    pays_ratio: PositiveNumber = Field(
        default=1.5,
        description="The loop ends when no attack's total CTE in the surrogate is this many times that of none.",
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
    seed: int = 0


class ExperimentConfig(StrictModel):
    """One experiment, resolved: the file's values, one of its settings over them, then the command line."""

    @model_validator(mode="after")
    def _different_names(self) -> ExperimentConfig:
        for what, names in (
            ("paths", self.paths),
            ("names of objects", [each.name for each in self.objects]),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"expected different {what}, got {', '.join(names)}")
        kinds = {each.kind for each in self.objects}
        if len({name_of(kind).partition(".")[0] for kind in kinds}) != len(kinds):
            raise ValueError(
                f"expected files of different names as kinds of objects, got {', '.join(sorted(kinds))}"
            )
        return self

    @model_validator(mode="after")
    def _goes_over_keys(self) -> ExperimentConfig:
        known, axes = type(self).model_fields, self.over.model_extra or {}
        if unknown := [key for key in axes if key.partition(".")[0] not in known]:
            raise ValueError(
                f"over: expected {', '.join(OverConfig.model_fields)}, or keys of the experiment such as attack.evaluations, got {unknown[0]}"
            )
        return self

    @model_validator(mode="after")
    def _victims_there_can_be(self) -> ExperimentConfig:
        if RETRAINED in self.victims:
            raise ValueError(
                f"victims: expected other names than {RETRAINED}, which the section retrain makes, got it"
            )
        trained = {name: each for name, each in self.victims.items() if isinstance(each, TrainedVictim)}
        if len({each.train.textures for each in trained.values()}) != len(trained):
            raise ValueError(
                f"victims: expected one victim for each way of training, got {', '.join(trained)}, of which two would be the same policy"
            )
        if TRAINED_PLAIN in trained.values() and not self.policy.naive_steps:
            raise ValueError(
                "expected policy.naive_steps of at least 1 with a victim of train.textures none, got 0"
            )
        if self.retrain is not None and self.attacked[self.main_victim] != TRAINED:
            raise ValueError(
                f"expected the first of victims to be trained here with random textures where retrain is, got {self.main_victim}"
            )
        return self

    @model_validator(mode="after")
    def _retraining_needs_the_gradient(self) -> ExperimentConfig:
        if self.retrain is not None and "gradient" not in self.methods:
            raise ValueError(
                f"expected gradient among over.method, as retrain learns from what it finds, got {', '.join(self.methods)}"
            )
        return self

    @model_validator(mode="after")
    def _a_face_stands_alone(self) -> ExperimentConfig:
        if isinstance(self.space, FaceConfig):
            if self.objects:
                raise ValueError(
                    f"expected no objects where a panel carries the attack (space.kind face), got {', '.join(each.name for each in self.objects)}"
                )
            if self.retrain is not None:
                raise ValueError(
                    "expected retrain only where objects are attacked, got it with space.kind face"
                )
            if EMPTY in self.conditions:
                raise ValueError(
                    "expected the control empty in over.method only where objects are attacked, got it with space.kind face, whose panel was "
                    "photographed with its scene; set deploy.empty_scene instead"
                )
        elif self.deploy.live:
            raise ValueError(
                f"expected space.kind face, which the live nodes can show, with deploy.through nodes, got {self.space.kind}"
            )
        return self

    @model_validator(mode="after")
    def _panels_are_panels(self) -> ExperimentConfig:
        others = [each.name for each in self.objects if each.kind != PANEL]
        for section in ("deploy", "policy"):
            if getattr(self, section).panels == "native" and (others or not self.objects):
                raise ValueError(
                    f"expected objects of kind panel alone with {section}.panels native, got {', '.join(others) or 'none'}"
                )
        policy = self.policy
        if policy.panels == "native" and policy.own_car and policy.naive_steps:
            raise ValueError(
                "expected policy.naive_steps 0 or policy.own_car off with policy.panels native, got "
                f"{policy.naive_steps} and on: the world shows what was last put on a panel, so that the naive victim would learn from random textures"
            )
        if isinstance(self.space, (MeshTextureConfig, MeshShapeConfig)) and len(others) < len(self.objects):
            raise ValueError(f"expected objects with a mesh with space.kind {self.space.kind}, got a panel")
        if isinstance(self.space, (MeshTextureConfig, MeshShapeConfig)) and any(
            each.kind.endswith(OBJECT_SUFFIX) for each in self.objects
        ):
            raise ValueError(
                f"expected objects with a mesh with space.kind {self.space.kind}, got voxels (*{OBJECT_SUFFIX}); name the mesh itself (.glb)"
            )
        return self

    @model_validator(mode="after")
    def _searches_where_it_deploys(self) -> ExperimentConfig:
        if self.deploy.world is not None and isinstance(
            self.space, (FaceConfig, MeshTextureConfig, MeshShapeConfig)
        ):
            raise ValueError(
                f"expected space.kind colours or places with deploy.world, got {self.space.kind}, which is bound to the world that was captured"
            )
        return self

    @model_validator(mode="after")
    def _learns_past_objects_with_a_rule(self) -> ExperimentConfig:
        policy = self.policy
        by_hand = [each.name for each in self.objects if isinstance(each, PlacedObject)]
        if policy.learns_in and (by_hand or not self.objects or policy.own_car):
            raise ValueError(
                "expected objects that all stand by a rule (stands), and policy.own_car off, with policy.learns_in; got "
                f"{', '.join(by_hand) or f'{len(self.objects)} objects'} placed by hand, own_car {policy.own_car}"
            )
        return self

    @model_validator(mode="after")
    def _light_falls_on_panels(self) -> ExperimentConfig:
        if self.object.panel_light == "ideal":
            return self
        if len(self.objects) != 1 or self.policy.panels != "native" or self.retrain is not None:
            raise ValueError(
                "expected one panel, policy.panels native and no retrain with object.panel_light measured, got "
                f"{len(self.objects)} objects, policy.panels {self.policy.panels}{'' if self.retrain is None else ' and retrain'}"
            )
        return self

    @model_validator(mode="after")
    def _smooths_colours_only(self) -> ExperimentConfig:
        if self.attack.robustness.smoothness and isinstance(self.space, (PlacesConfig, MeshShapeConfig)):
            raise ValueError(
                f"expected attack.robustness.smoothness only where colours are searched, got it with space.kind {self.space.kind}"
            )
        return self

    @model_validator(mode="after")
    def _measures_from_starts_of_its_own(self) -> ExperimentConfig:
        if self.measure.seed in self.seeds:
            raise ValueError(
                f"expected measure.seed to be none of over.seed, as no search may have the starts that are measured, got {self.measure.seed}"
            )
        return self

    @model_validator(mode="after")
    def _searches_what_is_measured(self) -> ExperimentConfig:
        if self.attack.horizon is not None and self.attack.horizon > self.horizon:
            raise ValueError(
                f"expected attack.horizon to be at most horizon = {self.horizon} ticks, which are measured, got {self.attack.horizon}"
            )
        return self

    @model_validator(mode="after")
    def _training_drives_last(self) -> ExperimentConfig:
        """Fine ticks with the default number of them would train on drives that end before the junction."""
        policy, asked = self.policy, {}
        if policy.dagger_rounds and (policy.deployed_drives or policy.surrogate_drives):
            asked["policy.drive_steps"] = policy.drive_steps
        if policy.driven_m is None:  # of a closed path every part is passed
            asked = {}
        if self.retrain is not None:
            asked["retrain.drive_steps"] = self.retrain.drive_steps
        for key, ticks in asked.items():
            if 2 * ticks < self.horizon:
                raise ValueError(
                    f"expected {key} to be at least half of horizon = {self.horizon} ticks, so that what is learned from passes the "
                    f"junction too, got {ticks} ticks of dt_s = {self.dt_s:g} s, {ticks * self.dt_s:g} s; set {key}={self.horizon}"
                )
        return self

    name: str = Field(min_length=1)
    world: dict[str, Any] = Field(
        description="kind: junction, carla, an installed package's, or file.py:Class relative to this file; and changes of that world's Config."
    )
    paths: tuple[str, ...] = Field(min_length=1, description="Which of the world's paths are driven.")
    objects: tuple[WantedObject, ...] = Field(
        default=(),
        description="Where the objects of the attack stand, or by which rule (stands); not part of the world.",
    )
    horizon: Positive = Field(default=60, description="Control ticks of every drive (T).")
    dt_s: PositiveNumber = Field(
        default=0.1,
        description="Control tick [s]; the paper's CARLA runs have finer ones: docs/intersection_experiment.md.",
    )
    held_cap_m: PositiveNumber = Field(
        default=6.0, description="Largest |CTE| that a stopped car is charged per tick [m]."
    )
    capture: CaptureConfig = CaptureConfig()
    scene: SceneConfig = SceneConfig()
    view: ViewConfig = ViewConfig()
    victims: dict[VictimName, VictimConfig] = Field(
        default={},
        description="Which policies are attacked, the main one first: mine: {policy: FILE, package.module:factory or grpc://HOST:PORT}, or "
        "NAME: {train: {textures: random}}, which the section policy trains. None: hardened and, with policy.naive_steps, naive, trained "
        "with and without random textures.",
    )
    policy: PolicyConfig = PolicyConfig()
    object: ObjectConfig = ObjectConfig()
    attack: AttackConfig = AttackConfig()
    measure: MeasureConfig = MeasureConfig()
    space: SpaceConfig = Field(
        default=ColoursConfig(kind="colours"), description="What the attacks may change."
    )
    deploy: DeployConfig = DeployConfig()
    gate: Literal["steering"] | GateLimits | None = Field(
        default="steering",
        description="What the learned scene must reach before it is attacked: that the policy steers in it as on real pictures, or "
        "limits of your own; null: it is not judged.",
    )
    reference: Path | None = Field(
        default=None, description="File of what the report is held to, relative to this file; none: nothing."
    )
    over: OverConfig = Field(
        default=OverConfig(),
        description="What the cells are made of: variants, paths, victims, methods and seeds.",
    )
    contrasts: tuple[Contrast, ...] = Field(
        default=(),
        description="What the same attacks in two variants tell apart; they must be searched alike.",
    )
    run_folder: Path | None = Field(
        default=None,
        description="Where results go, relative to the working folder; none: runs/SETTING, or runs/NAME for a file without settings. A "
        "variant with another one has stages of its own there.",
    )
    retrain: RetrainConfig | None = Field(
        default=None, description="Retrain the hardened victim on what was found; none: not."
    )

    @property
    def attacked(self) -> dict[str, VictimConfig]:
        """The policies that are attacked by name, the main one first; the retrained one is not among them."""
        if self.victims:
            return self.victims
        trained: dict[str, VictimConfig] = {HARDENED: TRAINED}
        if self.policy.naive_steps:
            trained[NAIVE] = TRAINED_PLAIN
        return trained

    @property
    def cell_paths(self) -> tuple[str, ...]:
        """The paths that cells drive; all are photographed and learned."""
        return self.over.path or self.paths

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the searches."""
        return self.over.seed

    @property
    def conditions(self) -> tuple[str, ...]:
        """Controls and methods of attack that a victim meets."""
        return self.over.method

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods of attack, as `advnerf_core.attack.methods.load_method` takes them."""
        return tuple(each for each in self.conditions if each not in CONTROLS)

    @property
    def method_names(self) -> tuple[str, ...]:
        """What the methods are called in tables and file names."""
        return tuple(map(name_in_results, self.methods))

    @property
    def main_victim(self) -> str:
        """The victim that reports open with, and that is retrained."""
        return next(iter(self.attacked))

    @property
    def trains(self) -> bool:
        """Whether a victim is trained here."""
        return any(isinstance(each, TrainedVictim) for each in self.attacked.values())
