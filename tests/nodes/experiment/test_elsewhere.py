"""A victim that learns in other places than the attacked one, against pictures taken there by hand."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.driving.expert import Expert
from advnerf_core.learning.imitation import train_policy
from advnerf_core.learning.recipe import ImitationConfig, SourcePlan
from advnerf_core.policies.architecture import Architecture
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.elsewhere import plans_elsewhere
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.support.remote.flat_world import FlatConfig, FlatWorld

CAMERA = {"width": 168, "height": 94}
WORLD = Path(__file__).parents[2] / "support" / "remote" / "flat_world.py"


def experiment_in(folder: Path, *changes: str) -> Experiment:
    """Past one panel in the flat world; its victim learns in two others."""
    file = folder / "flat.experiment.yaml"
    data = {
        "name": "flat",
        "world": {"kind": f"{WORLD}:FlatWorld", "seed": 1, **CAMERA},
        "view": {"crop_top_px": 12, "crop_height_px": 55},
        "paths": ["round"],
        "horizon": 26,
        "objects": [
            {"name": "board", "kind": "panel", "scale": 0.3, "stands": {"least_px": 8, "seen_s": 0.5}}
        ],
        "space": {"kind": "colours", "cells": 4},
        "carrier": {"kind": "native"},
        "policy": {
            "learns_in": [["seed=2"], ["seed=3"]],
            "deployed_stills": 5,
            "deployed_drives": 3,
            "drive_steps": 2,
            "driven_m": None,
            "naive_steps": 0,
        },
        "settings": {"tiny": {}},
    }
    file.write_text(yaml.safe_dump(data))
    experiment = load_experiment(file, "tiny", list(changes), folder / "run")
    experiment.ask_world()
    return experiment


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Experiment, list[SourcePlan]]]:
    """The experiment, and what its victim learns from, open."""
    experiment = experiment_in(tmp_path_factory.mktemp("flat"))
    with ExitStack() as opened:
        yield experiment, plans_elsewhere(experiment, opened)


def test_each_place_is_seen_bare_and_with_the_panel_in_random_colours(
    flat: tuple[Experiment, list[SourcePlan]],
) -> None:
    experiment, plans = flat
    assert [(plan.source.name, plan.stills, plan.drives) for plan in plans] == [
        ("place0-round-bare", 2, 1), ("place0-round", 3, 2), ("place1-round-bare", 2, 1), ("place1-round", 3, 2)
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    looks = [plan.source.look(_along(plan.expert, 8), rng) for plan in plans]
    for seed, bare in ((2, looks[0]), (3, looks[2])):
        assert not bare.textured.any()
        with FlatWorld(FlatConfig(seed=seed, **CAMERA)) as there:
            for image, state in zip(bare.images, bare.states, strict=True):
                seen = there.observe_at(*map(float, state), depth=False)[0]
                assert np.array_equal(image, experiment.view.image(seen))
    assert not np.array_equal(looks[0].images, looks[2].images)
    for without, with_panel in (looks[:2], looks[2:]):
        plain = with_panel.images[~with_panel.textured]
        changed = (plain != without.images).any(axis=(1, 2, 3))
        assert changed.any()  # the panel is seen from a part of the lane
        assert with_panel.textured.sum() == changed.sum()  # and shown in random colours just there


def test_a_policy_learns_from_all_of_them(flat: tuple[Experiment, list[SourcePlan]], tmp_path: Path) -> None:
    experiment, plans = flat
    config = ImitationConfig(
        dagger_rounds=1,
        first_steps=3,
        round_steps=2,
        architecture=Architecture(configuration={"hidden": (8, 8, 4)}),
        naive_steps=0,
        max_steering_rad=0.5,
    )
    assert plans[0].expert is not None
    trained = train_policy(config, plans, plans[0].expert, experiment.view, tmp_path / "policy")
    assert trained.frames >= 2 * (5 + 2 * 3)  # stills, and drives of two ticks


def _along(expert: Expert | None, count: int) -> np.ndarray:
    assert expert is not None
    return np.asarray(expert.path.pose_at(np.linspace(0.0, expert.path.length_m, count, endpoint=False)))


def test_a_place_with_another_car_is_refused(tmp_path: Path) -> None:
    experiment = experiment_in(tmp_path, "policy.learns_in=[[speed_mps=2.0]]")
    with ExitStack() as opened, pytest.raises(ConfigError, match=r"other car with speed_mps=2\.0"):
        plans_elsewhere(experiment, opened)


def test_a_place_without_a_spot_for_the_object_is_named(tmp_path: Path) -> None:
    experiment = experiment_in(
        tmp_path,
        "policy.learns_in=[[seed=2]]",
        "objects=[{name: board, kind: panel, scale: 0.1, stands: {}}]",
    )
    with (
        ExitStack() as opened,
        pytest.raises(ConfigError, match=r"^policy\.learns_in: seed=2: .*expected a spot"),
    ):
        plans_elsewhere(experiment, opened)


def test_what_cannot_be_learned_elsewhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="all stand by a rule"):
        experiment_in(tmp_path, "policy.own_car=true")
