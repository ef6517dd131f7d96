"""The section ``victims`` of an experiment: the attacked policies, those that it trains and existing ones."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    StringConstraints,
    Tag,
    ValidationInfo,
    model_validator,
)

from advnerf_core.policies.load import POLICY_SUFFIXES, is_code, wrong_policy
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.numbers import Count
from nodes.experiment.plan.sections import PolicyConfig
from nodes.lab.located import beside, refusal

# Policies that the section policy trains, and the first one's retrained version; a user's victims have other names.
_GIVEN, _TRAINED = "a given policy", "a trained policy"
HARDENED, NAIVE, RETRAINED = "hardened", "naive", "retrained"

# Names become parts of file names, which are separated by "_" and ".".
VictimName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9-]*$")]


def _located(spec: str, info: ValidationInfo) -> str:
    """A policy's name in a form that another process in this working folder understands."""
    if is_code(spec):
        return spec
    file = beside(spec, info)
    if file.suffix not in POLICY_SUFFIXES or not file.is_file():
        raise refusal(f"{wrong_policy(spec)} (relative to this file)")
    return str(file.resolve())


class GivenVictim(StrictModel):
    """An existing policy."""

    policy: Annotated[str, AfterValidator(_located)] = Field(
        description="A .safetensors, .pt2 or .onnx file relative to this file, package.module:factory, or grpc://HOST:PORT of a driver."
    )


class TrainingConfig(PolicyConfig):
    """Training of one victim: the keys of the section ``policy``, which gives those that are missing here."""

    textures: Literal["random", "none"] = Field(
        default="random", description="Whether it sees objects in random textures while it learns."
    )
    naive_steps: Count = Field(
        default=0, description="Optimiser steps with textures none; with random textures 0."
    )

    @classmethod
    def keys_over(cls, shared: PolicyConfig, own: dict[str, Any]) -> dict[str, Any]:
        """All keys of a recipe, of which some are its own. Another architecture does not get the settings of the shared one."""
        unread = {"naive_steps"} if own.get("textures", "random") == "random" else set()
        unread |= {"configuration"} if "architecture" in own else set()
        return {name: value for name, value in dict(shared).items() if name not in unread} | own

    @model_validator(mode="after")
    def _has_steps_for_its_textures(self) -> TrainingConfig:
        if (self.textures == "none") != bool(self.naive_steps):
            wanted = "naive_steps of at least 1, here or in the section policy, with textures none, got 0"
            if self.naive_steps:
                wanted = f"textures none with naive_steps, got {self.naive_steps} with textures random"
            raise refusal(f"expected {wanted}")
        return self

    @property
    def as_section(self) -> PolicyConfig:
        """The section ``policy`` that trains this victim."""
        return PolicyConfig.model_validate(self.model_dump(exclude={"textures"}))

    def is_of(self, shared: PolicyConfig) -> bool:
        """Whether the section ``policy`` trains this victim as it is."""
        unread = {"naive_steps"} if self.textures == "random" else set()
        return self.model_dump(exclude={"textures", *unread}) == shared.model_dump(exclude=unread)


class TrainedVictim(StrictModel):
    """A policy that is trained here."""

    train: TrainingConfig = Field(
        description="What differs from the section policy, by its keys, and textures; {} for nothing, with random textures."
    )


def _tag(value: Any) -> str | None:
    if isinstance(value, dict):
        return next((tag for key, tag in (("policy", _GIVEN), ("train", _TRAINED)) if key in value), None)
    return (
        _GIVEN if isinstance(value, GivenVictim) else _TRAINED if isinstance(value, TrainedVictim) else None
    )


VictimConfig = Annotated[
    Annotated[GivenVictim, Tag(_GIVEN)] | Annotated[TrainedVictim, Tag(_TRAINED)],
    Discriminator(
        _tag,
        custom_error_type="victim",
        custom_error_message="expected {policy: FILE} of one that exists, or {train: {}} of one that is trained here",
    ),
]
