"""The only module that imports MuJoCo, so that a missing package or a missing EGL library gives one clear error."""

from __future__ import annotations

import importlib
import os
from typing import Any

from hardware.errors import HardwareError

EGL_HELP = (
    "the simulated lab renders off-screen with EGL and could not start it. On Debian or Ubuntu: "
    "`sudo apt-get install libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0`; leave MUJOCO_GL unset or set MUJOCO_GL=egl"
)


class TwinUnavailable(HardwareError):
    """The simulated lab cannot run on this machine; the message says what to install."""


def load_mujoco() -> Any:
    """Import MuJoCo with off-screen rendering selected.

    Raises:
        TwinUnavailable: MuJoCo is not installed, or no EGL library is found.
    """
    # MuJoCo picks its OpenGL binding when it is imported, from this variable.
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        return importlib.import_module("mujoco")
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise TwinUnavailable(f"{EGL_HELP} (importing mujoco failed: {error})") from error
        raise TwinUnavailable(
            "the simulated lab needs MuJoCo, which is not installed: pip install 'advnerf[twin]'"
        ) from error
    except (
        Exception
    ) as error:  # PyOpenGL raises AttributeError, ImportError or its own types when libEGL is absent
        raise TwinUnavailable(f"{EGL_HELP} (importing mujoco failed: {error!r})") from error


def create_context(width: int, height: int) -> Any:
    """Create an off-screen OpenGL context and make it current in this thread.

    Raises:
        TwinUnavailable: EGL has no usable device.
    """
    mujoco = load_mujoco()
    try:
        context = mujoco.GLContext(width, height)
        context.make_current()
    except Exception as error:
        raise TwinUnavailable(f"{EGL_HELP} (MUJOCO_GL={os.environ['MUJOCO_GL']}: {error!r})") from error
    return context
