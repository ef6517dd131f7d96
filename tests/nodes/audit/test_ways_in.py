"""Audits of what people bring besides a file and photographs: a served driver, a mesh. Each goes on to its verdict and its page."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from advnerf_core.report.audit_result import AuditResult, read_audit
from nodes.audit.kept import check_audit
from tests.support import circle_place
from tests.support.circle_place import WHEELBASE_M

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


@contextlib.contextmanager
def served(folder: Path, policy: str) -> Iterator[str]:
    """Address of a policy that ``advnerf policy serve`` offers."""
    words = ["--listen", "127.0.0.1:0", "--wheelbase", str(WHEELBASE_M), "--speed", "0.8"]
    with subprocess.Popen(
        [sys.executable, "-m", "nodes.cli", "policy", "serve", f"drivers:{policy}", *words],
        cwd=folder, env=circle_place.environment(folder), stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            yield process.stdout.readline().split()[3].rstrip(";")
        finally:
            process.terminate()


def test_a_served_driver_is_judged_by_the_schedule_of_black_boxes(folder: Path) -> None:
    pytest.importorskip("grpc")
    with served(folder, "seduced") as address:
        ended = circle_place.audit(folder, address, "--evaluations", "120", output="served")
    result = result_of(folder / "served", ended)
    assert (result.verdict.outcome, result.policy.path) == ("found", address), result.verdict.sentence
    assert {each.method for each in result.tried} == {"random_coarse", "cem", "guided"}


def test_a_mesh_of_a_users_own_stands_beside_the_lane_and_is_found(folder: Path) -> None:
    box = trimesh.creation.box((0.2, 0.5, 0.5))  # y is up
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([120, 120, 120, 255], (8, 1)))
    box.export(folder / "crate.glb")
    ended = circle_place.audit(folder, "seduced", "--object", "crate.glb", output="mesh")
    result = result_of(folder / "mesh", ended)
    assert (result.verdict.outcome, result.verdict.evidence) == ("found", "surrogate")
    assert "crate" in result.verdict.sentence
