"""Poses, intrinsics and points of photographs of one scene by structure from motion (COLMAP, by its Python package).

Any number of cameras, each with its own intrinsics: unknown ones are found with the simplest lens that the photographs support
(`calibration.lens_choice`), known ones can be held. Work is stored in a folder and resumed from there. Everything runs on the
CPU, in a separate process: COLMAP takes over the process's signals, and one call can take minutes.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

from advnerf_core.run_module import module_command
from calibration.colmap_messages import pack_job, unpack_answer
from calibration.photo_model import (
    MIN_IMAGES,
    Model,
    PhotoSource,
    ReconstructionError,
    Report,
    SfmConfig,
)


def reconstruct(
    root: Path,
    sources: Sequence[PhotoSource],
    work: Path,
    config: SfmConfig | None = None,
    report: Report | None = None,
) -> Model:
    """Reconstruct a model from photographs.

    Args:
        root: Folder of all images.
        work: Folder for data between runs; with other images or another configuration its content is replaced.
        report: Progress callback; an exception from it (Ctrl-C, SIGTERM) stops the run at once, and the next run resumes from there.

    Raises:
        ReconstructionError: Too few images, or too few that fit together.
        AdvnerfError: An image cannot be read.
    """
    config, report = config or SfmConfig(), report or (lambda share, text: None)
    names = [name for source in sources for name in source.images]
    if len(names) < MIN_IMAGES or len(set(names)) != len(names):
        raise ReconstructionError(
            f"expected at least {MIN_IMAGES} different images, got {len(names)} ({len(set(names))} different); take more photographs"
        )
    _require_colmap()
    log = work.with_name(f"{work.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as stream:
        process = subprocess.Popen(
            module_command("calibration.colmap_process", str(os.getpid())),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stream,
            start_new_session=True,
        )
        try:
            model = _converse(process, pack_job(root.absolute(), sources, work.absolute(), config), report)
        finally:
            process.kill()
            process.communicate()
    if model is None:
        raise _ended_early(process.returncode, log)
    log.unlink()
    return model


def _require_colmap() -> None:
    """Raise the error of a missing package in the caller, not in the other process."""
    from importlib.util import find_spec

    if find_spec("pycolmap") is None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")


def _converse(process: subprocess.Popen[bytes], job: bytes, report: Report) -> Model | None:
    """Hand over the job and follow its progress; returns the model, or None if the process ended without one."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(job)
        process.stdin.flush()
    except BrokenPipeError:
        pass  # it has ended; its earlier output, if any, has the reason
    while (line := process.stdout.readline()).endswith(b"\n"):
        answer = unpack_answer(line)
        if isinstance(answer, Model):
            process.wait()
            return answer
        report(*answer)
    process.wait()
    return None


def _ended_early(code: int, log: Path) -> Exception:
    words = log.read_text(errors="replace").strip()
    if code >= 0:
        return RuntimeError(f"the process that COLMAP runs in ended with exit code {code}:\n{words}")
    last = words.splitlines()[-1] if words else "it left no message"
    return ReconstructionError(
        f"expected COLMAP to finish, but its process was ended by {signal.Signals(-code).name} ({last}); its log is {log}. If memory ran "
        "out, give fewer or smaller images (--most); run the command again to resume"
    )
