import json

import numpy as np
import pytest
import torch

from advnerf_core.driving.cross_track import cross_track
from advnerf_core.driving.path import Arc, Line, Path

TRACK = Path.rounded_square(4.0, 1.1)


def test_track_matches_the_contract() -> None:
    assert TRACK.length_m == pytest.approx(4 * 1.8 + 2 * np.pi * 1.1)
    np.testing.assert_allclose(TRACK.pose_at(0.0), [-0.9, -2.0, 0.0])
    np.testing.assert_allclose(TRACK.pose_at(1.8), [0.9, -2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(TRACK.pose_at(1.8 + 1.1 * np.pi / 2), [2.0, -0.9, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(TRACK.pose_at(TRACK.length_m + 0.5), [-0.4, -2.0, 2 * np.pi], atol=1e-12)
    np.testing.assert_allclose(TRACK.curvature_at([0.5, 2.0]), [0.0, 1 / 1.1])


def test_projection_recovers_offsets() -> None:
    rng = np.random.default_rng(0)
    s, e = rng.uniform(0, TRACK.length_m, 500), rng.uniform(-0.8, 0.8, 500)
    pose = TRACK.pose_at(s)
    normal = np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], -1)
    projection = TRACK.project(pose[:, :2] + e[:, None] * normal)
    np.testing.assert_allclose(projection.cte_m, e, atol=1e-12)
    np.testing.assert_allclose(projection.s_m, s, atol=1e-9)
    np.testing.assert_allclose(projection.heading_rad, pose[:, 2], atol=1e-9)
    np.testing.assert_allclose(projection.normal, normal, atol=1e-9)


def test_projection_is_the_nearest_point_everywhere() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-4, 4, (100, 2))
    dense = TRACK.pose_at(np.linspace(0, TRACK.length_m, 10_000))[:, :2]
    nearest = np.linalg.norm(xy[:, None] - dense[None], axis=-1).min(axis=1)
    np.testing.assert_allclose(np.abs(TRACK.project(xy).cte_m), nearest, atol=1e-3)


def test_right_turns_are_mirrored() -> None:
    right = Path.from_segments((0.0, 0.0, 0.0), [Line(1.0), Arc(2.0, -np.pi / 2), Line(1.0)], closed=False)
    np.testing.assert_allclose(right.pose_at(right.length_m), [3.0, -3.0, -np.pi / 2], atol=1e-12)
    outside = np.array([1.0, -2.0]) + 2.3 * np.array([np.sin(0.7), np.cos(0.7)])
    projection = right.project(outside)
    assert projection.cte_m == pytest.approx(0.3)
    assert projection.s_m == pytest.approx(1.0 + 2.0 * 0.7)
    assert right.project(np.array([-1.0, 0.25])).cte_m == pytest.approx(0.25)


def test_a_path_that_does_not_close_is_refused() -> None:
    with pytest.raises(ValueError, match="closed path to end at its start"):
        Path.from_segments((0, 0, 0), [Line(1.0), Arc(1.0, np.pi)])
    with pytest.raises(ValueError, match=r"\[\.\.\., 2\]"):
        TRACK.project(np.zeros(3))


def test_dictionary_round_trip() -> None:
    again = Path.from_dict(json.loads(json.dumps(TRACK.to_dict())))
    np.testing.assert_array_equal(again.pose_at(3.3), TRACK.pose_at(3.3))
    with pytest.raises(ValueError, match=r"expected a path \{start_pose"):
        Path.from_dict({"segments": []})


def test_cross_track_gradient() -> None:
    xy = torch.tensor(np.random.default_rng(2).uniform(-2.4, 2.4, (20, 2)), requires_grad=True)
    xy = xy[(xy.detach().norm(dim=1) > 0.8)].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: cross_track(TRACK, p), (xy,), eps=1e-7, atol=1e-6)
    single = cross_track(TRACK, xy.detach().float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), TRACK.project(xy.detach().numpy()).cte_m, atol=1e-6)
