"""Results of a search of places: a picture from above with the drives past it, and the maps about it."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.pose_plots import draw_placements
from advnerf_core.attack.spaces.places import PlaceSpace
from advnerf_core.report.conditions import NONE
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.node.prepare import prepare
from nodes.experiment.plan.space_config import PlacesConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.attack import Prepared, past
from nodes.experiment.steps.pose_maps import Mapped
from nodes.runtime.errors import ConfigError


def draw_found(prepared: Prepared, attack: AttackFile) -> bytes:
    """A picture of the found places, and of the drives with and without them."""
    space, problem = prepared.space, prepared.problem.undisturbed()
    assert isinstance(space, PlaceSpace), "only places are drawn"
    tracks = {}
    for name, shown in {attack.method: space.restored(attack), NONE: space.plain}.items():
        drives, _ = evaluate(past(problem, space, shown), shown.colours)
        tracks[name] = drives.states[:, 0, :2].numpy()
    return draw_placements(space.sensor.space, _placements(attack), [problem.path], tracks)


def mapped(experiment: Experiment, attack: Path | None) -> Mapped:
    """The state that maps of a request start from: places and colours of an attack file, or the configured places and plain colours.

    Raises:
        ConfigError: The request moves nothing, or the file has other colours.
        AttackFileError: The file has other objects.
        PoseBoundsError: The objects stand outside their bounds.
    """
    _require_places(experiment)
    prepared = prepare(experiment)
    space = prepared.space
    assert isinstance(space, PlaceSpace), "the space of places is this one"
    found = None if attack is None else load_attack(attack)
    digest = hash_of([prepared.settings_hash, "" if found is None else found.sha256])
    theta = _plain(space) if found is None else _theta_of(space, found, str(attack))
    return Mapped(prepared.problem, theta, digest, "" if found is None else "found")


def _require_places(experiment: Experiment) -> None:
    """Refuse a request that moves nothing.

    Raises:
        ConfigError: The request moves nothing.
    """
    if not isinstance(experiment.config.space, PlacesConfig):
        raise ConfigError(
            f"{experiment.file}: expected space.kind places, with bounds of each object; see docs/poses.md"
        )


def _placements(attack: AttackFile) -> Tensor:
    return torch.tensor([each.placement for each in attack.objects], dtype=torch.float64)


def _plain(space: PlaceSpace) -> Tensor:
    sensor, stand = space.sensor, space.sensor.space
    unit = torch.where(stand.half > 0, (stand.nominal - stand.middle) / stand.half.clamp_min(1e-300), 0.0)
    return sensor.join(unit, sensor.fixed_colours)


def _theta_of(space: PlaceSpace, attack: AttackFile, file: str) -> Tensor:
    sensor = space.sensor
    colours = space.restored(attack).colours.double().reshape(sensor.fixed_colours.shape)
    if not sensor.free_colours and not torch.allclose(colours, sensor.fixed_colours):
        raise ConfigError(
            f"{file}: expected the colours of the request (space.coloured_by, or plain ones), got others"
        )
    return sensor.join(sensor.space.unit(_placements(attack)), colours)
