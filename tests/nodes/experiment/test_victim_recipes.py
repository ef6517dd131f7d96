"""Victims with recipes of their own: each is trained in a stage of its own, and attacked like the others."""

import shutil

import numpy as np
import pytest
import torch

from advnerf_core.documents import read_json
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.policies.policy_file import load_policy
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.published import table_of
from nodes.experiment.run.run import Options, run_cells
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_sha256
from nodes.experiment.show.objects import random_textures
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.keys import registered_settings, settings_hash
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import make_ready
from nodes.experiment.steps.steering_gate import steering_of_victims
from nodes.runtime.errors import ConfigError
from tests.support.setting_reads import recording
from tests.support.stage_versions import tiny_experiment

RECIPES = (
    "victims={hardened: {train: {}}, wide: {train: {architecture: resnet, configuration: {widths: [4, 8], hidden: 8}, first_steps: 4}}, "
    "second: {train: {seed: 1, families: [random, patterns]}}, plain: {train: {textures: none, naive_steps: 2, hidden: [9, 8, 7]}}}"
)
METHODS = "over.method=[none, gradient]"


def test_training_draws_each_texture_from_one_of_the_families(tmp_path):
    board = cube_face_object(1.0, 8)
    one, both = (
        random_textures(
            tiny_experiment(tmp_path, [f"policy.families={families}"]), [board], board.theta_shape
        )
        for families in ("[random]", "[random, patterns]")
    )
    noise = one(np.random.default_rng(3))
    white = np.random.default_rng(3).standard_normal(board.theta_shape, dtype=np.float32)
    assert torch.equal(noise, torch.from_numpy(np.float32(5.0) * white))  # attack.random_sigma
    rng = np.random.default_rng(0)
    counts = [len(torch.unique(both(rng).reshape(-1, 3), dim=0)) for _ in range(60)]
    assert 15 <= sum(count <= 2 for count in counts) <= 45
    assert {count for count in counts if count > 2} == {board.theta_shape[0] * board.theta_shape[1]}


def with_victims(folder, victims=RECIPES, *changes):
    return tiny_experiment(folder, [victims, METHODS, *changes])


def test_every_victim_is_trained_by_its_recipe_attacked_and_in_the_table(tiny_room, tmp_path):
    shutil.copytree(tiny_room[0], tmp_path / "run")
    experiment = with_victims(tmp_path / "run", RECIPES, "attack.horizon=2", "attack.evaluations=1")
    with recording() as reads:
        make_ready(experiment, watcher=reads)
    keys = {stage.name: stage.settings.resolved for stage in stages_of(experiment)}
    own = ["policy-wide", "policy-second", "policy-plain"]
    assert list(keys)[-4:] == ["policy", *own]
    # What the section policy trains alone is there already.
    assert [name for name, read in reads.of.items() if read] == own
    asked = {
        "victims",
        "victims.train",
        "objects",
        "policy.architecture",
        "policy.hidden",
        "policy.configuration",
    }
    for name in own:
        known = {f"{section}.{key}" for section, each in keys[name].items() if isinstance(each, dict) for key in each}  # fmt: skip
        assert reads.of[name] - known - set(keys[name]) <= asked
    sizes = {
        name: sum(each.numel() for each in load_victim(experiment, name).policy.parameters())
        for name in experiment.config.attacked
    }
    assert sizes["second"] == sizes["hardened"] > max(sizes["wide"], sizes["plain"])
    assert len({victim_sha256(experiment, name) for name in sizes}) == 4
    metadata = {
        name: load_policy(experiment.stage_folder(f"policy-{name}") / file).metadata
        for name, file in (("second", "policy.safetensors"), ("plain", "naive.safetensors"))
    }
    assert metadata["second"]["settings"]["seed"] == 1
    assert not metadata["plain"]["random_textures"]
    assert list(steering_of_victims(experiment)) == ["hardened", "wide", "second", "plain"]

    ended = run_cells(experiment, experiment.cells, Options(here=True, gate=False), lambda text: None)
    assert [end.how for end in ended] == ["done"] * 8
    table = table_of(experiment, statuses(experiment, experiment.cells))
    assert {(row.victim, row.method) for row in table.rows} == {
        (victim, method) for victim in sizes for method in ("none", "gradient")
    }
    stages = {
        victim: read_json(tmp_path / "run" / "cells" / f"track_{victim}_none_0.json")["stages"]
        for victim in sizes
    }
    assert [list(each) for each in stages.values()] == [
        ["capture", "scene", stage, "object"] for stage in ("policy", *own)
    ]
    assert Experiment.resolved_in(tmp_path / "run").config.trained == experiment.config.trained


def test_a_recipe_changes_its_own_victim_alone(tiny_room):
    def keys(victims):
        experiment = with_victims(tiny_room[0], victims)
        cells = {cell.victim: settings_hash(experiment, cell) for cell in experiment.cells}
        stages = {stage.name: stage.settings.key for stage in stages_of(experiment)}
        return cells, stages, registered_settings(experiment).key

    before, stages, registered = keys(RECIPES)
    after, others, other_registered = keys(RECIPES.replace("seed: 1", "seed: 2"))
    assert {name for name in before if before[name] != after[name]} == {"second"}
    assert {name for name in stages if stages[name] != others[name]} == {"policy-second"}
    assert registered != other_registered
    shared, of_one, alone = keys("victims={hardened: {train: {}}}")
    assert (shared["hardened"], of_one["policy"]) == (before["hardened"], stages["policy"])
    # A key with the value that the section policy gives makes no recipe.
    assert keys("victims={hardened: {train: {seed: 0}}}") == (shared, of_one, alone)
    assert alone == registered_settings(tiny_experiment(tiny_room[0])).key


def test_names_that_change_places_change_keys(tiny_room):
    """Both victims are of the stage that the section policy describes, so their names alone would not tell them apart."""

    def keys(one, other):
        victims = f"victims={{a: {{train: {{textures: {one}}}}}, b: {{train: {{textures: {other}}}}}}}"
        experiment = with_victims(tiny_room[0], victims, "policy.naive_steps=2")
        return {cell.name: settings_hash(experiment, cell) for cell in experiment.cells}

    first, second = keys("random", "none"), keys("none", "random")
    both = first.keys() & second.keys()
    assert {name.split("_")[1] for name in both} == {"a", "b"}
    assert all(first[name] != second[name] for name in both)


def test_another_architecture_does_not_take_over_the_settings_of_the_shared_one():
    config = ExperimentConfig.model_validate(
        {
            "name": "a",
            "world": {"kind": "lab"},
            "paths": ["track"],
            "policy": {"architecture": "resnet", "configuration": {"blocks": 2}, "naive_steps": 0},
            "victims": {
                "deep": {"train": {"configuration": {"blocks": 3}}},
                "small": {"train": {"architecture": "vit_tiny"}},
            },
        }
    )
    assert {name: (each.architecture, each.configuration) for name, each in config.trained.items()} == {
        "deep": ("resnet", {"blocks": 3}),
        "small": ("vit_tiny", {}),
    }


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ("{sed: 1}", r"unknown key victims\.mine\.train\.sed; valid keys here: architecture, configuration,"),
        (
            "{seed: one}",
            r"^--set .*: victims\.mine\.train\.seed: input should be a valid integer, got 'one'$",
        ),
        (
            "{naive_steps: 3}",
            r"victims\.mine\.train: expected textures none with naive_steps, got 3 with tex",
        ),
        (
            "{textures: none}",
            r"victims\.mine\.train: expected naive_steps of at least 1.*textures none, got 0",
        ),
        ("{architecture: resnt}", r"victims\.mine\.train\.architecture: .*did you mean"),
        ("{driven_m: 3, drive_steps: 1}", r"expected victims\.mine\.train\.drive_steps to be at least half"),
        (
            "{learns_in: [[seed=2]]}",
            r"victims\.mine\.train\.own_car off, with victims\.mine\.train\.learns_in",
        ),
        ("{seed: 1}}, same: {train: {seed: 1}", "two would be the same policy"),
    ],
)
def test_a_recipe_that_cannot_be_is_one_error(tmp_path, train, message):
    with pytest.raises(ConfigError, match=message):
        tiny_experiment(tmp_path / "run", [f"victims={{mine: {{train: {train}}}}}"])
