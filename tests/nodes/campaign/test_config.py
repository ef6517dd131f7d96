import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nodes.cli.main import app
from nodes.experiment.plan.cell import select
from nodes.experiment.run.config import load_campaign
from nodes.experiment.run.run import _refuse_two_in_one_folder
from nodes.runtime.errors import ConfigError

ROOT = Path(__file__).parents[3]
CAMPAIGN = """name: mine
seeds: [0, 1]
scenarios:
  straight:
    experiment: one.experiment.yaml
    run_folder: runs/one
    methods: [none, gradient]
    victims: [hardened]
    placements:
      near: {run_folder: runs/near, set: [world.board.x_m=1.9]}
  left: {experiment: one.experiment.yaml, run_folder: runs/one, seeds: [7], set: [horizon=40]}
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "one.experiment.yaml").write_text("name: one\nsettings: {full: {}}\n")
    path = tmp_path / "mine.campaign.yaml"
    path.write_text(CAMPAIGN)
    return path


def test_a_campaign_is_the_product_of_what_it_lists(file):
    campaign = load_campaign(file)
    names = [cell.name for cell in campaign.cells]
    assert len(names) == len(set(names)) == 2 * (1 + 2) + 1 * 2 * 4
    assert names[:3] == [
        "straight_hardened_none_0",
        "straight_hardened_gradient_0",
        "straight_hardened_gradient_1",
    ]
    assert "straight.near_hardened_gradient_1" in names
    near = next(cell for cell in campaign.cells if cell.placement)
    assert campaign.overrides(near) == ["world.board.x_m=1.9"]
    assert campaign.run_folder(near).name == "near"
    assert campaign.folder.parts[-3:] == ("runs", "campaigns", "mine")
    left = [cell for cell in campaign.cells if cell.scenario == "left"]
    assert {cell.seed for cell in left if cell.method != "none"} == {7}
    assert [cell.method for cell in left[:4]] == ["none", "random", "cem", "gradient"]


def test_cells_are_selected_by_what_they_are(file):
    cells = load_campaign(file).cells
    chosen = select(cells, "scenario=left,method=random+cem,victim=naive")
    assert [cell.name for cell in chosen] == ["left_naive_random_7", "left_naive_cem_7"]
    assert select(cells, "") == list(cells)
    with pytest.raises(
        ConfigError, match="expected KEY=VALUE with KEY one of scenario, placement, victim, method, seed"
    ):
        select(cells, "mode=random")
    with pytest.raises(ConfigError, match="got none"):
        select(cells, "scenario=monitor")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "seeds: [0, 1]",
            "seed: [0, 1]",
            r"mine.campaign.yaml:2: unknown key seed; valid keys here: .*seeds",
        ),
        ("    run_folder: runs/one\n", "", r":4: scenarios.straight.run_folder is missing"),
        (
            "placements:\n      near: {run",
            "placements:\n      near: {rum",
            r":10: unknown key .*near.rum_folder",
        ),
        (
            "[none, gradient]",
            "[none, gradiant]",
            r":7: scenarios.straight.methods.1: expected an attack method .*got 'gradiant' \(did you mean gradient\?\)",
        ),
        ("seeds: [0, 1]", "seeds: [0, 0]", "every one of seeds once"),
        ("seeds: [7]", "seeds: [7, 7]", "every one of seeds once"),
        ("methods: [none, gradient]", "methods: []", r":7: scenarios.straight.methods: .*at least 1 item"),
        (
            "one.experiment",
            "two.experiment",
            "expected the experiment file of scenario straight at .*two.experiment",
        ),
        ("  left:", "  Left!:", "Left!"),
    ],
)
def test_a_bad_file_is_told_with_its_line(file, old, new, says):
    file.write_text(CAMPAIGN.replace(old, new))
    with pytest.raises(ConfigError, match=says):
        load_campaign(file)


TWICE = """name: twice
seeds: [0]
scenarios:
  straight: {{experiment: {file}, run_folder: {folder}}}
  other: {{as_scenario: straight, experiment: {file}, run_folder: {folder}, set: [{change}]}}
"""


def test_two_scenarios_in_one_run_folder_need_the_same_scene_and_policies(tmp_path):
    """Or one would run on the policy of the other, under a hash that says otherwise."""
    file, folder = ROOT / "launch" / "junction.experiment.yaml", tmp_path / "run"
    campaign = tmp_path / "twice.campaign.yaml"
    campaign.write_text(TWICE.format(file=file, folder=folder, change="policy.seed=1"))
    loaded = load_campaign(campaign, tmp_path)
    with pytest.raises(
        ConfigError,
        match=r"straight and other to have the same settings of stage policy, as both are in .*run_folder of its own",
    ):
        _refuse_two_in_one_folder(loaded, select(loaded.cells, "scenario=other"))
    assert not folder.exists()
    campaign.write_text(TWICE.format(file=file, folder=folder, change="attack.evaluations=7"))
    _refuse_two_in_one_folder(load_campaign(campaign, tmp_path), load_campaign(campaign, tmp_path).cells)
    for shipped in sorted((ROOT / "launch").glob("*.campaign.yaml")):
        _refuse_two_in_one_folder(load_campaign(shipped, tmp_path), load_campaign(shipped, tmp_path).cells)


def test_a_page_of_some_cells_does_not_take_the_place_of_the_page_of_all(bench, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(bench.folder))

    def call(name, *options):
        done = CliRunner().invoke(app, [name, str(bench.file), *options])
        assert done.exit_code == 0, done.output
        return done.output

    assert "of 3 cells; page: " in call("report")
    whole = (bench.cells.parent / "table" / "table.json").read_text()
    assert {row["method"] for row in json.loads(whole)["rows"]} == {"none", "gradient"}
    said = call("table", "--only", "method=gradient")
    assert said.count(" missing ") == 2  # in either domain
    assert "0 of 2 cells; advnerf report writes a page of them" in said
    assert (bench.cells.parent / "table" / "table.json").read_text() == whole
    with pytest.raises(ConfigError, match="expected --output with --only"):
        CliRunner().invoke(app, ["report", str(bench.file), "--only", "seed=0"], catch_exceptions=False)
    call("report", "--only", "method=gradient", "-o", str(tmp_path / "some"))
    assert {row["method"] for row in json.loads((tmp_path / "some" / "table.json").read_text())["rows"]} == {
        "gradient"
    }
