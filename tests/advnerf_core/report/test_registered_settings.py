"""Cells have the settings that were registered: those of their experiment, and of their victim."""

import pytest

from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.verifying.registered import cell_problems
from benchmarks.planting.simulated import write_simulated_set


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return read_evidence(folder)


def problems_of(evidence, registered, of_hardened, of_others):
    """What is wrong with a set of these registered settings, whose cells have others, by their victim."""
    scenarios = {
        name: each.model_copy(update={"settings": registered})
        for name, each in evidence.registration.scenarios.items()
    }
    registration = evidence.registration.model_copy(update={"scenarios": scenarios})
    cells = [
        cell.model_copy(
            update={
                "registration": registration.digest,
                "settings": of_hardened if cell.victim == "hardened" else of_others,
            }
        )
        for cell in evidence.all_cells
    ]
    return list(cell_problems(Evidence(registration, cells), ()))


def test_a_registered_cell_has_the_registered_settings(evidence):
    settings = {"attack": {"starts": 3, "objective": "cte"}, "dt_s": 0.1}

    def problems(theirs):
        return problems_of(evidence, settings, theirs, theirs)

    # A cell has further settings, and a later version has further keys.
    assert problems({**settings, "seed": 0, "attack": {**settings["attack"], "later": 1}}) == []
    for theirs, says in (
        ({**settings, "dt_s": 0.2}, "expected the registered settings, got dt_s 0.2 instead of 0.1"),
        ({"attack": {"starts": 5}}, "expected the registered settings, got attack.starts 5 instead of 3"),
        ({}, "expected its settings, as the registration has them, got none"),
    ):
        found = problems(theirs)
        assert len(found) == len(evidence.all_cells)
        assert found[0].endswith(says)


def test_a_victim_with_a_recipe_of_its_own_has_the_settings_of_that(evidence):
    shared = {"policy": {"stiffness_1pm": 0.75, "seed": 0}, "architecture": {"hidden": [100, 50, 10]}}
    own = {"stiffness_1pm": 1.6, "seed": 0, "architecture": "resnet"}
    theirs = {"policy": {"stiffness_1pm": 1.6, "seed": 0}, "architecture": {"architecture": "resnet"}}

    def problems(of_hardened):
        return problems_of(evidence, {**shared, "recipes": {"hardened": own}}, of_hardened, shared)

    assert problems(theirs) == []
    assert (
        "got policy.stiffness_1pm 0.75 instead of 1.6" in problems({**theirs, "policy": shared["policy"]})[0]
    )
