"""Audits of what people bring besides a file and photographs: a served driver, a mesh, a video. Each goes on to its verdict and its page."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from advnerf_core.report.audit_result import AuditResult, read_audit
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.audit.kept import check_audit
from tests.support import circle_place
from tests.support.circle_place import RADIUS_M, WHEELBASE_M

pytestmark = pytest.mark.slow  # a learned place and its searches each

_FRAMES, _RATE_HZ = 160, 15.0
_WOBBLE_M, _TURNED_RAD, _AHEAD_M = 0.05, 0.15, 0.3


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


def test_a_video_of_a_drive_is_a_place_once_one_length_is_known(folder: Path) -> None:
    pytest.importorskip("pycolmap")
    film(folder / "drive.mp4")
    asked = circle_place.audit(folder, "blind", "--place", "drive.mp4", output="video")
    assert asked.returncode == 2
    assert "expected a known length" in asked.stderr
    names = sorted((folder / "video" / "photos" / "images" / "drive").glob("*.jpg"))
    first, other = names[0], names[len(names) // 3]
    length_m = math.dist(*(camera_m(int(each.stem)) for each in (first, other)))
    ended = circle_place.audit(
        folder, "blind", "--place", "drive.mp4", "--length", first.name, other.name, f"{length_m:.4f}", output="video",
    )  # fmt: skip
    result = result_of(folder / "video", ended)
    assert (result.place.kind, result.place.scale) == ("video", "length")
    assert result.verdict.outcome == "nothing_found", result.verdict.sentence


def pose_of(frame: int) -> tuple[float, float, float]:
    """The car in a frame of the video: by hand round the circle, as a perfect circle does not tell the focal length."""
    turn = 2.0 * math.pi * frame / _FRAMES
    radius_m = RADIUS_M + _WOBBLE_M * math.sin(9.0 * turn)
    return radius_m * math.sin(turn), -radius_m * math.cos(turn), turn + _TURNED_RAD * math.sin(7.0 * turn)


def camera_m(frame: int) -> tuple[float, float]:
    """The camera in a frame, ahead of the rear axle [m]."""
    x_m, y_m, yaw_rad = pose_of(frame)
    return x_m + _AHEAD_M * math.cos(yaw_rad), y_m + _AHEAD_M * math.sin(yaw_rad)


def film(file: Path) -> None:
    """The drive, filmed by the lab's driving camera."""
    with Lab(LabConfig()) as lab:
        camera = lab.camera_pinhole
        video = cv2.VideoWriter(
            str(file), cv2.VideoWriter_fourcc(*"mp4v"), _RATE_HZ, (camera.width, camera.height)
        )
        for frame in range(_FRAMES):
            rgb = lab.observe_at(*pose_of(frame), depth=False)[0]
            video.write(np.ascontiguousarray(rgb[..., ::-1]))
        video.release()
