"""The number type of a policy's layers in training and in gradients: bfloat16 where the processor multiplies it, else float32."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

_PROCESSOR = Path("/proc/cpuinfo")
# Instructions that multiply bfloat16, as Linux names them; without one, torch would convert each number first.
_MULTIPLIES = {"avx512_bf16", "amx_bf16"}


@cache
def layer_type(processor: Path = _PROCESSOR) -> torch.dtype:
    """Number type of layers on this machine; weights, moments and sums are float32 in either.

    Args:
        processor: Linux's description of the machine's processors.
    """
    try:
        lines = processor.read_text().splitlines()
    except OSError:  # not Linux
        return torch.float32
    flags = next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), [])
    return torch.bfloat16 if _MULTIPLIES & set(flags) else torch.float32
