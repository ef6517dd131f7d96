"""Image fidelity: PSNR, SSIM, and the best fitting gain before either."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter


def psnr(image: ArrayLike, reference: ArrayLike) -> float:
    """Peak signal-to-noise ratio [dB] of images with values in 0..1 (uint8 is divided by 255); infinite if equal."""
    a, b = _unit(image), _unit(reference)
    _same_shape(a.shape, b.shape)
    mse = float(np.mean((a - b) ** 2))
    return float("inf") if mse == 0.0 else -10.0 * float(np.log10(mse))


def gain_fitted(image: ArrayLike, reference: ArrayLike, background: ArrayLike = 0.0) -> np.ndarray:
    """The image times the gain per channel that brings it closest to the reference, by least squares; clipped to 0..1.

    For comparing a photograph whose exposure the scene cannot know. The figure is no substitute for the plain PSNR: it does not
    count wrong brightness or tint.

    Args:
        image: Colours ``[..., 3]`` in 0..1 (uint8 is divided by 255).
        reference: Expected colours, same shape.
        background: Part of both that is exempt from the gain, e.g. white behind transparent pixels; broadcast to ``image``.
    """
    a, b = _unit(image), _unit(reference)
    _same_shape(a.shape, b.shape)
    behind = np.broadcast_to(np.asarray(background, np.float64), a.shape)
    ours, theirs = (a - behind).reshape(-1, 3), (b - behind).reshape(-1, 3)
    gains = (ours * theirs).sum(axis=0) / np.maximum((ours * ours).sum(axis=0), 1e-12)
    return np.clip(behind + gains * (a - behind), 0.0, 1.0)


def ssim(image: ArrayLike, reference: ArrayLike) -> float:
    """Structural similarity of images ``[H, W, C]``, mean over pixels and channels.

    Wang et al. 2004, "Image quality assessment", equation 13: Gaussian window, sigma 1.5, 11 x 11; K1 = 0.01, K2 = 0.03. Unlike
    the original, borders are reflected instead of left out.
    """
    a, b = _unit(image), _unit(reference)
    _same_shape(a.shape, b.shape)

    def blur(values: np.ndarray) -> np.ndarray:
        return np.asarray(gaussian_filter(values, sigma=(1.5, 1.5, 0.0), truncate=3.5))

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    score = (
        (2 * mean_a * mean_b + c1)
        * (2 * covariance + c2)
        / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    )
    return float(score.mean())


def _unit(image: ArrayLike) -> np.ndarray:
    values = np.asarray(image)
    return values / 255.0 if values.dtype == np.uint8 else values.astype(np.float64)


def _same_shape(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    if a != b:
        raise ValueError(f"expected two images of one shape, got {a} and {b}")
