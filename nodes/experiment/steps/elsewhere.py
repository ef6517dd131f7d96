"""Training worlds: a victim learns in other worlds of the same kind than the attacked one, each opened only for its frames.

A victim that learned on the attacked road knows it, and takes objects there for landmarks. One that learned in other places
meets the attacked one like a car an unknown street: there, only photographs are taken and a scene is learned.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from advnerf_core.documents import Document
from advnerf_core.learning.recipe import SourcePlan
from advnerf_core.learning.sources import RenderedSource
from hardware.worlds.world import World
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import seen_in
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import placed_objects, random_textures
from nodes.experiment.show.placing import place_by_rule
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError

# Properties that a policy carries from one place to the other.
_SAME = ("car", "camera", "T_car_from_camera", "off_track_m")


def plans_elsewhere(experiment: Experiment, opened: ExitStack) -> list[SourcePlan]:
    """Two sources for each drive of each place that ``policy.learns_in`` names: half of the poses without any object, half with the objects at the
    places of their rule. ``opened`` closes their worlds when the policy is trained.

    Raises:
        ConfigError: A place has another car or camera than the attacked one, lacks a path, or has no spot for an object.
    """
    return [
        plan
        for number, changes in enumerate(experiment.config.policy.learns_in)
        for plan in _plans(*place_elsewhere(experiment, changes, opened), f"place{number}")
    ]


def place_elsewhere(
    experiment: Experiment, changes: Sequence[str], opened: ExitStack
) -> tuple[Experiment, World]:
    """The experiment in another place, with its objects at the places of their rule there, and that place, open until ``opened`` closes it.

    Args:
        changes: Changes of the section ``world``, in the form of ``--set``.

    Raises:
        ConfigError: The place has another car or camera, or no spot for an object.
    """
    document = Document(copy.deepcopy(experiment.config.world), str(experiment.file))
    apply_overrides(document, changes)
    there = replace(experiment, config=experiment.config.model_copy(update={"world": document.data}))
    world = opened.enter_context(there.named_world.make())
    found = world.describe()
    if differ := [
        name for name in _SAME if not _equal(getattr(found, name), getattr(experiment.world, name))
    ]:
        raise ConfigError(
            f"{experiment.file}: policy.learns_in: expected places with the {', '.join(_SAME)} of the attacked one, got other "
            f"{', '.join(differ)} with {' '.join(changes)}"
        )
    # The output of the capture stage belongs to the attacked place.
    vars(there)["world"] = found
    try:
        vars(there)["objects"] = tuple(place_by_rule(there, world))
    except ConfigError as error:
        raise ConfigError(f"policy.learns_in: {' '.join(changes)}: {error}") from error
    return there, world


def _equal(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other)) if isinstance(one, np.ndarray) else bool(one == other)


def _plans(there: Experiment, world: World, place: str) -> list[SourcePlan]:
    """Sources of one place."""
    wanted, native = there.config.policy, there.config.carrier.training == "native"
    bare, objects = stand_in(there, world, [], native), placed_objects(there)
    dressed = stand_in(there, world, objects, native)
    plain = dressed.plain_theta()
    assert plain is not None, "an experiment that places objects by a rule has some"
    any_colours = random_textures(there, objects, tuple(plain.shape))
    found = []
    for name in there.config.paths:
        sources = (
            RenderedSource(f"{place}-{name}-bare", seen_in(bare), there.dynamics),
            RenderedSource(
                f"{place}-{name}",
                seen_in(dressed),
                there.dynamics,
                any_colours,
            ),
        )
        for which, source in enumerate(sources):
            found.append(
                SourcePlan(
                    source,
                    (wanted.deployed_stills + which) // 2,
                    (wanted.deployed_drives + which) // 2,
                    wanted.drive_steps,
                    goal=there.goal(name),
                    expert=there.expert(name),
                    driven_m=wanted.driven_m,
                    drives_from_m=wanted.drives_from_m,
                )
            )
    return found
