"""The stages after training, in order, on the simulated junction itself."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.geometry import planar_pose
from advnerf_core.report.clips import read_clip
from nodes.experiment.pages import report
from nodes.experiment.run.cells import Bench, run_cell
from nodes.experiment.show.context import Experiment


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


@pytest.mark.slow
def test_all_cells_and_the_report(trained: Experiment, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(trained.folder, folder)
    experiment = replace(trained, folder=folder)
    (folder / "report").mkdir()
    picture = np.full((188, 336, 3), 90, np.uint8)
    pose = planar_pose(*experiment.references["straight"].drive_start) @ experiment.mount
    write_posed_images(
        folder / "capture" / "held_out", [pose], experiment.camera, lambda index: picture, "png"
    )
    view = {"label": "view"}
    view |= {"psnr_full_db": 28.0, "psnr_policy_db": 27.5, "ssim_full": 0.9, "ssim_policy": 0.9}
    (folder / "scene" / "fidelity.json").write_text(json.dumps({"views": [view]}))
    rates = [{"real": 0.1, "surrogate": 0.12}]
    (folder / "policy" / "policy.json").write_text(json.dumps({"on_held_out_views": rates}))
    config = experiment.config.model_dump(mode="json")
    (folder / "manifest.json").write_text(
        json.dumps({"command": "advnerf experiment run <it>", "config": config, "versions": {}})
    )

    with Bench(experiment) as bench:
        for cell in experiment.cells:
            data = run_cell(experiment, cell, experiment.cell_folder(cell), silent, bench)
            kept = {**data, "settings_hash": "h", "machine": "m", "date": "d", "seconds": 1.0}
            experiment.cell_result(cell).write_text(json.dumps(kept))
    report.run(experiment, folder / "report", silent)

    found = json.loads((folder / "report" / "table.json").read_text())["cells"].values()
    assert len(found) == len(experiment.cells) == 24
    for cell in found:
        assert len(cell["deployed"]["total_cte_m"]) == 1
        if cell["method"] == "none":
            assert cell["deployed"]["total_cte_m"] == cell["deployed"]["none_total_cte_m"]
    rows = list(csv.DictReader((folder / "report" / "table.csv").open()))
    assert len(rows) == 48
    assert all(float(row["total_m"]) > 0.0 for row in rows)
    for name in experiment.config.paths:
        assert len(read_clip(folder / "report" / f"{name}.mp4")) == 4  # three ticks and the start
    page = (folder / "report" / "report.html").read_text()
    assert "&lt;it&gt;" in page  # what it quotes is escaped
    # Of each drive and victim a map, errors in both domains and the searches; the steering; and the first screen's map.
    assert page.count("<svg") == 3 * 2 * 4 + 2
    assert page.count("<video") == 3 + 24  # a film of each drive, and one of each cell
    assert "://" not in page.replace("http://www.w3.org", "")
