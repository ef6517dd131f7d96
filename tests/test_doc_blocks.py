"""The Python of the pages runs, page by page, in a folder that has what a reader has: a run, photographs, calibrations."""

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.display import DisplayModel
from advnerf_core.report.audit_result import write_audit
from calibration.by_construction import LAB_DATE
from calibration.display_colour import DisplayCalibration
from calibration.schema import BY_CONSTRUCTION, save_calibration
from tests.support.audits import audit_result
from tests.support.stage_versions import measured

ROOT = Path(__file__).parents[1]
BLOCKS = runpy.run_path(str(ROOT / "docs" / "check_code.py"))["blocks"]
# A reader has time; here the same code does less of the same.
_LESS = {
    r"steps=1000\b": "steps=8",
    r"stills=900, drives=6": "stills=8, drives=1, drive_steps=2",
    r"ImitationConfig\(\)": "ImitationConfig(dagger_rounds=1, first_steps=2, round_steps=2)",
}  # fmt: skip


def runnable(page):
    """The blocks of a page as one program; those that the page calls an illustration are left out."""
    lines = page.splitlines()
    found = [
        code
        for line, code in BLOCKS(page).items()
        if not any("illustration" in text.lower() for text in lines[max(line - 6, 0) : line - 1])
    ]
    program = "\n".join(found)
    for many, few in _LESS.items():
        program = re.sub(many, few, program)
    return program


PAGES = [
    page
    for page in sorted((ROOT / "docs").glob("*.md"))
    if page.name != "api.md" and runnable(page.read_text(encoding="utf-8"))
]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A reader's working folder."""
    folder = tmp_path_factory.mktemp("reader")
    run = folder / "runs" / "demo"
    measured(run)
    shutil.copytree(ROOT / "calibration" / "twin", folder / "calibration" / "twin")
    shutil.copytree(ROOT / "calibration" / "twin", folder / "calibration" / "my_car")
    curves = np.tile(np.linspace(0.0, 1.0, 17) ** 2.2, (3, 1))
    display = DisplayModel(curves, np.eye(3), np.full(3, 0.02), response=2.2, falloff=1.0)
    measured_display = DisplayCalibration(date=LAB_DATE, method=BY_CONSTRUCTION, model=display.to_dict())
    save_calibration(measured_display, folder / "calibration" / "my_car" / "display.yaml")
    shutil.copytree(run / "capture" / "photos", folder / "my_scene")
    write_audit(folder / "my_audit" / "audit.json", audit_result())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run(home, page):
    mine = home / "runs" / "my_policy"
    shutil.rmtree(mine, ignore_errors=True)
    if "train_policy" not in page.read_text(encoding="utf-8"):
        mine.mkdir()
        shutil.copy(home / "runs" / "demo" / "policy" / "policy.safetensors", mine)
    done = subprocess.run(
        [sys.executable, "-c", runnable(page.read_text(encoding="utf-8"))],
        cwd=home,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_pages_have_blocks_that_run():
    assert len(PAGES) >= 7
