"""Cells have the settings that were registered: those of their experiment, and of their victim."""

from types import MappingProxyType

import pytest

from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.verifying.registered import cell_problems
from benchmarks.planting.simulated import write_simulated_set


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return read_evidence(folder)


def problems_of(evidence, registered, of_hardened, of_others, victims=MappingProxyType({})):
    """What is wrong with a set of these registered settings and victims, whose cells have others, by their victim."""
    scenarios = {
        name: each.model_copy(update={"settings": registered, "victims": dict(victims)})
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


@pytest.mark.parametrize(
    ("pinned", "theirs", "says"),
    [
        ({"files": {"box.glb": "a"}}, {"files": {"box.glb": "b"}}, "files.box.glb 'b' instead of 'a'"),
        ({"methods": {"gradient": "a"}}, {"code": "b"}, "code 'b' instead of 'a'"),
    ],
)
def test_a_registered_cell_has_the_registered_mesh_and_method(evidence, pinned, theirs, says):
    """Older registrations have neither, and older cells have the code alone."""
    settings = {"dt_s": 0.1}
    same = {"files": pinned.get("files", {}), "code": pinned.get("methods", {}).get("gradient", "")}

    def problems(registered, of_cells):
        return problems_of(evidence, registered, {**settings, **of_cells}, {**settings, **of_cells})

    assert problems({**settings, **pinned}, same) == []
    assert problems(settings, theirs) == []
    found = problems({**settings, **pinned}, theirs)
    assert all(text.endswith(f"expected the registered settings, got {says}") for text in found)
    of_method = [cell for cell in evidence.all_cells if cell.method == "gradient"]
    assert len(found) == len(evidence.all_cells if "files" in pinned else of_method)


def test_a_registered_cell_was_run_against_the_registered_policy(evidence):
    """All of its cells may have been run against another one, so that they agree with each other."""
    (drove,) = {cell.policy_sha256 for cell in evidence.all_cells}
    for registered, wrong in (
        ({"hardened": drove}, 0),
        ({"hardened": "2" * 64}, len(evidence.all_cells)),
        ({}, 0),
    ):
        found = problems_of(evidence, {}, {}, {}, {"policies": registered})
        assert len(found) == wrong
        assert all(f"got policy_sha256 '{drove[:39]} instead of '{'2' * 39}" in text for text in found)
