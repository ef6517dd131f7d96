"""Ways to compute on a device: numba-cuda's kernels, or plain torch. `agreement` chooses one."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numba
import torch

from advnerf_core.errors import DeviceError


@dataclass(frozen=True)
class Accelerator:
    """A device, and how it computes.

    Attributes:
        device: Where tensors are.
        compiled: Whether numba-cuda's kernels draw objects and baked scenes; otherwise plain torch does, on any device.
    """

    device: torch.device
    compiled: bool = False

    @property
    def name(self) -> str:
        """Name of the device and of the way it computes."""
        name = torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else str(self.device)
        return f"{name}, {'numba-cuda' if self.compiled else 'plain torch'}"


def use_exact_arithmetic() -> None:
    """Deterministic bits, and no convolutions and products in TF32: gradients keep their direction."""
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False


def gpu() -> torch.device:
    """The GPU that torch uses.

    Raises:
        DeviceError: torch sees none.
    """
    if not torch.cuda.is_available():
        raise DeviceError(
            "expected an NVIDIA GPU that torch can use, but torch sees none; make nvidia-smi work, and install a torch built for CUDA "
            "(docs/performance.md); without --device cuda the processor searches"
        )
    return torch.device("cuda", torch.cuda.current_device())


def is_simulated() -> bool:
    """Whether kernels run in numba's simulator, on the CPU."""
    return bool(numba.config.ENABLE_CUDASIM)  # type: ignore[attr-defined]


def ways() -> list[Accelerator]:
    """Ways to search on a GPU, the fastest first; in numba's simulator only the simulated one.

    Raises:
        DeviceError: There is no GPU.
    """
    if is_simulated():
        return [Accelerator(torch.device("cpu"), compiled=True)]
    device, compiler = gpu(), importlib.util.find_spec("numba_cuda")
    return [Accelerator(device, compiled) for compiled in (True, False) if compiler or not compiled]
