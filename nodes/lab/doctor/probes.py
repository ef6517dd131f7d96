"""What the doctor asks of foreign libraries, each in a process of its own: ``python -m nodes.lab.doctor.probes NAME ARGUMENTS``.

The last line of the output is the answer as JSON. SDL takes the EGL of its process with it when it ends, torch takes seconds and
hundreds of megabytes, vendors' libraries may hang or crash: none of them is imported where the doctor lives.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Any


def torch() -> dict[str, Any]:
    """Version of torch, and the graphics processors that it can use."""
    import torch

    gpus = (
        [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    )
    return {"version": str(torch.__version__), "gpus": gpus, "built_for": torch.version.cuda}


def egl() -> dict[str, Any]:
    """Version of MuJoCo, and who renders; draws into a context without a window."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco

    context = mujoco.GLContext(16, 16)
    context.make_current()
    return {"version": str(mujoco.__version__)}


def llvm() -> dict[str, Any]:
    """Version of Mitsuba, and of the LLVM that it compiles with."""
    from advnerf_core.objects.mesh.engine import engine

    found = engine()
    return {"version": str(found.mi.__version__), "llvm": ".".join(map(str, found.dr.detail.llvm_version()))}


def oaks() -> list[str]:
    """One line for each OAK; raises ImportError without depthai."""
    import depthai

    return [
        f"{info.getDeviceId()} at {info.name} ({info.state.name})" for info in depthai.Device.getAllAvailableDevices()
    ]


def screens() -> dict[str, Any]:
    """Sizes of the screens [px] as the window system counts them, and its name."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    pygame.display.init()
    return {"sizes": [list(size) for size in pygame.display.get_desktop_sizes()], "driver": pygame.display.get_driver()}


def policy(spec: str, sha256: str) -> dict[str, Any]:
    """Camera and hash of a policy, and how long it takes to steer by one image [ms], when warm."""
    import time

    import cv2
    import numpy as np

    from advnerf_core.policies.load import load_driver

    cv2.setNumThreads(1)
    driver = load_driver(spec, sha256 or None)
    camera, goal = driver.view.camera, (0.0,) * driver.goal_size
    image, times = driver.view.image(np.zeros((camera.height, camera.width, 3), np.uint8)), []
    for _ in range(8):
        began = time.perf_counter()
        driver.steer(image, goal)
        times.append(1e3 * (time.perf_counter() - began))
    return {
        "sha256": driver.sha256, "size": [camera.width, camera.height], "goal_size": driver.goal_size, "ms": float(np.median(times[3:])),
    }  # fmt: skip


PROBES: dict[str, Callable[..., Any]] = {probe.__name__: probe for probe in (torch, egl, llvm, oaks, screens, policy)}


def main(arguments: list[str]) -> int:
    """Run one probe; errors are one line."""
    try:
        answer = PROBES[arguments[0]](*json.loads(arguments[1]))
    except Exception as error:  # whatever a foreign library raises is the finding
        text = " ".join(str(error).split())
        print(f"{type(error).__name__}: {text}" if text else type(error).__name__, file=sys.stderr)
        return 1
    print("\n" + json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    # Without the teardown of the libraries: one that crashes there has answered already.
    os._exit(main(sys.argv[1:]))
