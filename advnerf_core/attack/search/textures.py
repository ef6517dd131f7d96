"""Families of random textures that differ only in their spatial structure.

Each family draws one value of spread one for every row of theta and every channel: its variance, averaged over the cells of the grid, is one in
expectation. Channels are independent. Multiplied by the same sigma, textures of all families are equally strong in contrast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from advnerf_core.attack.search.dead_leaves import dead_leaves
from advnerf_core.fields.colour_grid import ColourGrid

Family = Callable[[ColourGrid, torch.Generator], Tensor]
"""Draws ``[rows, 3]`` float32 for a grid."""

_LEVELS, _COARSEST, _FINEST = 16, 2, 64
# Stripes and checks repeat after an eighth of the longest edge or more; well beyond its length they are a border between two colours, or one.
_SHORTEST, _LONGEST = 1.0 / 8.0, 16.0


def white(grid: ColourGrid, generator: torch.Generator) -> Tensor:
    """Independent values of all cells, as the method ``random`` draws them."""
    return torch.randn((len(grid.cells), 3), generator=generator)


def coarse(cells: int) -> Family:
    """White noise on ``cells`` along each edge, interpolated linearly: on a face, the space that ``cem`` and ``evolution`` search.

    Where the grid is not finer than that, it is white noise on the grid.
    """

    def draw(grid: ColourGrid, generator: torch.Generator) -> Tensor:
        finer = [0 < cells < edge for edge in grid.shape]
        sizes = [cells if is_finer else edge for is_finer, edge in zip(finer, grid.shape, strict=True)]
        return _smooth_noise(grid, sizes, generator)

    return draw


def levels(grid: ColourGrid, generator: torch.Generator) -> Tensor:
    """Sum of levels of 2 to 64 cells along each edge, each with the same variance, as far as the grid resolves them.

    The sizes match `advnerf_core.fields.summed_levels`: up to 16, growing geometrically.
    """
    wanted = torch.logspace(math.log2(_COARSEST), math.log2(_FINEST), _LEVELS, base=2.0)
    longest = max(grid.shape)
    sizes = sorted({min(round(float(n)), longest) for n in wanted})
    drawn = [_smooth_noise(grid, [n] * len(grid.shape), generator) for n in sizes]
    return torch.stack(drawn).sum(0) / math.sqrt(len(sizes))


def pink(grid: ColourGrid, generator: torch.Generator) -> Tensor:
    """Noise with equal power in every octave: amplitudes ``f^(-d/2)`` in d dimensions, periodic at the edges.

    On a texture this is 1/f, as in natural images (Field 1987, "Relations between the statistics of natural images and the response
    properties of cortical cells"). In a box it is ``f^-1.5``, and every plane cut of it is 1/f again. The mean counts as the lowest frequency.
    """
    axes = tuple(range(1, len(grid.shape) + 1))
    along = [torch.fft.fftfreq(n) for n in grid.shape]
    frequency = torch.stack(torch.meshgrid(*along, indexing="ij")).norm(dim=0)
    amplitude = frequency.clamp_min(1.0 / max(grid.shape)) ** (-0.5 * len(grid.shape))
    amplitude /= amplitude.square().mean().sqrt()
    white = torch.randn((3, *grid.shape), generator=generator)
    noise = torch.fft.ifftn(torch.fft.fftn(white, dim=axes) * amplitude, dim=axes).real
    at = (slice(None), *grid.cells.T)
    return noise[at].T.contiguous()


def natural(grid: ColourGrid, generator: torch.Generator) -> Tensor:
    """Occluding shaded discs, or balls in a box, see `dead_leaves`; the longest edge has length one."""
    return dead_leaves(_to_scale(grid), generator)


def patterns(grid: ColourGrid, generator: torch.Generator) -> Tensor:
    """Stripes or checks of two colours at any angle and of any width, or areas of one colour: for training, as no search draws them."""
    places = _to_scale(grid)
    angles = torch.linalg.qr(torch.randn((places.shape[1], 2), generator=generator))[0]
    drawn = torch.rand(4, generator=generator)
    shortest, longest = math.log(_SHORTEST), math.log(_LONGEST)
    waves = torch.exp(shortest + (longest - shortest) * drawn[:2])
    above = torch.sin(2.0 * math.pi * (places @ angles / waves + drawn[2:])) > 0.0
    checked = bool(torch.rand(1, generator=generator) < 0.5)
    first = above[:, 0] ^ above[:, 1] if checked else above[:, 0]
    colours = torch.randn((2, 3), generator=generator)
    return torch.where(first[:, None], colours[0], colours[1])


TRAINED_WITH: Mapping[str, Family] = {
    "random": white,
    "patterns": patterns,
}
"""The families that may train a victim, by name: the others are for searches and for judging it."""


def _to_scale(grid: ColourGrid) -> Tensor:
    """Centres of the cells, the longest edge of length one, ``[rows, d]``."""
    return (grid.cells + 0.5) / max(grid.shape)


def _smooth_noise(grid: ColourGrid, sizes: Sequence[int], generator: torch.Generator) -> Tensor:
    """White noise at the centres of ``sizes`` cells along the edges, interpolated linearly, of variance one in the mean over the grid."""
    noise = torch.randn((1, 3, *sizes), generator=generator)
    # grid_sample wants x first, in -1..1.
    where = (2.0 * grid.places - 1.0).flip(1).reshape(1, -1, *[1] * (len(sizes) - 1), len(sizes))
    drawn = torch.nn.functional.grid_sample(
        noise, where, mode="bilinear", padding_mode="border", align_corners=False
    )
    return drawn.reshape(3, -1).T / _kept_variance(grid, sizes).sqrt()


def _kept_variance(grid: ColourGrid, sizes: Sequence[int]) -> Tensor:
    """Variance that interpolation leaves of independent values of variance one, in the mean over the grid."""
    counts = torch.tensor(sizes)
    position = torch.minimum((grid.places * counts - 0.5).clamp_min(0.0), counts - 1.0)
    share = position - position.floor()
    return ((1.0 - share).square() + share.square()).prod(dim=1).mean()
