"""Checks that a training learns: after some steps it must be better than one colour for all pixels."""

from __future__ import annotations

import numpy as np

from advnerf_core.data.image_files import OPAQUE
from advnerf_core.data.views import ImageSet
from advnerf_core.scene.train_config import TrainingReport

AFTER_STEPS = 100
_BETTER_DB = 1.0
# Pictures that are nearly of one colour are no test.
_PLAIN_DB = 35.0
_MOST_PIXELS = 1 << 20


class LearningCheck:
    """Reports once if a training does not learn."""

    def __init__(self, images: ImageSet) -> None:
        self._one_colour_db = one_colour_db(images)
        self._done = images.alpha is not None or self._one_colour_db > _PLAIN_DB

    def __call__(self, at: TrainingReport) -> str | None:
        """A sentence about the problem, at the first report after 100 steps; None if there is no problem."""
        if self._done or at.step < AFTER_STEPS:
            return None
        self._done = True
        if at.psnr_db > self._one_colour_db + _BETTER_DB:
            return None
        return (
            f"after {at.step} steps nothing is learned: {at.psnr_db:.1f} dB on training rays, one colour for all gives "
            f"{self._one_colour_db:.1f} dB; check the box, --near, and the poses (axes, unit, one line for each image)"
        )


def one_colour_db(images: ImageSet) -> float:
    """PSNR of all pixels against their mean colour [dB], which a scene without content reaches."""
    step = max(1, images.rgb[..., 0].size // _MOST_PIXELS)
    pixels = images.rgb.reshape(-1, 3)[::step].astype(np.float64) / OPAQUE
    return float(-10.0 * np.log10(max(pixels.var(axis=0).mean(), 1e-12)))
