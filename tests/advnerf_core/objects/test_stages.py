"""Coarse-to-fine fits of voxel objects."""

import numpy as np
import pytest

from advnerf_core.objects.voxel.build import build_from_images, mesh_views
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.stages import resampled, resolutions, stage_shares
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, ObjectGrids


def test_each_stage_has_twice_the_voxels_and_more_of_the_time() -> None:
    assert resolutions(40) == [40]
    assert resolutions(64) == [32, 64]
    assert resolutions(128) == [32, 64, 128]
    assert resolutions(160) == [40, 80, 160]
    for count in (1, 2, 3, 4):
        shares = stage_shares(count)
        assert len(shares) == count
        assert sum(shares) == pytest.approx(1.0)
        assert shares == sorted(shares)


def block(cells: int, full: bool) -> ObjectGrids:
    """A cube of side 1, opaque in its lower half or everywhere; red grows with x."""
    voxel = 1.0 / cells
    density = np.zeros((cells,) * 3, np.float32)
    density[:, :, : cells if full else cells // 2] = OPAQUE_PER_VOXEL / voxel
    colours = np.zeros((cells, cells, cells, 3), np.float32)
    colours[..., 0] = (voxel * (np.arange(cells) + 0.5))[:, None, None]
    return ObjectGrids(density, colours, np.zeros(3), np.ones(3))


def test_a_finer_grid_takes_over_shape_and_colours() -> None:
    fine = resampled(block(8, full=False), block(16, full=True))
    share = fine.density * fine.voxel / OPAQUE_PER_VOXEL
    np.testing.assert_allclose(share[:, :, :7], 1.0, rtol=1e-5)
    assert (share[:, :, 9:] == 0.0).all()
    # Linear colours are interpolated exactly, half a coarse voxel away from the border.
    expected = (np.arange(16) + 0.5) / 16
    np.testing.assert_allclose(fine.colours[1:-1, 4, 4, 0], expected[1:-1], atol=1e-6)


def test_density_is_cut_to_what_the_finer_hull_reaches() -> None:
    fine = resampled(block(8, full=True), block(16, full=False))
    assert (fine.density[:, :, :10] > 0.0).all()
    assert (fine.density[:, :, 10:] == 0.0).all()


def test_an_object_is_learned_from_pictures_in_stages() -> None:
    mesh = hydrant()
    told: list[float] = []
    model = build_from_images(
        mesh_views(mesh, 16, 48),
        "hydrant",
        64,
        30,
        progress=lambda fraction, text: told.append(fraction),
        held_out=mesh_views(mesh, 3, 48, 0.37),
        coarse_to_fine=True,
    )
    assert model.about["steps"] == 30
    assert max(model.grids.density.shape) <= 70
    assert model.about["held_out_psnr_db"] > 20.0
    assert told == sorted(told)
