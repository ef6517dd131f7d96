"""Pictures with the statistics of natural ones, made by a generator: leaves that fall on each other.

Discs of random colours occlude one another, and their radii follow a power law, so that the picture looks alike at every scale: Lee, Mumford and
Huang 2001, "Occlusion models for natural images: a statistical study of a scale-invariant dead leaves model". Leaves are drawn from
the front until no place is left open, which gives an exact sample (Kendall and Thoennes 1999, "Perfect simulation in stochastic geometry").
Each leaf is shaded by its own linear gradient, like a lit surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Radii in units of the longest edge. Below the smallest, a face of 64 cells has no room for a disc; the largest covers most of it.
_LEAST_RADIUS, _LARGEST_RADIUS = 1.0 / 32.0, 0.5
_SHADING = 0.25  # share of the variance due to the gradients within leaves
_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class _Leaves:
    """Leaves, front to back.

    Attributes:
        centres: ``[N, d]``.
        radii: ``[N]``.
        colours: Colours at their centres ``[N, 3]``.
        slopes: Change of each channel from the centre to the edge along each axis ``[N, 3, d]``.
    """

    centres: Tensor
    radii: Tensor
    colours: Tensor
    slopes: Tensor


def dead_leaves(places: Tensor, generator: torch.Generator) -> Tensor:
    """Values ``[M, 3]`` of three channels at places ``[M, d]`` in the unit box; each is of mean zero and variance one.

    Args:
        places: Float, in two dimensions or three.
    """
    values = places.new_zeros(len(places), 3)
    uncovered = torch.arange(len(places))
    extent = places.amax(0)
    while len(uncovered):
        leaves = _drawn(extent, generator)
        inside = torch.cdist(places[uncovered], leaves.centres) <= leaves.radii
        covered = inside.any(1)
        if not covered.any():  # most leaves fall beside the last open places
            continue
        rows, top = uncovered[covered], inside[covered].to(torch.uint8).argmax(1)
        values[rows] = _shown(leaves, top, places[rows])
        uncovered = uncovered[~covered]
    return values


def _drawn(extent: Tensor, generator: torch.Generator) -> _Leaves:
    """Leaves such that each place of ``extent [d]`` is equally likely to see any part of one."""
    dims = len(extent)
    # The density of radii is r^-(d+1): r^-3 on a plane, as of Lee et al., and plane cuts of balls have it too.
    share = torch.rand(_AT_ONCE, generator=generator)
    power = torch.lerp(torch.tensor(_LEAST_RADIUS**-dims), torch.tensor(_LARGEST_RADIUS**-dims), share)
    window = extent + 2.0 * _LARGEST_RADIUS
    centres = window * torch.rand((_AT_ONCE, dims), generator=generator) - _LARGEST_RADIUS
    colours = torch.randn((_AT_ONCE, 3), generator=generator)
    slopes = torch.randn((_AT_ONCE, 3, dims), generator=generator)
    return _Leaves(centres, power ** (-1.0 / dims), colours, slopes)


def _shown(leaves: _Leaves, top: Tensor, places: Tensor) -> Tensor:
    """Values ``[M, 3]`` of the leaves ``top [M]`` at places ``[M, d]``."""
    dims = places.shape[1]
    offset = (places - leaves.centres[top]) / leaves.radii[top, None]
    # A place in a leaf is uniform in it, so each component of the offset has variance 1 / (d + 2).
    shade = torch.einsum("mcd,md->mc", leaves.slopes[top], offset) * ((dims + 2.0) / dims) ** 0.5
    return (1.0 - _SHADING) ** 0.5 * leaves.colours[top] + _SHADING**0.5 * shade
