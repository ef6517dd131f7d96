"""The experiment file: the world, and what is captured, learned, attacked and deployed, in its settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from advnerf_core.plugins import name_in_results
from advnerf_core.report.conditions import CONTROLS, EMPTY
from advnerf_core.report.evidence.kept_build import BUILD
from advnerf_core.report.evidence.registration import Contrast, PlaceClaim
from advnerf_core.scene.gate_limits import GateLimits
from advnerf_core.strict import StrictModel
from nodes.experiment.plan import rules
from nodes.experiment.plan.carriers import CarrierConfig, ComposedConfig, FaceCarrier
from nodes.experiment.plan.deploy_config import DeployConfig
from nodes.experiment.plan.numbers import Length, Positive, PositiveNumber
from nodes.experiment.plan.over import OverConfig
from nodes.experiment.plan.placed import WantedObject
from nodes.experiment.plan.sections import (
    AttackConfig,
    CaptureConfig,
    MeasureConfig,
    ObjectConfig,
    PolicyConfig,
    RetrainConfig,
    SceneConfig,
    ViewConfig,
)
from nodes.experiment.plan.space_config import ColoursConfig, MapsConfig, SpaceConfig
from nodes.experiment.plan.victims import (
    HARDENED,
    NAIVE,
    RETRAINED,
    TrainedVictim,
    TrainingConfig,
    VictimConfig,
    VictimName,
)

SCENE, POLICY = "scene", "policy"
_LONGEST_NAME = 100  # names of temporary files and of pictures beside a set are longer


def _name_of_a_folder(name: str) -> str:
    """The name, under which results lie in ``runs`` and published ones in ``docs/results``; another folder has no place in it."""
    if "/" in name or "\0" in name or name in (".", ".."):
        raise ValueError(
            "expected a name without /, as it becomes that of a folder; --folder says where results go"
        )
    if name == BUILD or name != name.strip() or not name.isprintable() or len(name.encode()) > _LONGEST_NAME:
        raise ValueError(
            f"expected printed characters, none of them a space at an end, at most {_LONGEST_NAME} bytes, and not {BUILD}, where published stages lie"
        )
    return name


class ExperimentConfig(StrictModel):
    """One experiment, resolved: the file's values, one of its settings over them, then the command line."""

    name: Annotated[str, AfterValidator(_name_of_a_folder)] = Field(min_length=1)
    world: dict[str, Any] = Field(
        description="kind: junction, carla, an installed package's, scene (a learned scene of your own), or file.py:Class relative to this file; and "
        "changes of that world's Config."
    )
    paths: tuple[str, ...] = Field(min_length=1, description="Which of the world's paths are driven.")
    objects: tuple[WantedObject, ...] = Field(
        default=(),
        description="Where the objects of the attack stand, or by which rule (stands); not part of the world.",
    )
    horizon: Positive = Field(default=60, description="Control ticks of every drive (T).")
    dt_s: PositiveNumber = Field(
        default=0.1,
        le=2.0,
        description="Control tick [s]; the paper's CARLA runs have finer ones: docs/intersection.md.",
    )
    held_cap_m: Length = Field(
        default=6.0, description="Largest |CTE| that a stopped car is charged per tick [m]."
    )
    capture: CaptureConfig = CaptureConfig()
    scene: SceneConfig = SceneConfig()
    view: ViewConfig = ViewConfig()
    policy: PolicyConfig = PolicyConfig()  # before the victims, which take it over
    victims: dict[VictimName, VictimConfig] = Field(
        default={},
        description="Which policies are attacked, the main one first: mine: {policy: FILE, package.module:factory or grpc://HOST:PORT}, or "
        "NAME: {train: {architecture: resnet, seed: 1}}, which is trained with these keys over those of the section policy. None: hardened and, "
        "with policy.naive_steps, naive, trained with and without random textures.",
    )
    object: ObjectConfig = ObjectConfig()
    attack: AttackConfig = AttackConfig()
    measure: MeasureConfig = MeasureConfig()
    carrier: CarrierConfig = Field(
        default=ComposedConfig(kind="composed"),
        description="What shows a texture: overlay (drawn on a panel of the world), screen, composed (objects drawn by depth) or native "
        "(objects in the world's own scene).",
    )
    space: SpaceConfig = Field(
        default=ColoursConfig(kind="colours"), description="What the attacks may change."
    )
    maps: MapsConfig = Field(
        default=MapsConfig(),
        description="What is mapped about places that were found; no result depends on it.",
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
    claims: tuple[PlaceClaim, ...] = Field(
        default=(),
        description="What is claimed about a kind of place, from at least four of them (variants or paths) and two victims; or of victim, "
        "from at least five at one place.",
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
        """The attacked policies by name, the main one first, without the retrained one."""
        if self.victims:
            return self.victims
        textures = {HARDENED: "random"} | ({NAIVE: "none"} if self.policy.naive_steps else {})
        keys = {
            name: TrainingConfig.keys_over(self.policy, {"textures": each}) for name, each in textures.items()
        }
        return {
            name: TrainedVictim(train=TrainingConfig.model_construct(**each)) for name, each in keys.items()
        }

    @property
    def all_victims(self) -> tuple[str, ...]:
        """Names of the attacked policies, the main one first, and of the retrained one if there is one."""
        return (*self.attacked, *((RETRAINED,) if self.retrain else ()))

    @property
    def trained(self) -> dict[str, TrainingConfig]:
        """The victims that are trained here, each with all keys of its training."""
        return {name: each.train for name, each in self.attacked.items() if isinstance(each, TrainedVictim)}

    def policy_stage(self, victim: str) -> str:
        """The stage that trains a victim, or that the retrained one begins from: a recipe of its own has a stage of its own."""
        name = self.main_victim if victim == RETRAINED else victim
        found = self.trained.get(name)
        return POLICY if found is None or found.is_of(self.policy) else f"{POLICY}-{name}"

    def training(self, victim: str) -> ExperimentConfig:
        """The same with the section ``policy`` that trains a victim."""
        stage = self.policy_stage(victim)
        if stage == POLICY:
            return self
        own = self.trained[stage.removeprefix(f"{POLICY}-")].as_section
        return self.model_copy(update={"policy": own})

    @property
    def cell_paths(self) -> tuple[str, ...]:
        """The paths that cells drive; all are photographed and learned."""
        return self.over.path or self.paths

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the searches."""
        return self.over.seed

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods of attack, as references for `advnerf_core.attack.methods.load_method`."""
        return tuple(each for each in self.over.method if each not in CONTROLS)

    @property
    def method_names(self) -> tuple[str, ...]:
        """Names of the methods in tables and file names."""
        return tuple(map(name_in_results, self.methods))

    @property
    def main_victim(self) -> str:
        """The victim that reports open with, and that is retrained."""
        return next(iter(self.attacked))

    @property
    def own_scene(self) -> bool:
        """Whether the place is a learned scene of the user's own, for which no stages are run."""
        return self.world.get("kind") == SCENE

    @property
    def _recipes(self) -> dict[str, PolicyConfig]:
        """The sections that train victims, by their keys."""
        return {
            POLICY if each.is_of(self.policy) else f"victims.{name}.train": each.as_section
            for name, each in self.trained.items()
        }

    @field_validator("victims", mode="before")
    @classmethod
    def _trained_over_the_section(cls, victims: Any, info: ValidationInfo) -> Any:
        shared = info.data.get(POLICY)
        if not isinstance(victims, dict) or shared is None:
            return victims

        def over(victim: Any) -> Any:
            own = victim.get("train") if isinstance(victim, dict) else None
            return (
                {**victim, "train": TrainingConfig.keys_over(shared, own)}
                if isinstance(own, dict)
                else victim
            )

        return {name: over(each) for name, each in victims.items()}

    @model_validator(mode="after")
    def _goes_over_keys(self) -> ExperimentConfig:
        known, axes = type(self).model_fields, self.over.model_extra or {}
        if unknown := [key for key in axes if key.partition(".")[0] not in known]:
            raise ValueError(
                f"over: expected {', '.join(OverConfig.model_fields)}, or keys of the experiment such as attack.evaluations, got {unknown[0]}"
            )
        return self

    @model_validator(mode="after")
    def _follows_the_rules(self) -> ExperimentConfig:
        carrier, objects, retrain = self.carrier, self.objects, self.retrain
        rules.check_names(self.paths, objects)
        rules.check_victims(self.attacked, self.trained, retrain)
        if isinstance(carrier, FaceCarrier):
            empty = "no control empty in over.method (set deploy.empty_scene instead)"
            unwanted = {
                "no retrain": "it" if retrain else "",
                empty: "it" if EMPTY in self.over.method else "",
            }
            rules.check_face(carrier, self.space, objects, self.deploy, unwanted)
        else:
            rules.check_objects(carrier, objects, self.deploy, retrain is not None)
        rules.check_training(carrier, {POLICY: self.policy} | self._recipes, objects)
        if self.own_scene:
            rules.check_own_scene(self.space, objects, self.attack)
        else:
            rules.check_space(self.space, objects, self.attack, self.deploy)
        rules.check_searches(self.methods, self.seeds, self.measure, self.deploy, retrain is not None)
        rules.check_methods(self.methods, self.attack, self.own_scene)
        rules.check_drives(self.attack, self._recipes, retrain, self.horizon, self.dt_s)
        return self
