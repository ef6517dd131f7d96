"""Families of random textures: what each promises, measured on many draws."""

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from advnerf_core.attack.search import textures
from advnerf_core.attack.search.population import Coarse
from advnerf_core.fields.colour_grid import ColourGrid

EDGE = 48
FAMILIES = {
    "coarse": textures.coarse(8),
    "levels": textures.levels,
    "pink": textures.pink,
    "natural": textures.natural,
    "white": textures.TRAINED_WITH["random"],
    "patterns": textures.TRAINED_WITH["patterns"],
}


def whole(*shape):
    return ColourGrid(shape, torch.from_numpy(np.argwhere(np.ones(shape))))


def shell():
    """The seen voxels of a ball."""
    distance = np.linalg.norm(np.indices((14, 12, 16)).T - [6.5, 5.5, 7.5], axis=-1).T
    return ColourGrid((14, 12, 16), torch.from_numpy(np.argwhere(np.abs(distance - 4.5) < 1.0)))


FACE = whole(EDGE, EDGE)


def draws(family, grid, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([FAMILIES[family](grid, generator) for _ in range(count)])


@pytest.mark.parametrize("grid", [FACE, whole(20, 32), shell()], ids=["face", "oblong", "voxels"])
@pytest.mark.parametrize("family", FAMILIES)
def test_all_families_have_the_same_spread(family, grid):
    drawn = draws(family, grid, 1600 if family == "patterns" else 16 if len(grid.shape) == 3 else 120)
    # A whole texture of natural leaves or of pink noise counts as few independent values, and a pattern has two.
    assert drawn.square().mean().sqrt().item() == pytest.approx(1.0, abs=0.05)
    assert abs(drawn.mean().item()) < 0.1
    channels = np.corrcoef(drawn.reshape(-1, 3).T.numpy())
    assert np.abs(channels - np.eye(3)).max() < 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_a_seed_says_what_is_drawn(family):
    first, again, other = (draws(family, shell(), 2, seed) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])


def test_patterns_are_stripes_checks_and_areas_of_two_colours():
    drawn = draws("patterns", FACE, 200)
    colours = [set(map(tuple, texture.tolist())) for texture in drawn]
    assert {len(each) for each in colours} == {1, 2}
    assert 10 <= sum(len(each) == 1 for each in colours) <= 100
    # Borders of all directions: as many between rows as between columns.
    pictures = drawn.reshape(200, EDGE, EDGE, 3)[..., 0]
    rows = (pictures[:, 1:] != pictures[:, :-1]).float().mean()
    columns = (pictures[:, :, 1:] != pictures[:, :, :-1]).float().mean()
    assert rows / columns == pytest.approx(1.0, abs=0.15)
    assert 0.02 < rows < 0.3


def basis(rows, columns, cells):
    """Bilinear interpolation of ``cells x cells`` values as a matrix ``[rows * columns, cells^2]``, from the unit pictures."""
    units = torch.eye(cells**2).reshape(-1, 1, cells, cells)
    return interpolate(units, (rows, columns), mode="bilinear").reshape(cells**2, -1).T


def test_coarse_textures_lie_in_the_space_that_populations_search():
    drawn = draws("coarse", FACE, 1)[0].double()
    columns = Coarse((EDGE, EDGE, 3), 8)
    units = [
        columns.expand(torch.eye(64)[k].reshape(8, 8, 1).expand(8, 8, 3))[..., 0].flatten() for k in range(64)
    ]
    matrix = torch.stack(units, dim=1).double()
    left = drawn - matrix @ torch.linalg.lstsq(matrix, drawn).solution
    assert left.abs().max() < 1e-5
    few = draws("coarse", whole(6, 6), 400)  # no more cells than it has
    neighbours = np.corrcoef(few[:, 0, 0], few[:, 1, 0])[0, 1]
    assert abs(neighbours) < 0.15


def test_levels_have_equal_variance_and_are_those_of_summed_levels():
    edge = 32
    sizes = sorted({min(round(float(n)), edge) for n in np.geomspace(2, 64, 16)})
    assert sizes[0] == 2
    assert sizes[-1] == edge
    generator = torch.Generator().manual_seed(3)
    expected = torch.zeros(edge * edge, 3)
    for n in sizes:
        matrix = basis(edge, edge, n)
        level = matrix @ torch.randn((1, 3, n, n), generator=generator).reshape(3, -1).T
        expected += (
            level / matrix.square().sum(1).mean().sqrt()
        )  # variance one, whatever the interpolation takes
    found = textures.levels(whole(edge, edge), torch.Generator().manual_seed(3))
    torch.testing.assert_close(found, expected / len(sizes) ** 0.5, rtol=1e-4, atol=1e-5)


def power_slope(pictures):
    """Exponent of the power of pictures ``[N, n, n]`` over frequency, fitted between the lowest and half the highest."""
    n = pictures.shape[1]
    power = (np.abs(np.fft.fft2(pictures)) ** 2).mean(0)
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    fitted = (f > 1.5 / n) & (f < 0.25)
    return np.polyfit(np.log(f[fitted]), np.log(power[fitted]), 1)[0]


def test_pink_noise_has_amplitudes_of_one_over_f():
    pictures = draws("pink", FACE, 40).permute(0, 2, 1).reshape(-1, EDGE, EDGE).numpy()
    assert power_slope(pictures) == pytest.approx(-2.0, abs=0.1)
    white = np.random.default_rng(0).standard_normal(pictures.shape)
    assert abs(power_slope(white)) < 0.1
    # What is seen of a box is its surface: every cut is 1/f, too.
    box = draws("pink", whole(32, 32, 32), 6).reshape(6, 32, 32, 32, 3)
    cuts = box.permute(0, 1, 4, 2, 3).reshape(-1, 32, 32).numpy()
    assert power_slope(cuts) == pytest.approx(-2.0, abs=0.2)


def kurtosis(values):
    return float((values**4).mean() / (values**2).mean() ** 2)


def test_natural_textures_have_edges_and_others_have_none():
    def pictures_of(family, count):
        return draws(family, FACE, count).reshape(count, EDGE, EDGE, 3)

    def steps(pictures):
        return (pictures[:, :, 1:] - pictures[:, :, :-1]).flatten()

    white = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    assert kurtosis(white) == pytest.approx(3.0, abs=0.1)
    assert kurtosis(steps(pictures_of("pink", 10))) < 4.0
    pictures = pictures_of("natural", 40)
    assert kurtosis(steps(pictures)) > 8.0
    # Scale-invariant: neighbours are much alike, places half a face apart are hardly.
    near = np.corrcoef(pictures[:, :, 1:].flatten(), pictures[:, :, :-1].flatten())[0, 1]
    far = np.corrcoef(pictures[:, :, 24:].flatten(), pictures[:, :, :-24].flatten())[0, 1]
    assert near > 0.7
    assert abs(far) < 0.35
