import numpy as np
import pytest
import torch

from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig, encode, encode_reference, scatter

SMALL = HashGridConfig(levels=4, features=2, log2_entries=8, coarsest=3, finest=24)


def random_grid(config: HashGridConfig = SMALL) -> HashGrid:
    grid = HashGrid(config, torch.Generator().manual_seed(0))
    with torch.no_grad():
        grid.table.normal_(generator=torch.Generator().manual_seed(1))
    return grid


def test_levels_are_dense_while_they_fit_and_hashed_after() -> None:
    levels = SMALL.level_table()
    assert levels[:, 1].tolist() == [3, 6, 12, 24]
    assert levels[:, 3].tolist() == [1, 0, 0, 0]
    assert levels[:, 0].tolist() == [0, 64, 64 + 256, 64 + 512]
    assert SMALL.entries == 64 + 3 * 256


def test_a_dense_level_interpolates_a_linear_function_exactly() -> None:
    grid = HashGrid(HashGridConfig(levels=1, features=2, log2_entries=12, coarsest=8, finest=8))
    nodes = torch.stack(torch.meshgrid(*[torch.arange(9) / 8.0] * 3, indexing="ij"), -1)
    with torch.no_grad():  # x is fastest in the table
        grid.table[:, 0] = (nodes @ torch.tensor([1.0, -2.0, 0.5])).permute(2, 1, 0).reshape(-1)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    np.testing.assert_allclose(
        grid(points)[:, 0].detach(), points @ torch.tensor([1.0, -2.0, 0.5]), atol=1e-6
    )


@pytest.mark.parametrize("features", [2, 4, 8])
def test_kernels_agree_with_plain_torch(features: int) -> None:
    grid = random_grid(HashGridConfig(levels=6, features=features, log2_entries=10, coarsest=4, finest=300))
    points = (
        torch.rand(3001, 3, generator=torch.Generator().manual_seed(3)) * 1.2 - 0.1
    )  # some outside: clamped
    expected = encode_reference(points, grid.table, grid.levels)
    np.testing.assert_allclose(grid(points).detach(), expected.detach(), atol=1e-6)
    weights = torch.randn(expected.shape, generator=torch.Generator().manual_seed(4))
    (reference,) = torch.autograd.grad((expected * weights).sum(), grid.table)
    (ours,) = torch.autograd.grad((grid(points) * weights).sum(), grid.table)
    assert (ours - reference).abs().max() <= 1e-6 * reference.abs().max()


@pytest.mark.parametrize("tile", [32, 100, 1000])
def test_values_do_not_depend_on_how_points_are_tiled(tile: int) -> None:
    grid = random_grid(HashGridConfig(levels=5, features=2, log2_entries=10, coarsest=4, finest=300))
    points, table = torch.rand(1000, 3).numpy(), grid.table.detach().numpy()
    out = np.zeros((-(-1000 // tile), grid.config.width, tile), np.float32)
    encode(points, 1000, table, grid.levels, out)
    rows = out.transpose(0, 2, 1).reshape(-1, grid.config.width)[:1000]
    np.testing.assert_array_equal(rows, grid(torch.from_numpy(points)).detach())
    added, anew = np.ones_like(table), np.full_like(table, np.nan)
    scatter(points, 1000, out, grid.levels, added)
    scatter(points, 1000, out, grid.levels, anew, from_zero=True)
    np.testing.assert_allclose(added - 1.0, anew, atol=1e-5)


def test_the_plain_path_passes_gradcheck_in_double_precision() -> None:
    grid = random_grid(HashGridConfig(levels=2, features=2, log2_entries=5, coarsest=2, finest=7)).double()
    points = torch.rand(
        5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5), requires_grad=True
    )

    def encode(x: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        return encode_reference(x, table, grid.levels)

    assert torch.autograd.gradcheck(encode, (points, grid.table))


def test_double_precision_takes_the_plain_path() -> None:
    grid = random_grid().double()
    assert grid(torch.rand(7, 3, dtype=torch.float64)).dtype == torch.float64


def test_wrong_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="coarsest <= finest"):
        HashGridConfig(coarsest=10, finest=5)
    with pytest.raises(ValueError, match="expected points"):
        random_grid()(torch.rand(3))
