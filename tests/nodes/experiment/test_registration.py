"""What is registered before anything is run, and which cells are run under it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from advnerf_core.attack.methods import MethodError
from advnerf_core.files import sha256_of
from advnerf_core.report.evidence.families import coarse_cells_differ
from advnerf_core.report.evidence.registration import FILE, PlaceClaim, SetError, read_registration
from nodes.cli.main import app
from nodes.experiment.engine.artefact import Settings, write_key
from nodes.experiment.plan.space_config import MeshShapeConfig, PlacesConfig
from nodes.experiment.run import plan
from nodes.experiment.run.plan import plan_cells, registered_under
from nodes.experiment.run.registering import primary_tests, register, registered_scenario
from nodes.experiment.steps.keys import registered_settings
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.nodes.experiment.conftest import write_file
from tests.nodes.experiment.test_own_objects import LENGTH_M, STANDS, billboard
from tests.support.stage_versions import tiny_experiment

LAUNCH = Path(__file__).parents[3] / "launch"
GRADIENT = "right_hardened_gradient_0"
FAMILIES = ("random_coarse", "random_levels", "random_pink")
METHODS = ("random", *FAMILIES, "cem", "gradient")


@pytest.fixture
def experiment(trained, tmp_path):
    return made_of(trained, tmp_path, METHODS)


def made_of(trained, tmp_path, methods, **changes):
    """The experiment with other methods, and with other sections of its configuration."""
    over = trained.config.over.model_copy(update={"method": ("none", *methods)})
    config = trained.config.model_copy(update={"over": over, **changes})
    ours = replace(trained, config=config)
    return replace(ours, folder=tmp_path / "run", overrides=("measure.seed=10000",))


def test_a_registration_says_what_will_be_run(experiment, trained, tmp_path):
    found = register(experiment, experiment.cells, tmp_path)
    assert read_registration(tmp_path / "junction") == found
    assert len(found.cells) == len(experiment.cells)
    scenario = found.scenarios["right"]
    assert scenario.reference_path().to_dict() == trained.paths["right"].to_dict()
    assert [list(start) for start in scenario.starts] == trained.measured_starts("right").tolist()
    assert scenario.evaluations == trained.config.attack.evaluations
    assert scenario.victims["naive_steps"] == trained.config.policy.naive_steps
    test = next(each for each in found.primary if each.scenario == "right")
    # White noise has trained the victim: it is run, and is no baseline of the test.
    assert (test.method, test.against) == ("gradient", (*FAMILIES, "cem"))
    # Once more it is the same; of another experiment it is refused.
    assert register(experiment, experiment.cells, tmp_path) == found
    with pytest.raises(SetError, match="remove the file"):
        register(experiment, experiment.cells[:5], tmp_path)


@pytest.mark.parametrize(
    ("methods", "lacks"),
    [
        (("random_coarse", "gradient"), "2 more of the random textures random_levels, random_pink; a coarse search (cem or evolution)"),
        (("random", "random_natural", *FAMILIES[:2], "cem", "gradient"), "1 more of the random textures random_pink"),
        ((*FAMILIES, "gradient"), "a coarse search (cem or evolution)"),
        ((*FAMILIES, "evolution", "gradient"), ""),
        (("gradient",), ""),
    ],
)  # fmt: skip
def test_a_test_needs_three_unseen_families_and_a_coarse_search(trained, tmp_path, methods, lacks):
    if not lacks:
        made = made_of(trained, tmp_path, methods)
        tests = primary_tests(made, made.cells)
        assert {test.against for test in tests} == ({methods[:-1]} if methods[:-1] else set())
        return
    made = made_of(trained, tmp_path, methods)
    with pytest.raises(SetError, match="baselines that a test of the gradient needs") as refused:
        primary_tests(made, made.cells)
    assert f"add {lacks} to the methods" in str(refused.value)


@pytest.mark.parametrize("space", [PlacesConfig(kind="places"), MeshShapeConfig(kind="mesh_shape")])
def test_places_and_shapes_are_tested_against_random_ones(trained, tmp_path, space):
    """White noise has trained the victim, but ``random`` draws places or shapes here."""
    made = made_of(trained, tmp_path, ("random", "gradient"), space=space)
    tests = primary_tests(made, made.cells)
    assert {(test.method, test.against) for test in tests} == {("gradient", ("random",))}
    of_colours = made_of(trained, tmp_path / "colours", ("random", "gradient"))
    assert primary_tests(of_colours, of_colours.cells) == []


def test_tests_of_deployed_drives_need_deployed_drives(trained, tmp_path):
    """The set could be run, and not be published."""
    nothing = {"deploy": trained.config.deploy.model_copy(update={"through": "nothing"})}
    made = made_of(trained, tmp_path, METHODS, **nothing)
    with pytest.raises(SetError, match=r"right: expected deploy\.through world or nodes, .* got nothing"):
        register(made, [cell for cell in made.cells if cell.scenario == "right"], tmp_path)
    made = made_of(trained, tmp_path, ("gradient",), **nothing)
    assert primary_tests(made, made.cells) == []


def test_a_place_of_a_claim_over_places_has_no_test_of_its_own(trained, tmp_path):
    places = ("right", "left", "elsewhere", "and_there")
    over_places = PlaceClaim(
        name="turns", scenarios=places, victims=("hardened", "naive"), against=(*FAMILIES, "cem")
    )
    made = made_of(trained, tmp_path, METHODS, claims=(over_places,))
    assert {test.scenario for test in primary_tests(made, made.cells)} == {"straight"}
    lacking = made_of(trained, tmp_path, ("random_coarse", "gradient"), claims=(over_places,))
    with pytest.raises(SetError, match="right: expected the baselines that a test of the gradient needs"):
        primary_tests(lacking, [cell for cell in lacking.cells if cell.scenario == "right"])


def test_where_coarse_textures_have_other_cells_the_gradient_is_run_in_both(tmp_path):
    def on_a_face(edge, methods):
        changes = [f"space.cells={edge}", f"over.method=[none,{','.join(methods)}]"]
        made = tiny_experiment(tmp_path / "run", changes)
        return primary_tests(made, made.cells)

    methods = (*FAMILIES, "cem", "gradient")
    assert [test.method for test in on_a_face(0, methods)] == ["gradient"]
    with pytest.raises(SetError, match="add gradient_coarse, as coarse textures have other cells"):
        on_a_face(4, methods)
    fine, coarse = on_a_face(4, (*methods, "gradient_coarse"))
    assert (fine.method, fine.against) == ("gradient", methods[:-1])
    assert (coarse.method, coarse.against) == ("gradient_coarse", ("random_coarse", "cem"))


@pytest.mark.parametrize(
    ("changes", "differ"),
    [
        (("space.cells=4",), True),
        (("space.cells=8",), False),  # as many as the face has
        (("space.cells=8", "carrier.resolution=16"), True),
        (("carrier={kind: native}", "objects=[{name: a, kind: panel, stands: {}}]", "space.cells=64"), False),
    ],
)
def test_a_registration_says_whether_coarse_textures_have_other_cells(tmp_path, changes, differ):
    made = tiny_experiment(tmp_path / "run", changes)
    assert coarse_cells_differ(registered_scenario(made, "track")) == differ


def test_cells_of_a_registered_file_with_other_values_are_named_before_they_are_run(tmp_path, monkeypatch):
    """They would be run for hours, and refused when they are published."""
    methods = f"over.method=[none,{','.join(FAMILIES)},cem,gradient]"
    made = tiny_experiment(tmp_path / "run", ["space.cells=0", methods])
    monkeypatch.setattr(plan, "PUBLISHED", tmp_path)
    assert plan.not_registered(made, made.cells) == ""
    register(made, made.cells, tmp_path)
    assert plan.not_registered(made, made.cells) == ""
    other = tiny_experiment(tmp_path / "run", ["space.cells=0", methods, "attack.evaluations=3", "horizon=9"])
    said = plan.not_registered(other, other.cells)
    assert said.startswith(f"{len(other.cells)} cells are not run under the registration {tmp_path}")
    assert said.endswith(
        "as their settings, files, code or victims differ: attack.evaluations 3 instead of 2, horizon 9 instead of 8"
    )
    # Another setting of the file is no mistake.
    assert plan.not_registered(replace(other, setting="quick"), other.cells) == ""


METHOD = """
from advnerf_core.attack.methods import Method

def search(problem, settings, run):
    raise NotImplementedError

Mine = Method(search)
"""


@pytest.mark.parametrize(
    ("edits", "says", "outside"),
    [
        ("board.glb", "files.board.glb ", ["none", "random_coarse", "Mine"]),
        ("mine.py", "code ", ["Mine"]),
    ],
)
def test_a_mesh_and_a_method_are_registered_by_their_content(tmp_path, monkeypatch, edits, says, outside):
    """Only the cells that are run with what was changed are no evidence."""

    def made():
        return load_experiment(
            file, "tiny", [f"over.method=[none,random_coarse,{tmp_path / 'mine.py'}:Mine]"], tmp_path / "run"
        )

    billboard(tmp_path / "board.glb")
    (tmp_path / "mine.py").write_text(METHOD)
    file = write_file(tmp_path, objects=[{"name": "board", "kind": "board.glb", **STANDS}])
    monkeypatch.setattr(plan, "PUBLISHED", tmp_path)
    experiment = made()
    cells = [cell for cell in experiment.cells if (cell.scenario, cell.victim) == ("right", "hardened")]
    found = register(experiment, cells, tmp_path)
    assert found.scenarios["right"].settings["files"] == {"board.glb": sha256_of(tmp_path / "board.glb")}
    assert plan.not_registered(experiment, cells) == ""
    before = registered_settings(experiment).key
    if edits == "board.glb":
        billboard(tmp_path / "board.glb", 2 * LENGTH_M)
    else:
        (tmp_path / "mine.py").write_text(METHOD + "# another\n")
    other = made()
    assert says in plan.not_registered(other, cells)
    assert [cell.method for cell in cells if not registered_under(found, cell, other)] == outside
    # The key of a registration from before is that of now.
    assert registered_settings(other).key == before


def test_an_option_that_no_method_has_is_not_registered(tmp_path):
    (tmp_path / "mine.py").write_text(METHOD)
    file = write_file(tmp_path)
    mine = f"over.method=[none,{tmp_path / 'mine.py'}:Mine]"
    wrong = load_experiment(file, "tiny", [mine, "attack.options.typo=1"], tmp_path / "run")
    with pytest.raises(MethodError, match=r"attack\.options\.typo: .*; Mine has none"):
        register(wrong, wrong.cells, tmp_path)
    assert not list(tmp_path.glob("*/registration.json"))


def test_registering_names_the_folder_that_runs_look_into(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["experiment", "register", str(LAUNCH / "room.experiment.yaml")])
    assert f"expected the folder of published sets, docs/results, in the working folder {tmp_path}" in str(
        found.exception
    )


def test_registering_again_says_when_it_was_and_does_not_ask_to_run_it(tmp_path, monkeypatch):
    (tmp_path / "docs" / "results").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    command = ["experiment", "register", str(LAUNCH / "paper_car_long.experiment.yaml")]
    first, again = (CliRunner().invoke(app, command, catch_exceptions=False).output for _ in range(2))
    (date,) = (json.loads(each.read_text())["date"] for each in tmp_path.rglob(FILE))
    assert "2 primary tests; commit it, then run the experiment\n" in first
    assert f"2 primary tests; registered before, on {date}\n" in again


def test_live_drives_are_registered_with_their_graph(tmp_path):
    """One whose launch file was changed since then is another experiment; what drives through the world has no graph."""
    for name in ("room.experiment.yaml", "room.reference.yaml", "green_screen.launch.yaml"):
        shutil.copy(LAUNCH / name, tmp_path / name)
    graph = tmp_path / "green_screen.launch.yaml"

    def keys():
        made = [
            load_experiment(
                tmp_path / "room.experiment.yaml", "demo", [f"deploy.through={way}"], tmp_path / "run"
            )
            for way in ("nodes", "world")
        ]
        return [registered_settings(each).key for each in made]

    before = keys()
    graph.write_text(graph.read_text() + "# said differently\n")
    assert keys() == before
    slower = 'vicon: {port: "${vicon_port}", latency_s: 0.08}'
    graph.write_text(graph.read_text().replace('vicon: {port: "${vicon_port}"}', slower))
    assert slower in graph.read_text()
    live, world = keys()
    assert (live != before[0], world == before[1]) == (True, True)
    graph.unlink()
    with pytest.raises(ConfigError, match=r"green_screen\.launch\.yaml"):
        keys()


def test_a_registration_after_the_fact_is_refused(experiment, tmp_path):
    planned = plan_cells(experiment, experiment.cells[:1])[0]
    work = experiment.folder / "cells" / planned.cell.name
    work.mkdir(parents=True)
    write_key(work / "key.json", planned.settings_hash, Settings.of())
    with pytest.raises(SetError, match="before anything is run"):
        register(experiment, experiment.cells, tmp_path)
    assert not (tmp_path / "junction" / FILE).exists()


def test_cells_of_the_registered_settings_are_run_under_it_and_no_others(experiment, trained, tmp_path):
    def under(cell, of):
        registration = read_registration(tmp_path / "junction")
        return registered_under(registration, cell, of)

    cell = next(each for each in experiment.cells if each.name == GRADIENT)
    assert under(cell, trained) == ""
    found = register(experiment, experiment.cells, tmp_path)
    assert under(cell, trained) == found.digest
    assert under(replace(cell, seed=7), trained) == ""
    assert found.scenarios["right"].settings["capture"]["driven_m"] == 36.0  # its defaults are there
    config = trained.config.model_copy(update={"horizon": 2})
    assert under(cell, replace(trained, config=config)) == ""


def test_a_cell_keeps_its_drives(trained, tmp_path):
    from advnerf_core.report.cells import cell_from
    from nodes.experiment.run.cells import run_cell

    cell = next(each for each in trained.cells if each.name == "right_hardened_random_0")
    data = run_cell(trained, cell, tmp_path / cell.name, lambda fraction, text="": None)
    result = cell_from(
        json.loads(json.dumps({**data, "settings_hash": "", "machine": "", "date": "", "seconds": 1.0})),
        "a cell",
    )
    for domain, drives in (("surrogate", result.surrogate), ("deployed", result.deployed)):
        (kept,) = result.kept[domain]
        found = kept.metrics(trained.paths["right"], trained.limits)
        assert found.total_cte_m == pytest.approx(drives.total_cte_m[0], abs=1e-4)
        assert len(kept.command.split()) == trained.config.horizon
    assert len(result.policy_sha256) == 64
