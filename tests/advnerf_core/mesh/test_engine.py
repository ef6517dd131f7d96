"""The choice of LLVM, one clear error without it, and a kernel that is compiled once for all frames."""

import os
import subprocess
import sys

import numpy as np
import torch

from advnerf_core.geometry import make_transform
from advnerf_core.objects.mesh.engine import engine, newest_llvm
from advnerf_core.scene.surrogate import Surrogate

from .conftest import PINHOLE

TRY = """
import sys
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
try:
    engine()
except MeshEngineError as error:
    print("told:", error)
    sys.exit(2)
"""


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_the_newest_library_is_chosen_and_old_ones_are_not(tmp_path):
    for name in (
        "libLLVM-14.so.1",
        "libLLVM-18.so.1",
        "libLLVM.so.19.1",
        "libLLVM.so.20.1",
        "libLLVM-9.so",
        "libLLVMfoo.so",
    ):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM.so.21.0").symlink_to(tmp_path / "gone")
    assert newest_llvm([str(tmp_path)]) == tmp_path / "libLLVM.so.20.1"
    assert newest_llvm([str(tmp_path / "absent"), str(tmp_path)[:-1] + "?"]) == tmp_path / "libLLVM.so.20.1"
    (tmp_path / "libLLVM.so.20.1").unlink()
    (tmp_path / "libLLVM.so.19.1").unlink()
    (tmp_path / "libLLVM-18.so.1").unlink()
    assert newest_llvm([str(tmp_path)]) is None


def test_a_library_that_is_not_there_is_one_clear_error():
    done = run(TRY, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert done.returncode == 2, done.stderr
    assert "libllvm19" in done.stdout
    assert "DRJIT_LIBLLVM_PATH" in done.stdout


def test_a_missing_package_is_one_clear_error():
    done = run("import sys; sys.modules['mitsuba'] = None" + TRY)
    assert done.returncode == 2, done.stderr
    assert "advnerf[mesh]" in done.stdout


def test_threads_follow_the_environment(monkeypatch):
    before = engine().dr.thread_count()
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert engine().dr.thread_count() == 1
    monkeypatch.undo()
    assert engine().dr.thread_count() == before


def test_importing_our_packages_does_not_import_mitsuba():
    done = run(
        "import sys, advnerf_core.objects.mesh.shape, advnerf_core.objects.mesh.glb; sys.exit('mitsuba' in sys.modules)"
    )
    assert done.returncode == 0, done.stderr


def test_a_camera_that_moves_compiles_nothing(ball):
    dr = engine().dr
    background = torch.zeros(1, 40, 80, 3), torch.full((1, 40, 80), 9.0)
    scene = Surrogate(lambda p, c: background, PINHOLE, np.eye(4), ball)
    poses = [make_transform(np.eye(3), [0.013 * k, 0.02 * k, 0.05 * k]) for k in range(8)]
    scene.render(poses[0][None], scene.plain_theta())
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history()
        for pose in poses[1:]:
            scene.render(pose[None], scene.plain_theta())
        kernels = [entry for entry in dr.kernel_history() if entry.get("cache_hit") is not None]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert len(kernels) == 7
    assert all(entry["cache_hit"] for entry in kernels)
