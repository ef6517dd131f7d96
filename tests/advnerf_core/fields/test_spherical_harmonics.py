import numpy as np
import pytest
import torch

from advnerf_core.fields.spherical_harmonics import spherical_harmonics, write_spherical_harmonics


def quadrature() -> tuple[torch.Tensor, torch.Tensor]:
    """Nodes and weights on the sphere, exact for polynomials up to degree 11."""
    z, w = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    r = np.sqrt(1 - z**2)
    nodes = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(z[:, None], 16, 1)], -1)
    return torch.from_numpy(nodes.reshape(-1, 3)), torch.from_numpy(np.repeat(w * 2 * np.pi / 16, 16))


def test_functions_are_orthonormal_on_the_sphere() -> None:
    nodes, weights = quadrature()
    values = spherical_harmonics(nodes, 4)
    gram = values.T @ (values * weights[:, None])
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
def test_kernel_agrees_with_torch(bands: int) -> None:
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    out = np.zeros((2 + bands**2, 20), np.float32)
    for n, (x, y, z) in enumerate(directions.numpy()):
        write_spherical_harmonics(x, y, z, bands, out, 2, n)
    np.testing.assert_allclose(out[2:].T, spherical_harmonics(directions, bands), atol=1e-6)
    assert not out[:2].any()
