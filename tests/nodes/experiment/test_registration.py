"""What is registered before anything is run, and which cells are run under it."""

import json
from dataclasses import replace

import pytest

from advnerf_core.report.evidence.registration import FILE, RegistrationError, read_registration
from nodes.experiment.attack import cells
from nodes.experiment.campaign.config import campaign_of
from nodes.experiment.campaign.plan import plan_cells
from nodes.experiment.campaign.registering import register
from nodes.experiment.keys import registered_settings
from nodes.experiment.registered import registered_under

GRADIENT = "right_hardened_gradient_0"


@pytest.fixture
def campaign(trained, tmp_path):
    return campaign_of(replace(trained, folder=tmp_path / "run"), ["measure.seed=10000"], cells(trained))


def test_a_registration_says_what_will_be_run(campaign, trained, tmp_path):
    found = register(campaign, "tiny", [], tmp_path)
    assert read_registration(tmp_path / "junction") == found
    assert len(found.cells) == len(campaign.cells)
    scenario = found.scenario("right")
    assert scenario.reference_path().to_dict() == trained.paths["right"].to_dict()
    assert [list(start) for start in scenario.starts] == trained.measured_starts("right").tolist()
    assert scenario.evaluations == trained.config.attack.evaluations
    assert scenario.victims["naive_steps"] == trained.config.policy.naive_steps
    test = next(each for each in found.primary if each.scenario == "right")
    assert (test.method, test.against) == ("gradient", ("random", "cem"))
    # Once more it is the same; of another experiment it is refused.
    assert register(campaign, "tiny", [], tmp_path) == found
    fewer = replace(campaign, cells=campaign.cells[:5])
    with pytest.raises(RegistrationError, match="remove the file"):
        register(fewer, "tiny", [], tmp_path)


def test_a_registration_after_the_fact_is_refused(campaign, tmp_path):
    planned = plan_cells(campaign, campaign.cells[:1])[0]
    work = campaign.folder / "cells" / planned.cell.name
    work.mkdir(parents=True)
    (work / "key").write_text(planned.job.settings_hash + "\n")
    with pytest.raises(RegistrationError, match="before anything is run"):
        register(campaign, "tiny", [], tmp_path)
    assert not (tmp_path / "junction" / FILE).exists()


def test_cells_of_the_registered_settings_are_run_under_it_and_no_others(campaign, trained, tmp_path):
    def under(cell, experiment):
        registration = read_registration(tmp_path / "junction")
        return registered_under(registration, cell, registered_settings(experiment))

    cell = next(each for each in campaign.cells if each.name == GRADIENT)
    assert under(cell, trained) == ""
    found = register(campaign, "tiny", [], tmp_path)
    assert under(cell, trained) == found.digest
    assert under(replace(cell, seed=7), trained) == ""
    config = trained.config.model_copy(update={"horizon": 2})
    assert under(cell, replace(trained, config=config)) == ""


def test_a_cell_keeps_its_drives(trained, tmp_path):
    from advnerf_core.report.cells import cell_from
    from nodes.experiment.cells import run_cell

    cell = next(each for each in cells(trained) if each.name == "right_hardened_random_0")
    data = run_cell(trained, cell, tmp_path / cell.name, lambda fraction, text="": None)
    result = cell_from(
        json.loads(json.dumps({**data, "settings_hash": "", "machine": "", "date": ""})), "a cell"
    )
    for domain, drives in (("surrogate", result.surrogate), ("deployed", result.deployed)):
        (kept,) = result.kept[domain]
        found = kept.metrics(trained.paths["right"], trained.limits)
        assert found.total_cte_m == pytest.approx(drives.total_cte_m[0], abs=1e-4)
        assert len(kept.command.split()) == trained.config.horizon
    assert len(result.policy_sha256) == 64
