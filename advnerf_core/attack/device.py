"""The device of a search. It belongs to the machine and not to the experiment: it is no configuration key and enters no hash.

Results differ in their last bits between a CPU and a GPU, and a chaotic drive amplifies the difference.
"""

from __future__ import annotations

import os

from advnerf_core.errors import DeviceError

VARIABLE = "ADVNERF_DEVICE"
_CPU, _CUDA = "cpu", "cuda"


def searches_on_gpu() -> bool:
    """Whether the environment variable ``ADVNERF_DEVICE`` asks for a GPU; the default is the CPU.

    Raises:
        DeviceError: The variable is neither cpu nor cuda.
    """
    named = os.environ.get(VARIABLE) or _CPU
    if named not in (_CPU, _CUDA):
        raise DeviceError(f"expected cpu or cuda in {VARIABLE}, got {named!r}")
    return named == _CUDA


def use_device(device: str | None) -> None:
    """Search on ``cpu`` or ``cuda`` from now on, also in child processes; None changes nothing.

    Raises:
        DeviceError: The device is not available.
    """
    if device is not None:
        os.environ[VARIABLE] = device
    if searches_on_gpu():
        # Imported here: torch takes two seconds to load, and may be absent.
        from advnerf_core.scene.device import gpu

        gpu()
