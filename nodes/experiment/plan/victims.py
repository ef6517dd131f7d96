"""The section ``victims`` of an experiment: the attacked policies, those that it trains and existing ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, StringConstraints, Tag, ValidationInfo
from pydantic_core import PydanticCustomError

from advnerf_core.places import expanded
from advnerf_core.policies.load import POLICY_SUFFIXES, is_code
from advnerf_core.strict import COMPLETE, StrictModel

# Policies that the section policy trains, and the first one's retrained version; a user's victims have other names.
HARDENED, NAIVE, RETRAINED = "hardened", "naive", "retrained"

# Names become parts of file names, which are separated by "_" and ".".
VictimName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9-]*$")]


def _located(spec: str, info: ValidationInfo) -> str:
    """A policy's name in a form that another process in this working folder understands."""
    if is_code(spec):
        return spec
    file = ((info.context or {}).get("folder") or Path.cwd()) / expanded(Path(spec))
    if file.suffix not in POLICY_SUFFIXES or not file.is_file():
        wrong = "which is not there" if file.suffix in POLICY_SUFFIXES else "which is none of these"
        text = f"expected a policy file ({', '.join(POLICY_SUFFIXES)}) relative to this file, package.module:factory or grpc://HOST:PORT, got {spec}, {wrong}"
        raise PydanticCustomError(COMPLETE, "{text}", {"text": text})
    return str(file.resolve())


class GivenVictim(StrictModel):
    """An existing policy."""

    policy: Annotated[str, AfterValidator(_located)] = Field(
        description="A .safetensors, .pt2 or .onnx file relative to this file, package.module:factory, or grpc://HOST:PORT of a driver."
    )


class TrainingConfig(StrictModel):
    """Training of a victim of the section ``policy`` beyond that section."""

    textures: Literal["random", "none"] = Field(
        default="random", description="Whether it sees objects in random textures while it learns."
    )


class TrainedVictim(StrictModel):
    """A policy that the section ``policy`` trains."""

    train: TrainingConfig = Field(description="How; {} for as the section policy says, with random textures.")


def _tag(value: Any) -> str:
    given = isinstance(value, GivenVictim) or (isinstance(value, dict) and "policy" in value)
    return "a given policy" if given else "a trained policy"


VictimConfig = Annotated[
    Annotated[GivenVictim, Tag("a given policy")] | Annotated[TrainedVictim, Tag("a trained policy")],
    Discriminator(_tag),
]
TRAINED = TrainedVictim(train=TrainingConfig())
TRAINED_PLAIN = TrainedVictim(train=TrainingConfig(textures="none"))
