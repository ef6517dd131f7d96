"""The ways to compute on a device that tests compare with the processor."""

import pytest
import torch
from numba import config

from advnerf_core.scene.accelerator import Accelerator

CPU, GPU = torch.device("cpu"), torch.device("cuda")
# Numba's kernels run without a device in its simulator, see `test_cuda_simulated`.
SIMULATED = bool(config.ENABLE_CUDASIM)
WITH_GPU = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not (torch.cuda.is_available() or SIMULATED),
        reason="needs a CUDA device, or NUMBA_ENABLE_CUDASIM=1",
    ),
]
WAYS = [
    pytest.param(Accelerator(CPU), id="torch, CPU"),
    pytest.param(Accelerator(CPU if SIMULATED else GPU, compiled=True), id="numba-cuda", marks=WITH_GPU),
    *([] if SIMULATED else [pytest.param(Accelerator(GPU), id="torch, GPU", marks=WITH_GPU)]),
]
