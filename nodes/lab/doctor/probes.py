"""Probes of third-party libraries, each in a separate process: ``python -m nodes.lab.doctor.probes NAME ARGUMENTS``.

The last line of the output is the answer as JSON. The doctor's process does not import these libraries: SDL destroys the EGL context
of its process when it ends, torch takes seconds and hundreds of megabytes, and vendors' libraries may hang or crash.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Any


def torch() -> dict[str, Any]:
    """Version of torch, and the GPUs that it can use."""
    import torch

    gpus = (
        [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
        if torch.cuda.is_available()
        else []
    )
    return {"version": str(torch.__version__), "gpus": gpus, "built_for": torch.version.cuda}


def gpu(device_type: str) -> dict[str, Any]:
    """Name of a device, and each part of a search and of a training on it and on the processor, as `agreement.Comparison`."""
    from dataclasses import asdict

    import advnerf_core as advnerf_core  # isort: skip  # before torch, as in the commands
    import torch

    from advnerf_core.geometry import Pinhole
    from advnerf_core.scene.agreement import PARTS, TEN_RAYS, compare

    device = torch.device(device_type)
    name, camera = str(device), Pinhole(200, 66, 160.0, 160.0, 100.0, 33.0)
    if device.type == "cuda":
        there = torch.cuda.get_device_properties(device)
        name = f"{there.name}, {there.total_memory / 2**30:.0f} GiB, compute capability {there.major}.{there.minor}"
    else:
        camera = camera.resized(50, 16)
    found = [compare(part, device, lens) for part in PARTS for lens in (TEN_RAYS, camera)]
    return {"device": name, "rows": [{**asdict(each), "agrees": each.agrees} for each in found]}


def egl() -> dict[str, Any]:
    """Version of MuJoCo and its renderer, tested by rendering without a window."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # as in load_mujoco, whose error says the cure once more
    import mujoco

    context = mujoco.GLContext(16, 16)
    context.make_current()
    return {"version": str(mujoco.__version__)}


def llvm() -> dict[str, Any]:
    """Versions of Mitsuba and of its LLVM."""
    from advnerf_core.objects.mesh.engine import engine

    found = engine()
    return {"version": str(found.mi.__version__), "llvm": ".".join(map(str, found.dr.detail.llvm_version()))}


def oaks() -> list[str]:
    """One line for each OAK. Raises ImportError without depthai."""
    import depthai

    return [
        f"{info.getDeviceId()} at {info.name} ({info.state.name})"
        for info in depthai.Device.getAllAvailableDevices()
    ]


def screens() -> dict[str, Any]:
    """Sizes of the screens [px] by index of the window system, and the name of the window system."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    pygame.display.init()
    return {
        "sizes": [list(size) for size in pygame.display.get_desktop_sizes()],
        "driver": pygame.display.get_driver(),
    }


def policy(spec: str, sha256: str) -> dict[str, Any]:
    """Camera and hash of a policy, and the duration of a warm inference [ms]."""
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
        "sha256": driver.sha256,
        "size": [camera.width, camera.height],
        "goal_size": driver.goal_size,
        "ms": float(np.median(times[3:])),
    }


PROBES: dict[str, Callable[..., Any]] = {
    probe.__name__: probe for probe in (torch, gpu, egl, llvm, oaks, screens, policy)
}


def main(arguments: list[str]) -> int:
    """Run one probe. Errors are printed as one line."""
    try:
        answer = PROBES[arguments[0]](*json.loads(arguments[1]))
    except Exception as error:  # any exception of a third-party library is the finding
        text = " ".join(str(error).split())
        print(f"{type(error).__name__}: {text}" if text else type(error).__name__, file=sys.stderr)
        return 1
    print("\n" + json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    # Skip the teardown of the libraries, which may crash. The answer is already printed.
    os._exit(main(sys.argv[1:]))
