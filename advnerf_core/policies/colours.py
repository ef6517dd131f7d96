"""Converts RGB to the colours that a network was trained on (numpy or torch; differentiable)."""

from __future__ import annotations

from typing import Any, Literal

from advnerf_core.policies.arrays import like

ColourSpace = Literal["RGB", "BGR", "YUV", "GRAY"]
# Full-range YUV of BT.601 with U and V about one half, and grey, both as OpenCV's COLOR_RGB2YUV and COLOR_RGB2GRAY.
_LUMA = (0.299, 0.587, 0.114)
_RGB_IN_YUV = (
    (0.299, -0.492 * 0.299, 0.877 * 0.701),
    (0.587, -0.492 * 0.587, -0.877 * 0.587),
    (0.114, 0.492 * 0.886, -0.877 * 0.114),
)


def in_colour_space(images: Any, space: ColourSpace) -> Any:
    """Images ``[B, C, H, W]`` in 0..1 of RGB images ``[B, 3, H, W]`` in 0..1."""
    if space == "RGB":
        return images
    if space == "BGR":
        return images[:, [2, 1, 0]]
    if space == "GRAY":
        return _LUMA[0] * images[:, 0:1] + _LUMA[1] * images[:, 1:2] + _LUMA[2] * images[:, 2:3]
    # One colour at a time, each copied into three channels: the same code for numpy and torch.
    parts = [images[:, [k] * 3] * of_channels(images, weights) for k, weights in enumerate(_RGB_IN_YUV)]
    return (parts[0] + parts[1] + parts[2] + of_channels(images, (0.0, 0.5, 0.5))).clip(0.0, 1.0)


def of_channels(images: Any, values: tuple[float, ...]) -> Any:
    """A value for each channel, or one for all, in a shape that broadcasts with images ``[B, C, H, W]``."""
    return like(images, values).reshape(1, -1, 1, 1)
