"""An experiment in a world of another process: a cell whose process dies fails by name and has no result; the other cells go on."""

import json
from pathlib import Path

import pytest
import yaml

from tests.support.commands import advnerf
from tests.support.remote.flat_world import HERE, plan_fault
from tests.support.warehouse import EXAMPLES


@pytest.mark.slow
def test_a_cell_whose_process_dies_has_no_result_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = yaml.safe_load((EXAMPLES / "warehouse.experiment.yaml").read_text())
    file, faulty, run = tmp_path / "flat.experiment.yaml", tmp_path / "faulty", tmp_path / "run"
    faulty.mkdir()
    tiny |= {
        "name": "flat",
        "world": {"kind": f"{HERE / 'flat_world.py'}:FlatWorld", "faulty": str(faulty)},
        "paths": ["round"],
        "objects": [{"name": "hydrant", "kind": "hydrant", "x_m": 7.0, "y_m": 2.0}],
    }
    file.write_text(yaml.safe_dump(tiny))
    asked = ("experiment", "run", str(file), "--setting", "tiny", "--folder", str(run))
    assert advnerf(monkeypatch, *asked, "--until", "policy") == 0
    plan_fault(faulty, "step", "killed", after=2)
    assert advnerf(monkeypatch, *asked) == 1
    told = capsys.readouterr()
    cells = run / "cells"
    done = {each.stem for each in cells.glob("round_*.json")}
    assert done == {"round_hardened_gradient_0", "round_hardened_random_0"}
    assert "round_hardened_none_0: failed: ServerLost" in told.out + told.err
    assert not (run / "report" / "report.html").exists()
    assert advnerf(monkeypatch, *asked, "--retry") == 0
    assert (run / "report" / "report.html").exists()
    found = json.loads((run / "report" / "table.json").read_text())["cells"].values()
    assert {each["method"] for each in found} == {"none", "gradient", "random"}
