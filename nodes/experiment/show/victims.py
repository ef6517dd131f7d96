"""The victims of an experiment: where each is, its hash, and what the policies that exist say about themselves.

A policy that exists is looked at once, before any stage is run: its hash and declaration are kept in the run folder, so that pages and
states of a run folder execute no code of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import is_address, load_adapted, load_any_policy, source_sha256
from advnerf_core.policies.policy_file import LoadedPolicy, policy_sha256
from advnerf_core.policies.view import PolicyView
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.victims import RETRAINED, GivenVictim
from nodes.runtime.errors import ConfigError, RuntimeFault

if TYPE_CHECKING:
    from nodes.experiment.engine.run_folder import RunFolder
    from nodes.experiment.show.context import Experiment

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


def look_at_given(experiment: Experiment) -> None:
    """Load the policies that exist and keep what they say about themselves; those that have not changed since are not loaded.

    Raises:
        AdvnerfError: One cannot be loaded.
        ConfigError: They see different pictures.
    """
    wanted, known = given_in(experiment.config), _read(experiment.folder)
    if not wanted:
        return
    found = {name: _look_at(experiment, spec, known.get(name)) for name, spec in wanted.items()}
    views = {name: each.declared.view for name, each in found.items()}
    first, view = next(iter(views.items()))
    if others := [name for name, each in views.items() if each != view]:
        raise ConfigError(
            f"{experiment.file}: victims: expected policies that see the same part of the camera's picture in the same size, got {first} with "
            f"{view} and {others[0]} with {views[others[0]]}; give each an experiment of its own"
        )
    if known | found != known:
        data = {name: each.model_dump(mode="json") for name, each in (known | found).items()}
        write_json(experiment.folder / KEPT, data)


def _look_at(experiment: Experiment, spec: str, known: GivenPolicy | None) -> GivenPolicy:
    source = source_sha256(spec)
    if known is not None and (known.policy, known.source_sha256) == (spec, source) and not known.not_fixed:
        return known
    if is_address(spec):
        loaded = _driver_at(experiment, spec)
        contract = loaded.policy.contract
    else:
        loaded, contract = load_any_policy(spec), load_adapted(spec)[0].contract
    return GivenPolicy(
        policy=spec,
        source_sha256=source,
        sha256=loaded.sha256,
        contract=contract.to_dict(),
        not_fixed=str(loaded.metadata.get("not_fixed", "")),
    )


def _driver_at(experiment: Experiment, address: str, expected_sha256: str | None = None) -> LoadedPolicy:
    """A driver behind a socket; it sees the whole picture of the driving camera.

    Raises:
        ConfigError: Live nodes are to drive, or the world must be asked for its camera and was not yet.
    """
    from advnerf_core.policies.egodriver import DrivenRig, load_driver_at

    if experiment.config.deploy.live:
        raise ConfigError(
            f"{experiment.file}: victims: expected policies that the policy node loads with deploy.through nodes, got the driver {address}; set "
            "deploy.through world"
        )
    camera, car = experiment.camera, experiment.car
    view = PolicyView(camera, 0, camera.height, camera.width, camera.height)
    rig = DrivenRig(camera, experiment.mount, car.speed_mps, experiment.config.dt_s, car.wheelbase_m)
    return load_driver_at(address, view, rig, expected_sha256)


def _read(folder: Path) -> dict[str, GivenPolicy]:
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
    known = _read(experiment.folder)
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


def load_victim(experiment: Experiment, victim: str) -> LoadedPolicy:
    """A victim, ready for a drive or an attack.

    Raises:
        AdvnerfError: It cannot be loaded, or is not the one that was looked at.
    """
    spec = victim_spec(experiment, victim)
    if victim not in given_in(experiment.config):
        return _loaded(spec, Path(spec).stat().st_mtime_ns)
    expected_sha256 = given(experiment)[victim].sha256
    if is_address(spec):
        return _driver_at(experiment, spec, expected_sha256)
    return _loaded(spec, 0, expected_sha256)


def told(experiment: Experiment, policy: Any, scenario: str) -> tuple[float, ...]:
    """What a policy is told on a path; empty for one that takes no goal.

    Raises:
        ConfigError: It takes goals of another length.
    """
    goal, size = experiment.goal(scenario), int(policy.goal_size)
    if size not in (0, len(goal)):
        raise ConfigError(
            f"{experiment.file}: expected victims that take no goal or {len(goal)} numbers, as the paths of the world "
            f"{experiment.named_world.kind} have, got one that takes {size}"
        )
    return goal if size else ()


@lru_cache(maxsize=4)
def _loaded(spec: str, changed_ns: int, sha256: str | None = None) -> LoadedPolicy:
    del changed_ns  # a file that was written again is another entry
    return load_any_policy(spec, sha256)
