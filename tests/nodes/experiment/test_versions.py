"""A changed result with an unchanged version would be taken for the old one, on every machine that has it."""

import json

import pytest
from pydantic import TypeAdapter

from nodes.experiment.engine.artefact import ReferenceBuild, Settings
from nodes.experiment.plan.carriers import CarrierConfig
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.space_config import SpaceConfig
from nodes.experiment.run.cells import Bench, keep_build, run_cell
from nodes.experiment.steps import run
from nodes.experiment.steps.keys import settings_hash
from nodes.experiment.steps.pipeline import stages_of
from tests.support.stage_versions import RECORDED, defaults, tiny_experiment, versions

# Between processors sums are taken in another order; a change of what is computed is larger.
_RELATIVE = 0.01


def test_what_stages_and_cells_make_is_of_their_versions(tiny_room):
    recorded, found = json.loads(RECORDED.read_text()), tiny_room[1]
    assert set(found) == set(recorded)
    for name, each in found.items():
        how = (
            f"{name}: record it with python -m tests.support.stage_versions, if that was meant, and raise its version "
            "(VERSIONS in nodes/experiment/steps/pipeline.py, VERSION in keys.py)"
        )
        assert each["version"] == recorded[name]["version"], how
        assert each["numbers"] == pytest.approx(recorded[name]["numbers"], rel=_RELATIVE), how


# What stages ask to know what there is to do: which victims and objects there are. The network is an input of its own.
_ASKED = {
    "victims",
    "victims.train",
    "policy.naive_steps",
    "objects",
    "policy.architecture",
    "policy.hidden",
    "policy.configuration",
    "carrier.kind",  # of the capture stage: for a warning, which is no result
}


def test_stages_read_no_settings_that_their_keys_lack(tiny_room):
    keys = {stage.name: stage.settings.resolved for stage in stages_of(tiny_experiment(tiny_room[0]))}
    assert set(tiny_room[2]) == set(keys)
    for name, read in tiny_room[2].items():
        known = {
            f"{section}.{key}"
            for section, each in keys[name].items()
            if isinstance(each, dict)
            for key in each
        }
        assert read - known - set(keys[name]) <= _ASKED, name
    assert tiny_room[2]["bake"] == {"horizon", "dt_s", "measure.scene"}


def test_defaults_that_are_not_in_keys_are_of_their_versions():
    recorded, found = json.loads(RECORDED.read_text()), defaults()
    assert {name: recorded[name]["version"] for name in found} == versions()
    for name, each in found.items():
        changed = {
            key
            for key in each
            if key in recorded[name]["defaults"] and each[key] != recorded[name]["defaults"][key]
        }
        assert not changed, (
            f"{name}: raise its version, as keys do not hold defaults, and record them with python -m tests.support.stage_versions"
        )
        assert set(each) == set(recorded[name]["defaults"]), (
            f"{name}: record its settings with python -m tests.support.stage_versions"
        )


def test_tags_of_unions_stay_in_keys():
    kinds = [{"kind": kind} for kind in ("colours", "places", "mesh_texture", "mesh_shape")]
    carriers = [{"kind": kind} for kind in ("overlay", "screen", "composed", "native")]
    for union, members in ((SpaceConfig, kinds), (CarrierConfig, carriers)):
        read = [TypeAdapter(union).validate_python(member) for member in members]
        assert [Settings.of(each).keyed for each in read] == members


def test_a_machine_that_has_only_the_reference_build_runs_the_same_cells(tiny_room, tmp_path, monkeypatch):
    ours = tiny_experiment(tiny_room[0])
    reference = ReferenceBuild(tmp_path / "build")
    assert len(keep_build(ours, reference)) == 4
    monkeypatch.setattr(run, "REFERENCE", reference)
    theirs = tiny_experiment(tmp_path / "theirs")
    cell = Cell("track", "hardened", "random", 0)
    # Known before anything is copied, and the same afterwards.
    assert settings_hash(theirs, cell) == settings_hash(ours, cell)
    run.make_ready(theirs, until="policy")
    assert settings_hash(theirs, cell) == settings_hash(ours, cell)
    assert not (theirs.stage_folder("policy") / "frames").exists()
    with Bench(theirs) as bench:
        found = run_cell(theirs, cell, theirs.cell_folder(cell), lambda part, text="": None, bench)
    assert found["surrogate"]["total_cte_m"][0] == tiny_room[1]["cells"]["numbers"]["random_surrogate_m"]
