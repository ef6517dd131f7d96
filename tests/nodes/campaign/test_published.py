"""Cells that are kept with the code: what goes there, what stays there, and what comes back."""

import csv
import json
import shutil

import pytest
from typer.testing import CliRunner

from nodes.cli.main import app
from nodes.experiment.campaign.config import load_campaign
from nodes.experiment.campaign.predictions import prediction_file
from nodes.experiment.campaign.published import Published, publish, published_table, restore
from nodes.experiment.campaign.run import Options, plan_cells, run_campaign, statuses
from nodes.experiment.campaign.table import campaign_table, write_table
from nodes.experiment.cell import select
from nodes.runtime.errors import ConfigError


def put(plan, folder, settings_hash=None):
    """A finished cell, where the worker would put it."""
    drives = {"total_cte_m": [6.0], "off_track": [True], "none_total_cte_m": [2.0]}
    cell = plan.cell
    data = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "attack_id": None,
        "settings_hash": settings_hash or plan.job.settings_hash,
        "seconds": 1.0,
        "machine": "m",
        "date": "d",
        "surrogate": drives,
        "deployed": drives,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{cell.name}.json").write_text(json.dumps(data))


def campaign_command(*arguments):
    done = CliRunner().invoke(app, ["campaign", *map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done.output


def test_a_table_and_published_cells_from_finished_cells(here, tmp_path):
    """Without running: results are put where workers put them; one of other settings is not taken."""
    bench = here
    campaign = load_campaign(bench.file)
    found = statuses(campaign, campaign.cells)
    assert {each.state for each in found} == {"missing"}
    plan = plan_cells(campaign, campaign.cells)
    put(plan[0], bench.cells)
    put(plan[1], bench.cells, "of before")
    found = statuses(campaign, campaign.cells)
    assert sorted(each.state for each in found) == ["changed", "done", "missing", "missing"]
    table = campaign_table(campaign, found)
    assert list(table.cells) == [plan[0].cell.name]
    page = write_table(table, bench.cells, tmp_path / "page")
    assert {path.name for path in page.parent.iterdir()} == {
        "index.html",
        "table.csv",
        "table.json",
        "table.md",
    }
    assert publish(campaign, found, tmp_path / "kept") == Published((plan[0].cell.name,), (), ())
    assert publish(campaign, found, tmp_path / "kept") == Published((), (plan[0].cell.name,), ())
    kept = tmp_path / "kept" / "toy" / f"{plan[0].cell.name}.json"
    whole = bench.cells / kept.name
    assert kept.read_text() == whole.read_text()
    whole.write_text(json.dumps({**json.loads(whole.read_text()), "extra": {"changed": 1}}))
    found = statuses(campaign, campaign.cells)
    assert publish(campaign, found, tmp_path / "kept") == Published((plan[0].cell.name,), (), ())
    assert json.loads(kept.read_text())["extra"] == {"changed": 1}
    assert publish(campaign, found, tmp_path / "kept") == Published((), (plan[0].cell.name,), ())
    row = published_table(tmp_path / "kept" / "toy", campaign).find(
        "straight", "hardened", "none", "deployed"
    )
    assert row.ratio == 3.0
    assert set(row.seeds) | set(row.missing) == set(campaign.config.seeds)
    with pytest.raises(ConfigError, match="advnerf campaign publish"):
        published_table(tmp_path / "nowhere", campaign)
    # A cell that other settings have made goes when it is asked for, unless it is not the one that is here; one that was never begun here stays.
    changed, missing = next(each for each in found if each.state == "changed").cell.name, found[-1].cell.name
    there = tmp_path / "kept" / "toy" / f"{changed}.json"
    shutil.copy(bench.cells / f"{changed}.json", there)
    shutil.copy(bench.cells / f"{plan[0].cell.name}.json", there.with_name(f"{missing}.json"))
    assert publish(campaign, found, tmp_path / "kept").stale == (changed,)
    assert there.exists()
    assert publish(campaign, found, tmp_path / "kept", prune=True).stale == (changed,)
    assert not there.exists()
    put(plan[1], there.parent, "of elsewhere")
    assert publish(campaign, found, tmp_path / "kept", prune=True).stale == ()
    assert there.exists()
    assert there.with_name(f"{missing}.json").exists()
    (bench.cells / f"{plan[0].cell.name}.json").write_text("{")
    assert sorted(each.state for each in statuses(campaign, campaign.cells)) == [
        "changed",
        "missing",
        "missing",
        "unreadable",
    ]


def test_a_lost_folder_comes_back_from_what_was_published(here, tmp_path):
    """In real processes: a cell says of which scene and policy it is, and what was taken back is not run again."""
    kept, only = tmp_path / "kept", ("--only", "seed=0")
    for stage, digest in (("capture", "c1"), ("policy", "p1"), ("report", "r1")):
        folder = here.folder / "run" / stage
        folder.mkdir(parents=True)
        (folder / "stage.json").write_text(json.dumps({"key": "k", "digest": digest, "seconds": 1.0}))
    campaign = load_campaign(here.file)
    cells = select(campaign.cells, "seed=0")
    assert [end.how for end in run_campaign(campaign, cells, Options(jobs=2), lambda text: None)] == [
        "done",
        "done",
    ]
    first, second = (here.cells / f"{cell.name}.json" for cell in cells)
    before = first.read_bytes()
    assert json.loads(before)["stages"] == {"capture": "c1", "policy": "p1"}
    assert "2 cells written" in campaign_command("publish", here.file, "--to", kept, *only)
    shutil.rmtree(here.cells)
    said = campaign_command("table", here.file, "--from", kept, *only)
    assert "2 of 2 cells; -o FOLDER writes a page of them" in said
    said = campaign_command("table", here.file, "--from", kept, "-o", tmp_path / "page")
    assert f"2 of 4 cells; page: {tmp_path / 'page' / 'index.html'}" in said.replace("\n", "")
    rows = list(csv.DictReader((tmp_path / "page" / "table.csv").open()))
    (attacked,) = [row for row in rows if (row["method"], row["domain"]) == ("gradient", "deployed")]
    assert float(attacked["ratio"]) == 3.0
    assert not (here.folder / "table").exists()  # that of the campaign's own cells
    (kept / "toy" / second.name).unlink()

    said = campaign_command("restore", here.file, "--from", kept, *only)
    assert "1 cells taken back, 0 were there, 0 were made with other settings" in said
    assert "1 are not published" in said
    assert first.read_bytes() == before
    ended = run_campaign(campaign, cells, Options(jobs=2), lambda text: None)
    assert [end.name for end in ended] == [second.stem]
    assert "0 cells taken back, 2 were there" in campaign_command("restore", here.file, "--from", kept, *only)


def test_predictions_come_back_and_what_other_settings_made_does_not(here, tmp_path):
    kept, campaign = tmp_path / "kept", load_campaign(here.file)
    plan = plan_cells(campaign, campaign.cells)
    for each in plan[:2]:
        put(each, kept / "toy")
    keys = ("ratio", "ratio_low", "ratio_high", "retained", "total_cte_m")
    prediction = {"settings_hash": plan[0].job.settings_hash, **dict.fromkeys(keys, 1.5), "clean_drive": {}}
    for each in plan[:2]:  # that of the second cell is of other settings than the cell
        prediction_file(kept / "toy", each.cell.name).parent.mkdir(exist_ok=True)
        prediction_file(kept / "toy", each.cell.name).write_text(json.dumps(prediction))
    settings = (here.folder / "toy.experiment.yaml").read_text()
    (here.folder / "toy.experiment.yaml").write_text("base: 5.0\n")
    found = restore(campaign, campaign.cells, kept)
    assert (len(found.other), len(found.missing), len(found.taken)) == (2, 2, 0)
    assert {each.state for each in statuses(campaign, campaign.cells)} == {"missing"}
    (here.folder / "toy.experiment.yaml").write_text(settings)
    assert restore(campaign, campaign.cells, kept).taken == (plan[0].cell.name, plan[1].cell.name)
    assert json.loads(prediction_file(here.folder, plan[0].cell.name).read_text()) == prediction
    assert not prediction_file(here.folder, plan[1].cell.name).exists()
