"""``advnerf doctor --gpu``: each part of a search and of a training on a GPU and on the processor, as text to paste into an issue."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

from nodes.lab.doctor import graphics
from nodes.lab.doctor.check import ProbeResult, in_child
from nodes.runtime.machine import processor_name

_LIMIT_S = 300.0  # the processor's kernels may have to be compiled first
_SMI_S = 10.0


def compare_gpu(device: str, say: Callable[[str], None]) -> bool:
    """Say the lines of the report as they come. Returns whether searches can use the device.

    Args:
        device: ``cuda``, or ``cpu``, which runs the same code without a GPU.
    """
    torch = in_child("torch")
    if device != "cpu" and not (torch.data and torch.data["gpus"]):
        (found,) = graphics.torch_found(torch)
        say(f"no GPU to compare: torch {found.found}" + (f" -> {found.do}" if found.do else ""))
        return False
    say("```")
    say(
        f"advnerf {_version('advnerf')}, Python {platform.python_version()}, Linux {platform.release()}, {processor_name()}"
    )
    build = f"{torch.data['version']}, CUDA {torch.data['built_for']}" if torch.data else torch.trouble
    say(f"torch {build}, numba {_version('numba')}")
    say(f"driver {_driver()}; GPUs: {', '.join(torch.data['gpus'] if torch.data else []) or 'none'}")
    compared = in_child("gpu", device, timeout_s=_LIMIT_S)
    for line in _table(compared):
        say(line)
    works = _agrees(compared)
    say(f"searches with --device cuda use {'the GPU' if works else 'the processor'}")
    say("```")
    return works


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def _driver() -> str:
    program = shutil.which("nvidia-smi")
    if program is None:
        return "unknown: no nvidia-smi"
    command = [program, "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_SMI_S, check=False)
    except subprocess.TimeoutExpired:
        return "unknown: nvidia-smi hangs"
    return " ".join((done.stdout or done.stderr).split())


def _agrees(answer: ProbeResult) -> bool:
    rows = answer.data["rows"] if answer.data else []
    return bool(rows) and all(row["agrees"] for row in rows if row["part"] != "training step")


def _table(answer: ProbeResult) -> Iterator[str]:
    if answer.data is None:
        yield f"comparison failed: {answer.trouble}"
        return
    yield f"plain torch on {answer.data['device']}; ten rays, then a picture"
    yield f"{'part':20} {'difference':>10} {'tolerance':>9} {'device ms':>10} {'processor ms':>12}"
    yield from (_row(row) for row in answer.data["rows"])


def _row(row: dict[str, Any]) -> str:
    if row["trouble"]:
        return f"{row['part']:20} FAILED {row['trouble'][:200]}"
    times = f"{1e3 * row['seconds']:10.2f} {1e3 * row['processor_seconds']:12.2f}"
    verdict = "" if row["agrees"] else " DIFFERS"
    return f"{row['part']:20} {row['difference']:10.1e} {row['tolerance']:9.0e} {times}{verdict}"
