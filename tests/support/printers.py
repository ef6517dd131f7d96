"""A printer whose inks are known: dots that spread, by Yule, Nielsen and Neugebauer; and the display model that is equal to it."""

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.display import DisplayModel
from advnerf_core.geometry import Array

# Linear sRGB reflectances of paper, of each ink, and of inks on one another: cyan, magenta and yellow, 1 where there is ink.
INKS = {
    (0, 0, 0): (0.86, 0.87, 0.85), (1, 0, 0): (0.06, 0.28, 0.56), (0, 1, 0): (0.52, 0.06, 0.17), (0, 0, 1): (0.80, 0.70, 0.08),
    (0, 1, 1): (0.46, 0.05, 0.03), (1, 0, 1): (0.05, 0.26, 0.09), (1, 1, 0): (0.06, 0.05, 0.18), (1, 1, 1): (0.03, 0.03, 0.03),
}  # fmt: skip


def printed(rgb: ArrayLike) -> Array:
    """Linear reflectance ``[..., 3]`` of sRGB colours in 0..1."""
    dots = 1.0 - np.asarray(rgb)
    dots = dots + 0.36 * dots * (1.0 - dots)
    root = np.zeros_like(dots)
    for inks, reflectance in INKS.items():
        share = np.prod(np.where(inks, dots, 1.0 - dots), axis=-1, keepdims=True)
        root = root + share * np.sqrt(reflectance)
    return np.asarray(root**2)


def printer_model(levels: int = 17) -> DisplayModel:
    """The model whose seen colours are `printed` at its levels: the polynomial through the roots of the eight reflectances."""
    bare = 1.0 - np.linspace(0.0, 1.0, levels)
    curve = 1.0 - (bare + 0.36 * bare * (1.0 - bare))
    root = {tuple(1 - np.array(inks)): np.sqrt(reflectance) for inks, reflectance in INKS.items()}
    black, ones = root[0, 0, 0], [root[tuple(row)] for row in np.eye(3, dtype=int)]
    twos = {(0, 1): root[1, 1, 0], (1, 2): root[0, 1, 1], (0, 2): root[1, 0, 1]}
    pairs = [both - ones[a] - ones[b] + black for (a, b), both in twos.items()]
    triple = root[1, 1, 1] - sum(twos.values()) + sum(ones) - black
    mixing = np.stack([one - black for one in ones], axis=1)
    return DisplayModel(np.tile(curve, (3, 1)), mixing, black, 0.5, 0.0, np.stack([*pairs, triple], axis=1))
