"""Gaussians that would spoil a scene are removed and counted."""

import numpy as np
import pytest

from advnerf_core.splats.cleaning import clean
from advnerf_core.splats.gaussians import SplatError
from tests.support.splats import gaussians, random_splats, room


def test_a_good_splat_is_left_as_it_is():
    splats = room(2000)
    kept, removed = clean(splats)
    assert removed == []
    assert kept is splats


def test_each_kind_is_counted_by_its_reason():
    splats = room(2000)
    splats.means_m[0, 1] = np.nan
    splats.scales_m[1, 2] = np.inf
    splats.rotations[2] = np.nan
    splats.harmonics[3, 0, 0] = np.inf
    splats.opacities[4] = 1.5
    splats.opacities[5:7] = 0.003
    splats.means_m[7] = 1e6
    splats.scales_m[8:11] = 100.0
    splats.means_m[11:15] = [[20.0, 0.0, 0.0], [0.0, 30.0, 0.0], [0.0, 0.0, 40.0], [-25.0, 0.0, 0.0]]
    kept, removed = clean(splats)
    assert len(kept) == 1985
    assert [each.count for each in removed] == [5, 2, 1, 3, 4]
    assert ["NaN" in removed[0].reason, "1/255" in removed[1].reason, "farther" in removed[2].reason] == [
        True
    ] * 3
    assert ["sizes" in removed[3].reason, "floaters" in removed[4].reason] == [True] * 2
    assert len(clean(splats, floaters=False)[0]) == 1989


def test_a_large_gaussian_far_away_is_no_floater():
    splats = room(2000)
    splats.means_m[:20] = 15.0 * np.eye(3)[np.arange(20) % 3]
    splats.scales_m[:20] = 10.0
    assert clean(splats)[1] == []


def test_a_splat_that_is_mostly_damaged_or_invisible_is_refused():
    splats = random_splats(100)
    splats.means_m[:60] = np.nan
    with pytest.raises(SplatError, match="in 60 of 100 Gaussians; export it again"):
        clean(splats)
    with pytest.raises(SplatError, match="none after leaving out 3 for opacity below 1/255"):
        clean(gaussians(np.zeros((3, 3)), 0.1, 0.001, np.ones((3, 3))))


def test_a_splat_whose_sizes_are_all_wild_is_refused_with_every_reason():
    splats = random_splats(100)
    splats.opacities[:10], splats.opacities[10:] = 0.001, 1.0
    splats.scales_m[:, 0] = 3000.0
    splats.scales_m[:, 1:] = 0.01
    with pytest.raises(SplatError, match=r"10 for opacity below 1/255.*; 90 for sizes beyond 10 times"):
        clean(splats)
