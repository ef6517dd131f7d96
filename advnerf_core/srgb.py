"""The sRGB curve (IEC 61966-2-1) between linear light and display values, both in 0..1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_linear(display: ArrayLike) -> NDArray[np.float64]:
    """Linear light of display values."""
    values = np.asarray(display, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def to_display(light: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Display values of linear light, in its precision."""
    bent = 1.055 * np.power(np.maximum(light, 0.0031308), 1.0 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, bent)
