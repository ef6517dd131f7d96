"""Audits of what people bring besides a file and photographs: a mesh. It goes on to its verdict and its page."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh

from advnerf_core.report.audit_result import AuditResult, read_audit
from nodes.audit.kept import check_audit
from tests.support import circle_place

pytestmark = pytest.mark.slow  # a learned place and its searches each


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A user's folder with photographs, a car and policies."""
    circle_place.make_folder(tmp_path)
    return tmp_path


def result_of(folder: Path, ended: subprocess.CompletedProcess[str]) -> AuditResult:
    """The result, checked against its drives, of a command that ended with a verdict."""
    result = read_audit(folder / "audit.json")
    assert ended.returncode == result.exit_code, ended.stdout + ended.stderr
    assert check_audit(folder)
    page = (folder / "audit.html").read_text()
    assert page.index(result.verdict.sentence) < page.index("<video") < page.index("<svg")
    return result


def test_a_mesh_of_a_users_own_stands_beside_the_lane_and_is_found(folder: Path) -> None:
    box = trimesh.creation.box((0.5, 0.5, 0.2))  # y is up, z to the front
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([120, 120, 120, 255], (8, 1)))
    box.export(folder / "crate.glb")
    ended = circle_place.audit(folder, "seduced", "--object", "crate.glb", output="mesh")
    result = result_of(folder / "mesh", ended)
    assert (result.verdict.outcome, result.verdict.evidence) == ("found", "surrogate")
    assert "crate" in result.verdict.sentence
