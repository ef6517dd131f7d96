"""What a run folder keeps of the policies that exist already: their hashes and declarations. Nothing of them is executed here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.documents import read_json
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import source_sha256
from advnerf_core.policies.policy_file import policy_sha256
from advnerf_core.strict import StrictModel
from nodes.experiment.engine.run_folder import RunFolder
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.victims import RETRAINED, GivenVictim
from nodes.runtime.errors import RuntimeFault

KEPT = "victims.json"


class VictimUnknownError(RuntimeFault):
    """A policy that exists was not looked at yet, or is another since."""


class GivenPolicy(StrictModel):
    """What is known of a policy that exists.

    Attributes:
        policy: How it is named.
        source_sha256: Of its file or its code, by which it is known that it has not changed.
        sha256: Content hash as `load_any_policy` tells it.
        contract: Its declaration, as `PolicyContract.to_dict` writes it.
        not_fixed: The program that it asks, which may change; empty for a policy that runs here.
    """

    policy: str = Field(min_length=1)
    source_sha256: str
    sha256: str
    contract: dict[str, Any]
    not_fixed: str = ""

    @property
    def declared(self) -> PolicyContract:
        """Its declaration."""
        return PolicyContract.from_dict(self.contract, self.policy)


def given_in(config: ExperimentConfig) -> dict[str, str]:
    """The victims that exist already, by name, and how each policy is named."""
    return {name: each.policy for name, each in config.attacked.items() if isinstance(each, GivenVictim)}


def read_kept(folder: Path) -> dict[str, GivenPolicy]:
    """What a run folder keeps, by name of the victim."""
    file = folder / KEPT
    if not file.exists():
        return {}
    return {name: GivenPolicy.model_validate(each) for name, each in read_json(file).items()}


def given(experiment: RunFolder[ExperimentConfig]) -> Mapping[str, GivenPolicy]:
    """What is kept of the victims that exist, by name; nothing of them is executed.

    Raises:
        VictimUnknownError: One was not looked at yet, or its file or code is another since.
    """
    wanted = given_in(experiment.config)
    if not wanted:
        return {}
    known = read_kept(experiment.folder)
    for name, spec in wanted.items():
        kept = known.get(name)
        if kept is None or (kept.policy, kept.source_sha256) != (spec, source_sha256(spec)):
            raise VictimUnknownError(
                f"{experiment.file}: victims.{name}: expected {spec} as it was when the experiment was last run, got "
                f"{'one that was never looked at' if kept is None else 'another'}; run the experiment"
            )
    return {name: known[name] for name in wanted}


def victim_spec(experiment: RunFolder[ExperimentConfig], victim: str) -> str:
    """How a victim is named, as `load_any_policy` and the policy node take it; the retrained one is that of the first round, as in the paper."""
    if victim == RETRAINED:
        return str(experiment.stage_folder("retrain") / "round0" / "policy.safetensors")
    wanted = experiment.config.attacked[victim]
    if isinstance(wanted, GivenVictim):
        return wanted.policy
    name = "policy" if wanted.train.textures == "random" else "naive"
    return str(experiment.stage_folder("policy") / f"{name}.safetensors")


def victim_sha256(experiment: RunFolder[ExperimentConfig], victim: str) -> str:
    """Content hash of a victim; nothing of it is executed."""
    if victim in given_in(experiment.config):
        return given(experiment)[victim].sha256
    return policy_sha256(victim_spec(experiment, victim))


def victim_without_gradient(experiment: RunFolder[ExperimentConfig]) -> bool:
    """Whether the main victim declares that it has no gradient."""
    kept = given(experiment).get(experiment.config.main_victim)
    return kept is not None and not kept.declared.differentiable
