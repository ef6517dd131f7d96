"""Cells that are kept with the code: what goes there, what stays there, and what comes back."""

import csv
import json
import shutil
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from advnerf_core.report.evidence.registration import SetError
from nodes.cli.main import app
from nodes.experiment.engine.artefact import BUILD
from nodes.experiment.pages.table import write_table
from nodes.experiment.plan.cell import select
from nodes.experiment.run.admission import gate_file, gate_key
from nodes.experiment.run.plan import elsewhere, plan_cells, statuses
from nodes.experiment.run.published import (
    Published,
    publish,
    publish_build,
    published_table,
    table_of,
)
from nodes.experiment.run.registering import _refuse_late
from nodes.experiment.run.run import Options, run_cells
from nodes.runtime.errors import ConfigError


def put(plan, folder, settings_hash=None, **changes):
    """A finished cell, where the worker would put it."""
    drives = {"total_cte_m": [6.0], "off_track": [True], "none_total_cte_m": [2.0]}
    cell = plan.cell
    data = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "attack_id": None,
        "settings_hash": settings_hash or plan.settings_hash,
        "seconds": 1.0,
        "machine": "m",
        "date": "d",
        "surrogate": drives,
        "deployed": drives,
        **changes,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{cell.name}.json").write_text(json.dumps(data))


def command(*arguments):
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done.output


def test_a_cell_that_was_not_driven_live_is_shown_and_never_published(here, tmp_path):
    loaded = here.load()
    plan = plan_cells(loaded, loaded.cells)
    for each in plan:
        late = {"deployed": None, "not_driven_live": "live0 was spoiled 3 times"}
        put(each, here.cells, **(late if each.cell.method == "gradient" else {}))
    found = statuses(loaded, loaded.cells)
    table = table_of(loaded, found)
    deployed, learned = (
        table.find("straight", "hardened", "gradient", domain) for domain in ("deployed", "surrogate")
    )
    assert (deployed.drives, deployed.total_m, deployed.missing) == (0, None, (0, 1))
    assert learned.drives == 2
    written = publish(loaded, found, tmp_path / "kept").written
    assert set(written) == {each.cell.name for each in plan if each.cell.method == "none"}
    output = command("experiment", "publish", here.file, "-o", tmp_path / "kept", "--no-build")
    assert (
        "straight_hardened_gradient_0 is no evidence and is not published: it was not driven live" in output
    )
    assert "2 are not finished" in output
    with pytest.raises(SetError, match="register before anything is run"):
        _refuse_late(loaded, loaded.cells)


def test_a_table_and_published_cells_from_finished_cells(here, tmp_path):
    """Without running: results are put where workers put them; one of other settings is not taken."""
    bench = here
    loaded = bench.load()
    found = statuses(loaded, loaded.cells)
    assert {each.state for each in found} == {"missing"}
    plan = plan_cells(loaded, loaded.cells)
    put(plan[0], bench.cells)
    put(plan[1], bench.cells, "of before")
    found = statuses(loaded, loaded.cells)
    assert sorted(each.state for each in found) == ["changed", "done", "missing"]
    table = table_of(loaded, found)
    assert list(table.cells) == [plan[0].cell.name]
    page = write_table(table, bench.cells, tmp_path / "page")
    assert {path.name for path in page.parent.iterdir()} == {
        "index.html",
        "table.csv",
        "table.json",
        "table.md",
    }
    assert publish(loaded, found, tmp_path / "kept") == Published((plan[0].cell.name,), (), ())
    assert publish(loaded, found, tmp_path / "kept") == Published((), (plan[0].cell.name,), ())
    kept = tmp_path / "kept" / "toy" / f"{plan[0].cell.name}.json"
    whole = bench.cells / kept.name
    assert kept.read_text() == whole.read_text()
    whole.write_text(json.dumps({**json.loads(whole.read_text()), "extra": {"changed": 1}}))
    found = statuses(loaded, loaded.cells)
    assert publish(loaded, found, tmp_path / "kept") == Published((plan[0].cell.name,), (), ())
    assert json.loads(kept.read_text())["extra"] == {"changed": 1}
    assert publish(loaded, found, tmp_path / "kept") == Published((), (plan[0].cell.name,), ())
    shown = published_table(tmp_path / "kept" / "toy", loaded)
    assert shown.find("straight", "hardened", "none", "deployed").ratio == 3.0
    assert shown.find("straight", "hardened", "gradient", "deployed").missing == (0, 1)
    with pytest.raises(ConfigError, match="advnerf experiment publish"):
        published_table(tmp_path / "nowhere", loaded)
    # A cell that other settings have made goes when it is asked for, unless it is not the one that is here; one that was never begun here stays.
    changed, missing = next(each for each in found if each.state == "changed").cell.name, found[-1].cell.name
    there = tmp_path / "kept" / "toy" / f"{changed}.json"
    shutil.copy(bench.cells / f"{changed}.json", there)
    shutil.copy(bench.cells / f"{plan[0].cell.name}.json", there.with_name(f"{missing}.json"))
    assert publish(loaded, found, tmp_path / "kept").stale == (changed,)
    assert there.exists()
    assert publish(loaded, found, tmp_path / "kept", prune=True).stale == (changed,)
    assert not there.exists()
    put(plan[1], there.parent, "of elsewhere")
    assert publish(loaded, found, tmp_path / "kept", prune=True).stale == ()
    assert there.exists()
    assert there.with_name(f"{missing}.json").exists()
    (bench.cells / f"{plan[0].cell.name}.json").write_text("{")
    assert sorted(each.state for each in statuses(loaded, loaded.cells)) == [
        "changed",
        "missing",
        "unreadable",
    ]


def test_a_verdict_of_another_machine_replaces_the_published_one_only_for_another_scene_or_limits(
    here, tmp_path
):
    loaded = here.load()
    plan = plan_cells(loaded, loaded.cells)
    put(plan[0], here.cells)
    judged, kept = (
        gate_file(folder, gate_key(plan[0].cell)) for folder in (loaded.folder, tmp_path / "kept" / "toy")
    )
    judged.parent.mkdir()
    for key, psnr_db, published_db in (("a", 36.0, 36.0), ("a", 36.1, 36.0), ("b", 36.2, 36.2)):
        judged.write_text(json.dumps({"key": key, "psnr_db": psnr_db}))
        publish(loaded, statuses(loaded, loaded.cells), tmp_path / "kept")
        assert json.loads(kept.read_text())["psnr_db"] == published_db
    judged.write_text("half of it")  # it is judged again by the next run
    publish(loaded, statuses(loaded, loaded.cells), tmp_path / "kept")
    assert json.loads(kept.read_text())["psnr_db"] == 36.2


def test_a_published_cell_whose_key_matches_is_done_on_any_machine(here, tmp_path, monkeypatch):
    """In real processes: nothing is restored; a machine that has only the repository goes on where another stopped."""
    monkeypatch.chdir(tmp_path)
    kept, only = tmp_path / "docs" / "results", ("--only", "seed=0")
    for stage, digest in (("capture", "c1"), ("policy", "p1"), ("report", "r1")):
        folder = here.folder / "run" / stage
        folder.mkdir(parents=True)
        record = {"key": "k", "digest": digest, "seconds": 1.0, "settings": {}}
        (folder / "stage.json").write_text(json.dumps(record))
    loaded = here.load()
    cells = select(loaded.cells, "seed=0")
    assert [end.how for end in run_cells(loaded, cells, Options(here=True), lambda text: None)] == [
        "done",
        "done",
    ]
    first, second = (here.cells / f"{cell.name}.json" for cell in cells)
    assert json.loads(first.read_bytes())["stages"] == {"capture": "c1", "policy": "p1"}
    assert "2 cells written" in command("experiment", "publish", here.file, *only)
    shutil.rmtree(here.cells)
    assert "2 of 2 cells" in command("experiment", "table", here.file, *only)
    assert "2 of 2 cells" in command("experiment", "table", here.file, "--published", "--folder", kept, *only)
    said = command("experiment", "report", here.file, "-o", tmp_path / "page")
    assert f"2 of 3 cells; page: {tmp_path / 'page' / 'index.html'}" in said.replace("\n", "")
    rows = list(csv.DictReader((tmp_path / "page" / "table.csv").open()))
    (attacked,) = [row for row in rows if (row["method"], row["domain"]) == ("gradient", "deployed")]
    assert float(attacked["total_m"]) == 3.0 * float(attacked["plain_total_m"])
    assert not (here.folder / "table").exists()  # the page of all cells of this file
    assert run_cells(loaded, cells, Options(here=True), lambda text: None) == []
    assert {each.text for each in statuses(loaded, cells)} == {
        f"from {file.relative_to(tmp_path)}"
        for file in (kept / "toy" / first.name, kept / "toy" / second.name)
    }
    # Nor is one of other settings taken, or one that cannot be read.
    (kept / "toy" / second.name).write_text("{")
    here.describe(none_m=2.0, other=1)
    assert [each.state for each in statuses(here.load(), cells)] == ["missing", "missing"]
    here.describe(none_m=2.0)
    ended = run_cells(loaded, cells, Options(here=True), lambda text: None)
    assert [end.name for end in ended] == [second.stem]


def test_a_resumed_live_cell_is_compared_with_the_published_control_of_its_own_set(
    here, tmp_path, monkeypatch
):
    """Live drives differ from run to run: a control that was driven again, or that of another set with the same key, is not this set's."""
    monkeypatch.chdir(tmp_path)
    live = {"run_folder": str(here.folder / "run"), "carrier.kind": "overlay", "deploy.through": "nodes"}
    here.write(seed=[0], method=["none", "gradient"], variants={"live": live})
    loaded, kept = here.load(), tmp_path / "docs" / "results"

    def compared():
        return {each.cell.name: each.control_m for each in plan_cells(loaded, loaded.cells) if each.control_m}

    none = next(each for each in plan_cells(loaded, loaded.cells) if each.cell.name == "live_hardened_none_0")
    for name, total_m in (("another", 7.0), ("toy", 6.5)):
        assert compared() == {}
        drives = {"total_cte_m": [total_m], "off_track": [True], "none_total_cte_m": [total_m]}
        put(none, kept / name, deployed=drives)
    assert compared() == {"live_hardened_gradient_0": (6.5,)}
    run_cells(loaded, loaded.cells, Options(here=True), lambda text: None)
    found = {
        name: json.loads((here.cells / f"{name}_hardened_gradient_0.json").read_text())["deployed"]
        for name in ("straight", "live")
    }
    assert found["live"]["none_total_cte_m"] == [6.5]
    assert found["straight"]["none_total_cte_m"] == [2.0]
    put(none, kept / "toy", "of other settings")
    assert compared() == {}


def test_a_cell_that_its_experiment_has_run_is_done_for_a_variant_too(here):
    loaded = here.load()
    plan = plan_cells(loaded, loaded.cells)
    first, second, _ = (replace(each, cell=each.cell.inside) for each in plan)
    assert first.cell.name == "loop_hardened_none_0"
    put(first, here.folder / "run" / "cells")
    put(second, here.folder / "run" / "cells", "of before")
    assert [each.state for each in statuses(loaded, loaded.cells)] == [
        "done",
        "missing",
        "missing",
    ]


def test_a_published_build_stays_as_long_as_a_published_cell_was_run_with_it(here, tmp_path):
    build, loaded = tmp_path / BUILD, here.load()
    for name, digest in (("scene_of_a_cell", "s1"), ("scene_of_none", "s2")):
        (build / name).mkdir(parents=True)
        record = {"key": "k", "digest": digest, "seconds": 1.0, "settings": {}, "kept": "d"}
        (build / name / "stage.json").write_text(json.dumps(record))
    (tmp_path / "paper").mkdir()
    (tmp_path / "paper" / "cell.json").write_text(json.dumps({"stages": {"scene": "s1"}}))
    (tmp_path / "paper" / "gate.json").write_text(json.dumps({"passed": True}))
    found = publish_build(loaded, loaded.cells, tmp_path)
    assert (found.written, found.removed) == ((), ())
    found = publish_build(loaded, loaded.cells, tmp_path, prune=True)
    assert [each.name for each in found.removed] == ["scene_of_none"]
    assert [each.name for each in build.iterdir()] == ["scene_of_a_cell"]
    assert found.size_bytes == (build / "scene_of_a_cell" / "stage.json").stat().st_size


def test_a_cell_that_its_experiment_ran_itself_is_published_too(here, tmp_path):
    loaded = here.load()
    plan = plan_cells(loaded, loaded.cells)[0]
    own = elsewhere(loaded, plan.cell)[0]
    assert own.parent != here.cells
    put(plan, own.parent)
    (own.parent / f"{plan.cell.name}.json").rename(own)
    found = publish(loaded, statuses(loaded, loaded.cells), tmp_path / "kept")
    assert found.written == (plan.cell.name,)
    kept = json.loads((tmp_path / "kept" / loaded.config.name / f"{plan.cell.name}.json").read_text())
    assert kept["settings_hash"] == plan.settings_hash
    assert publish(loaded, statuses(loaded, loaded.cells), tmp_path / "kept").same == (plan.cell.name,)
