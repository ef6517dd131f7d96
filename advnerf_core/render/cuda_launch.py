"""Runs numba's CUDA kernels on torch's tensors, or in numba's simulator on a machine without a device.

With ``NUMBA_ENABLE_CUDASIM=1`` in the environment, numba runs each CUDA thread as Python code: thousands of times slower, but the same
source line by line. The tests use it on machines without a device; tensors then stay on the CPU.
"""

from __future__ import annotations

from typing import Any

import torch
from numba import config, cuda
from torch import Tensor

from advnerf_core.errors import DeviceError

_THREADS = 64  # per block: rays of a block end at different times, and a small block waits for fewer


def is_simulated() -> bool:
    """Whether kernels run in numba's simulator."""
    return bool(config.ENABLE_CUDASIM)  # type: ignore[attr-defined]


def cuda_device() -> torch.device:
    """Device of tensors that the kernels can read.

    Raises:
        DeviceError: No device is available.
    """
    if is_simulated():
        return torch.device("cpu")
    for sees, what in ((torch.cuda.is_available, "torch"), (cuda.is_available, "numba")):
        if not sees():
            raise DeviceError(
                f"expected an NVIDIA GPU that torch and numba can use, but {what} sees none; make nvidia-smi work, and install a torch "
                "built for CUDA and the extra gpu (docs/performance.md); without --device cuda the processor searches"
            )
    return torch.device("cuda", torch.cuda.current_device())


def launch(kernel: Any, threads: int, *arguments: Any) -> None:
    """Run a kernel after the work that torch has queued.

    Args:
        kernel: Kernel of ``numba.cuda.jit``; it returns at once if ``cuda.grid(1)`` is not below ``threads``.
        threads: Number of threads; 0 runs nothing.
        arguments: Tensors on `cuda_device` without history, and numbers.
    """
    blocks = -(-threads // _THREADS)
    if blocks == 0:
        return
    if is_simulated():
        # One after the other: threads of Python would only wait for each other.
        kernel[threads, 1](*(each.numpy() if isinstance(each, Tensor) else each for each in arguments))
        return
    stream = cuda.external_stream(torch.cuda.current_stream().cuda_stream)
    kernel[blocks, _THREADS, stream](
        *(cuda.as_cuda_array(each) if isinstance(each, Tensor) else each for each in arguments)
    )
