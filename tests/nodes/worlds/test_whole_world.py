"""The junction's experiment in the example's warehouse: all of it, through the command line, in its smallest size."""

import json
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.report.clips import read_clip
from hardware.worlds.world import WorldDescription
from nodes.lab.worlds.expert_drive import as_path
from tests.support.commands import advnerf
from tests.support.warehouse import EXAMPLES


@pytest.mark.slow
def test_every_stage_runs_in_a_strangers_world(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, file = tmp_path / "run", str(EXAMPLES / "warehouse.experiment.yaml")
    asked = ("experiment", "run", file, "--setting", "tiny", "--folder", str(run))
    monkeypatch.chdir(tmp_path)  # the world is found beside its experiment, wherever one is
    assert advnerf(monkeypatch, *asked) == 0
    world = WorldDescription.from_dict(
        json.loads((run / "capture" / "world.json").read_text())["description"]
    )
    assert (world.car.kind, world.car.wheelbase_m) == ("ackermann", 0.5)
    found = list(json.loads((run / "report" / "table.json").read_text())["cells"].values())
    assert {(cell["scenario"], cell["method"]) for cell in found} == {
        (scenario, method) for scenario in ("loop", "dock") for method in ("none", "gradient", "random")
    }
    for cell in found:
        drives = json.loads(
            next(
                (run / "cells").glob(f"**/*{cell['scenario']}_hardened_{cell['method']}_0*/drives.json")
            ).read_text()
        )
        states, controls = np.array(drives["states"][0]), np.array(drives["commands"][0])
        path: DrivingPath = as_path(world.paths[cell["scenario"]])
        driven = [np.array(each)[1:, :2] for each in drives["states"]]
        assert cell["deployed"]["total_cte_m"] == pytest.approx(
            [np.abs(path.project(each).cte_m).sum() for each in driven]
        )
        # A wheel angle, held by a car with a wheelbase whose wheels lag: it turns by less than one without lag would.
        assert np.abs(controls).max() <= world.car.largest_control
        way_m = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
        np.testing.assert_allclose(way_m, 0.1 * world.car.speed_mps, rtol=1e-3)
        at_once = 0.1 * world.car.speed_mps / 0.5 * np.tan(controls)
        assert np.abs(np.diff(states[:, 2])).max() <= np.abs(at_once).max() + 1e-9
    for name in ("loop", "dock"):
        assert len(read_clip(run / "report" / f"{name}.mp4")) == 5  # four ticks and the start
    page = (run / "report" / "report.html").read_text()
    assert "world_warehouse.py:Warehouse" in page
    assert "mean |control difference| [rad]" in page
    capsys.readouterr()
    # Once more: nothing is done again. With another lag the photographs and the scene are kept.
    times = {stage.parent.name: stage.stat().st_mtime_ns for stage in run.glob("*/stage.json")}
    assert advnerf(monkeypatch, *asked) == 0
    assert {stage.parent.name: stage.stat().st_mtime_ns for stage in run.glob("*/stage.json")} == times
    assert advnerf(monkeypatch, *asked, "--set", "world.steering_lag_s=0.2", "--until", "object") == 0
    kept = {stage.parent.name: stage.stat().st_mtime_ns for stage in run.glob("*/stage.json")}
    assert all(kept[name] == times[name] for name in ("capture", "scene", "object"))


def test_a_mistake_in_the_file_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (EXAMPLES / "warehouse.experiment.yaml").read_text()
    (tmp_path / "world_warehouse.py").write_text((EXAMPLES / "world_warehouse.py").read_text())
    file = tmp_path / "mine.experiment.yaml"
    for wrong, told in (
        (
            text.replace("paths: [loop, dock]", "paths: [lopo]"),
            "mine.experiment.yaml:6: paths: expected a path of loop, dock; got 'lopo' (did you mean loop?)",
        ),
        (
            text.replace("x_m: 1.5, y_m: -1.95", "x_m: 1.5, y_m: -2.5"),
            "mine.experiment.yaml:11: expected objects beside the lanes, at least 0.6 m from their middles, but hydrant_left",
        ),
        (
            text.replace(':Warehouse"}', ':Warehouse", speed: 2}'),
            "mine.experiment.yaml:5: unknown key speed; valid keys here: height, seed, speed_mps",
        ),
        (
            text.replace("horizon: 50", "view: {crop_height_px: 300}\nhorizon: 50"),
            "view: expected a crop inside 336 x 188",
        ),
        (
            text.replace("horizon: 50", "attack: {start_sigma: 0.5}\nhorizon: 50"),
            "attack.start_sigma to be at most half of the off-track limit, 0.6 m, got 0.5",
        ),
    ):
        assert wrong != text
        file.write_text(wrong)
        asked = ("experiment", "run", str(file), "--setting", "tiny", "--folder", str(tmp_path / "run"))
        assert advnerf(monkeypatch, *asked) == 2
        said = capsys.readouterr().err
        assert told in said
        code, *errors = said.splitlines()
        assert code.startswith("executes ")
        assert len(errors) == 1
    assert not (tmp_path / "run").exists()
