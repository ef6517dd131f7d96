"""Stored facts about existing policies in a run folder: their hashes and declarations. Nothing of them is executed here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.documents import read_json
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import is_factory, source_sha256
from advnerf_core.policies.policy_file import policy_sha256
from advnerf_core.strict import StrictModel
from nodes.experiment.engine.run_folder import RunFolder
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.victims import RETRAINED, GivenVictim
from nodes.runtime.errors import RuntimeFault

KEPT = "victims.json"


class VictimUnknownError(RuntimeFault):
    """An existing policy was not loaded yet, or not as it is now."""


class VictimChangedError(VictimUnknownError):
    """An existing policy has changed since it was last loaded."""


class GivenPolicy(StrictModel):
    """Stored facts about an existing policy.

    Attributes:
        source_sha256: Hash of its file or code, which shows whether it has changed.
        sha256: Content hash from `load_any_policy`.
        contract: Declaration, from `PolicyContract.to_dict`.
        not_fixed: The program that it queries, which may change; empty for a policy that runs here.
    """

    policy: str = Field(min_length=1)
    source_sha256: str
    sha256: str
    contract: dict[str, Any]
    not_fixed: str = ""

    @property
    def declared(self) -> PolicyContract:
        """Declaration of the policy."""
        return PolicyContract.from_dict(self.contract, self.policy)


def given_in(config: ExperimentConfig) -> dict[str, str]:
    """The existing victims by name, each with the name of its policy."""
    return {name: each.policy for name, each in config.attacked.items() if isinstance(each, GivenVictim)}


def read_kept(folder: Path) -> dict[str, GivenPolicy]:
    """Content of a run folder, by name of the victim."""
    file = folder / KEPT
    if not file.exists():
        return {}
    return {name: GivenPolicy.model_validate(each) for name, each in read_json(file).items()}


def given_victim(experiment: RunFolder, victim: str) -> GivenPolicy:
    """Stored facts about one existing victim, whether or not the others were loaded; nothing of it is executed.

    Raises:
        VictimUnknownError: The victim was not loaded yet.
        VictimChangedError: Its file or code has changed since.
    """
    kept = last_seen(experiment, victim)
    if kept.source_sha256 != source_sha256(kept.policy):
        other = "another"
        if is_factory(kept.policy):
            other += " (all Python files of its package, or else of its folder, count, also added and removed ones)"
        raise VictimChangedError(_unlike(experiment, victim, other))
    return kept


def last_seen(experiment: RunFolder, victim: str) -> GivenPolicy:
    """The same, though its file or code may have changed since.

    Raises:
        VictimUnknownError: The victim was not loaded yet.
    """
    kept = read_kept(experiment.folder).get(victim)
    if kept is None or kept.policy != given_in(experiment.config)[victim]:
        raise VictimUnknownError(_unlike(experiment, victim, "one that was never looked at"))
    return kept


def _unlike(experiment: RunFolder, victim: str, found: str) -> str:
    return (
        f"{experiment.file}: victims.{victim}: expected {given_in(experiment.config)[victim]} as it was when the experiment was last run, got {found}; "
        "run the experiment"
    )


def victim_spec(experiment: RunFolder, victim: str) -> str:
    """Name of a victim for `load_any_policy` and the policy node; the retrained one is the first round's, as in the paper."""
    if victim == RETRAINED:
        return str(experiment.stage_folder("retrain") / "round0" / "policy.safetensors")
    wanted = experiment.config.attacked[victim]
    if isinstance(wanted, GivenVictim):
        return wanted.policy
    name = "policy" if wanted.train.textures == "random" else "naive"
    return str(experiment.stage_folder(experiment.config.policy_stage(victim)) / f"{name}.safetensors")


def victim_sha256(experiment: RunFolder, victim: str) -> str:
    """Content hash of a victim; nothing of it is executed."""
    if victim in given_in(experiment.config):
        return given_victim(experiment, victim).sha256
    return policy_sha256(victim_spec(experiment, victim))
