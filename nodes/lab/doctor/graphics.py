"""Checks of graphics and compilers: off-screen rendering, GPUs, LLVM, screens. The libraries are imported in separate processes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from hardware.screen.edid import connected_displays
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, ProbeResult, in_child, report
from nodes.runtime.extras import CPU_TORCH, installs

_EGL_CURE = "apt-get install libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0 (Debian, Ubuntu)"
_SCREEN_CURE = (
    "run it in the desktop session of the computer with the screen, where DISPLAY or WAYLAND_DISPLAY is set"
)


# Drivers that SDL uses without a window system. They show no image.
_NO_SCREEN = ("offscreen", "dummy")


def _missing(answer: ProbeResult) -> bool:
    return "ModuleNotFoundError" in answer.trouble


def egl(required: bool = False) -> list[CheckResult]:
    """Check whether the simulated lab can render."""
    answer = in_child("egl")
    if answer.data is not None:
        return report("EGL", OK, f"MuJoCo {answer.data['version']} renders off-screen")
    if _missing(answer):
        state = FAILURE if required else ABSENT
        return report("EGL", state, "no simulated lab: MuJoCo is missing", "pip install 'advnerf[twin]'")
    state = FAILURE if required else WARNING
    return report("EGL", state, f"the simulated lab cannot render: {answer.trouble}", answer.cure(_EGL_CURE))


def torch(required: bool = False) -> list[CheckResult]:
    """Check the version of torch and its devices."""
    return torch_found(in_child("torch"), required)


def torch_found(answer: ProbeResult, required: bool = False) -> list[CheckResult]:
    """The result of the probe of torch."""
    if answer.data is None:
        text = (
            "is missing: no training, no attack, only ONNX policies" if _missing(answer) else answer.trouble
        )
        state = FAILURE if required else ABSENT if _missing(answer) else WARNING
        return report("torch", state, text, answer.cure(installs("torch") or ""))
    version, gpus, built_for = (answer.data[key] for key in ("version", "gpus", "built_for"))
    if gpus:
        return report("torch", OK, f"{version}, CUDA {built_for}: {', '.join(gpus)}")
    if built_for:
        do = (
            "make nvidia-smi work first: install the driver, or start the container with --gpus all; without such a GPU, "
            f"pip uninstall torch, then {CPU_TORCH}, saves several GB"
        )
        return report("torch", WARNING, f"{version} is built for CUDA {built_for}, but sees no GPU", do)
    return report("torch", OK, f"{version}, CPU only")


def llvm() -> list[CheckResult]:
    """Check whether Mitsuba can compile, which attacks on meshes need."""
    answer = in_child("llvm")
    if answer.data is not None:
        return report("LLVM", OK, f"{answer.data['llvm']} compiles for Mitsuba {answer.data['version']}")
    if "cannot be imported" in answer.trouble or _missing(answer):
        do = "pip install 'advnerf[mesh]'"
        return report("LLVM", ABSENT, "Mitsuba is missing: no attacks on meshes", do)
    return report("LLVM", WARNING, answer.trouble, answer.cure("apt-get install libllvm19 (Debian, Ubuntu)"))


def screens(display: Any | None = None) -> list[CheckResult]:
    """Check the screens of the window system and the connected monitors.

    Args:
        display: ``display`` of the monitor node, of kind ``screen``; None if no screen is needed.
    """
    answer, plugged = in_child("screens"), connected_displays()
    named = ", ".join(
        f"{name} {edid.name or edid.maker} {edid.size_px[0]} x {edid.size_px[1]}"
        for name, edid in plugged.items()
    )
    state = ABSENT if display is None else FAILURE
    if answer.data is None:
        if _missing(answer):
            text = "pygame-ce is missing: no attack on a monitor"
            return report("screens", state, text, "pip install 'advnerf[monitor]'")
        if answer.late:
            return report("screens", state, answer.trouble, answer.cure(""))
        return [_no_window_system(answer.trouble, state, named)]
    if answer.data["driver"] in _NO_SCREEN and os.environ.get("SDL_VIDEODRIVER") != answer.data["driver"]:
        return [_no_window_system("SDL found neither X11 nor Wayland", state, named)]
    sizes = [tuple(size) for size in answer.data["sizes"]]
    text = f"{answer.data['driver']}: " + ", ".join(f"{n}: {w} x {h}" for n, (w, h) in enumerate(sizes))
    rows = report("screens", OK, text + (f"; plugged in: {named}" if named else ""))
    return rows if display is None else [*rows, *_fits(display, sizes, plugged)]


def _no_window_system(trouble: str, state: str, named: str) -> CheckResult:
    text = f"no window system: {trouble}" + (f"; plugged in: {named}" if named else "")
    return CheckResult("screens", state, text, _SCREEN_CURE)


def _fits(display: Any, sizes: Sequence[tuple[int, ...]], plugged: dict[str, Any]) -> Sequence[CheckResult]:
    if display.index >= len(sizes):
        do = "set monitor.display={kind: screen, index: ...}"
        return report("screens", FAILURE, f"no screen with index {display.index}", do)
    if display.connector is None:
        return []
    if display.connector not in plugged:
        there = ", ".join(plugged) or "none"
        do = "check the cable, or set monitor.display.connector"
        return report("screens", FAILURE, f"no monitor at {display.connector}; there are {there}", do)
    native = plugged[display.connector].size_px
    if tuple(native) != tuple(sizes[display.index]):
        text = f"screen {display.index} is {sizes[display.index][0]} x {sizes[display.index][1]}, the panel {native[0]} x {native[1]}"
        do = "use the native resolution and 100 % scaling, or another index"
        return report("screens", FAILURE, text, do)
    return []
