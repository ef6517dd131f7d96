"""Runs numba's CUDA kernels on torch's tensors, or in numba's simulator on a machine without a device.

With ``NUMBA_ENABLE_CUDASIM=1`` in the environment, numba runs each CUDA thread as Python code: thousands of times slower, but the same
source line by line. The tests use it on machines without a device; tensors then stay on the CPU.
"""

from __future__ import annotations

from typing import Any

import torch
from numba import config, cuda
from torch import Tensor

_THREADS = 64  # per block: rays of a block end at different times, and a small block waits for fewer


def launch(kernel: Any, threads: int, *arguments: Any) -> None:
    """Run a kernel after the work that torch has queued.

    Args:
        kernel: Kernel of ``numba.cuda.jit``; it returns at once if ``cuda.grid(1)`` is not below ``threads``.
        threads: Number of threads; 0 runs nothing.
        arguments: Tensors on the GPU without history, and numbers.
    """
    blocks = -(-threads // _THREADS)
    if blocks == 0:
        return
    if config.ENABLE_CUDASIM:  # type: ignore[attr-defined]
        # One after the other: threads of Python would only wait for each other.
        kernel[threads, 1](*(each.numpy() if isinstance(each, Tensor) else each for each in arguments))
        return
    stream = cuda.external_stream(torch.cuda.current_stream().cuda_stream)
    kernel[blocks, _THREADS, stream](
        *(cuda.as_cuda_array(each) if isinstance(each, Tensor) else each for each in arguments)
    )
