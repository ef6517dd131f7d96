"""The devices that tests compare with the processor's kernels."""

import pytest
import torch

CPU, GPU = torch.device("cpu"), torch.device("cuda")
DEVICES = [
    pytest.param(CPU, id="CPU"),
    pytest.param(
        GPU,
        id="GPU",
        marks=[
            pytest.mark.gpu,
            pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
        ],
    ),
]
