"""The module of an array, so that the contract's conversions are written once for numpy on the car and torch where gradients are needed."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np


def array_module(array: Any) -> Any:
    """``numpy`` for an array of numpy, ``torch`` for a tensor; never imports torch."""
    return np if isinstance(array, np.ndarray) else importlib.import_module("torch")


def like(array: Any, values: Any) -> Any:
    """Values as an array of another one's kind, element type and device."""
    if hasattr(array, "new_tensor"):
        return array.new_tensor(values)
    return np.asarray(values, dtype=array.dtype)
