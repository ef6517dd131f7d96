"""Which device a search uses: a matter of the machine, not of the experiment. It is no key of a configuration, and no hash has it.

Results differ in their last bits between a processor and a GPU, and so does what a chaotic drive makes of them.
"""

from __future__ import annotations

import os

from advnerf_core.errors import DeviceError

VARIABLE = "ADVNERF_DEVICE"
_CPU, _CUDA = "cpu", "cuda"


def searches_on_gpu() -> bool:
    """Whether the environment variable ``ADVNERF_DEVICE`` asks for a GPU; without it the processor searches.

    Raises:
        DeviceError: It names something else than cpu or cuda.
    """
    named = os.environ.get(VARIABLE) or _CPU
    if named not in (_CPU, _CUDA):
        raise DeviceError(f"expected cpu or cuda in {VARIABLE}, got {named!r}")
    return named == _CUDA


def use_device(device: str | None) -> None:
    """Search on ``cpu`` or ``cuda`` from now on, also in processes that are started from here; None leaves it as it is.

    Raises:
        DeviceError: There is no such device.
    """
    if device is not None:
        os.environ[VARIABLE] = device
    if searches_on_gpu():
        # Only here: torch and the compiler of kernels for a GPU take two seconds to load, and may be absent.
        from advnerf_core.render.cuda_launch import cuda_device

        cuda_device()
