"""The victims of an experiment, ready to drive; existing policies are loaded once, before any stage is run, see `given`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from advnerf_core.files import write_json
from advnerf_core.policies.adapter import AdaptedPolicy, adapted
from advnerf_core.policies.conformance import require_steady
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import is_address, is_code, load_any_policy, source_sha256
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.policies.view import PolicyView
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import KEPT, GivenPolicy, given_in, given_victim, read_kept, victim_spec
from nodes.runtime.errors import ConfigError


def look_at_given(experiment: Experiment) -> None:
    """Load the existing policies, refuse unsteady ones, and store their declarations; unchanged files are not loaded again.

    Their view is compared with the world's camera, so that a world which must be open for its description is opened.

    Raises:
        AdvnerfError: A policy cannot be loaded, or answers the same picture in different ways.
        ConfigError: The policies have different views.
    """
    wanted, known = given_in(experiment.config), read_kept(experiment.folder)
    if not wanted:
        return
    experiment.ask_world()
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
    # What a factory reads, such as weights, is in the hash of what it makes, and not in that of its code.
    if known is not None and not is_code(spec) and (known.policy, known.source_sha256) == (spec, source):
        return known
    loaded = _driver_at(experiment, spec) if is_address(spec) else load_any_policy(spec)
    # Of a network that was trained here, code and mode are known.
    if isinstance(loaded.policy, AdaptedPolicy) and (known is None or known.sha256 != loaded.sha256):
        require_steady(loaded.policy, spec)
    # It has no other declaration either.
    plain = PolicyContract(loaded.view, goal_size=loaded.policy.goal_size)
    contract = adapted(loaded.policy, plain).contract
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
        ConfigError: Live nodes would drive, or the world must be open for its camera and was not yet.
    """
    from advnerf_core.policies.egodriver import DrivenRig, load_driver_at

    if experiment.config.deploy.live:
        raise ConfigError(
            f"{experiment.file}: victims: expected policies that the policy node loads with deploy.through nodes, got the driver {address}; set "
            "deploy.through world"
        )
    camera, car = experiment.camera, experiment.car
    view = PolicyView(camera, 0, camera.height, camera.width, camera.height)
    rig = DrivenRig(
        camera, experiment.mount, car.speed_mps, experiment.config.dt_s, car.wheelbase_m, car.control_limits
    )
    return load_driver_at(address, view, rig, expected_sha256)


def load_victim(experiment: Experiment, victim: str) -> LoadedPolicy:
    """A victim, ready for a drive or an attack.

    Raises:
        AdvnerfError: The victim cannot be loaded, or differs from the stored facts.
    """
    spec = victim_spec(experiment, victim)
    if victim not in given_in(experiment.config):
        return _loaded(spec, Path(spec).stat().st_mtime_ns)
    expected_sha256 = given_victim(experiment, victim).sha256
    if is_address(spec):
        return _driver_at(experiment, spec, expected_sha256)
    return _loaded(spec, 0, expected_sha256)


def told(experiment: Experiment, policy: Any, scenario: str) -> tuple[float, ...]:
    """Goal vector of a policy on a path; empty for a policy without goals.

    Raises:
        ConfigError: The policy takes goals of another length.
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
    del changed_ns  # part of the cache's key
    return load_any_policy(spec, sha256)
