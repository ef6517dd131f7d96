"""Checks that a training learns: after some steps, and on pictures that it did not see, it must be better than one colour for all pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import OPAQUE
from advnerf_core.data.views import ImageSet
from advnerf_core.scene.train_config import TrainingReport

AFTER_STEPS = 100
# Pictures with the inverses of their poses are learned one by one: held-out ones stay near one colour.
_BETTER_DB, _HELD_OUT_BETTER_DB = 1.0, 3.0
_CAUSES = "the box, --near, and the poses (axes, unit, from camera to world and not the inverse, one line for each image)"
# Pictures that are nearly of one colour are no test of a training.
_PLAIN_DB = 35.0
_MOST_PIXELS = 1 << 20


class LearningCheck:
    """Reports once if a training does not learn."""

    def __init__(self, images: ImageSet) -> None:
        self._one_colour_db = one_colour_db(images.rgb)
        self._done = images.transparent or self._one_colour_db > _PLAIN_DB

    def __call__(self, at: TrainingReport) -> str | None:
        """A sentence about the problem, at the first report after 100 steps; None if there is no problem."""
        if self._done or at.step < AFTER_STEPS:
            return None
        self._done = True
        if at.psnr_db > self._one_colour_db + _BETTER_DB:
            return None
        return (
            f"after {at.step} steps nothing is learned: {at.psnr_db:.1f} dB on training rays, one colour for all gives "
            f"{self._one_colour_db:.1f} dB; check {_CAUSES}"
        )


def held_out_problem(psnr_db: float, images: ImageSet) -> str | None:
    """A sentence if a finished scene shows held-out pictures hardly better than one colour; None otherwise, and for transparent pictures.

    Args:
        psnr_db: Mean PSNR of the pictures [dB].
        images: The pictures.
    """
    if images.transparent or beats_one_colour(psnr_db, images.rgb):
        return None
    plain_db = one_colour_db(images.rgb)
    reached = f"held-out pictures reach {psnr_db:.1f} dB, one colour for all gives {plain_db:.1f} dB"
    if plain_db > _PLAIN_DB:
        return f"{reached}: they are nearly of one colour, and this PSNR says nothing; take brighter pictures, or such that show more"
    return f"{reached}: the scene is no copy of the place; train longer, or check {_CAUSES}"


def beats_one_colour(psnr_db: float, rgb: NDArray[np.uint8]) -> bool:
    """Whether a PSNR of pixels ``[..., 3]`` [dB] is clearly above that of one colour for all of them."""
    return psnr_db > one_colour_db(rgb) + _HELD_OUT_BETTER_DB


def one_colour_db(rgb: NDArray[np.uint8]) -> float:
    """PSNR of all pixels ``[..., 3]`` against their mean colour [dB], which a scene without content reaches."""
    step = max(1, rgb[..., 0].size // _MOST_PIXELS)
    pixels = rgb.reshape(-1, 3)[::step].astype(np.float64) / OPAQUE
    return float(-10.0 * np.log10(max(pixels.var(axis=0).mean(), 1e-12)))
