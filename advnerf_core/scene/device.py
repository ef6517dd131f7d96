"""The GPU that torch uses, and arithmetic on it that gives the processor's numbers."""

from __future__ import annotations

import torch

from advnerf_core.errors import DeviceError


def device_name(device: torch.device) -> str:
    """Name of a GPU, or the type of another device."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


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
