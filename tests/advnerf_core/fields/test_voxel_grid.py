import numpy as np
import pytest
import torch

from advnerf_core.fields.voxel_grid import (
    cube_face_object,
    face_corners_in_object,
    inverse_squash,
    squash,
    squash_derivative,
    with_border,
)


def test_squash_and_its_inverse_and_derivative():
    colour = np.linspace(0.01, 0.99, 9)
    theta = torch.tensor(inverse_squash(colour), requires_grad=True)
    np.testing.assert_allclose(squash(theta).detach().numpy(), colour)
    squash(theta).sum().backward()
    torch.testing.assert_close(theta.grad, squash_derivative(theta.detach()))
    assert np.isfinite(inverse_squash([0.0, 1.0])).all()


def test_only_the_deployed_face_is_free_on_a_cube():
    cube = cube_face_object(0.8, 8, depth_m=0.8)
    assert cube.slots.shape == (8, 8, 8)
    assert (cube.slots[-2:] < 64).all()
    assert (cube.slots[:-2] == 64).all()
    # Row 0 is the top (largest z), column 0 the smallest y.
    assert cube.slots[-1, 0, -1] == 0
    assert cube.slots[-1, 1, -1] == 1
    assert cube.slots[-1, 0, -2] == 8


def test_colours_are_squashed_theta_then_fixed_rows():
    face = cube_face_object(0.8, 4, (0.1, 0.2, 0.3))
    theta = torch.randn(4, 4, 3, dtype=torch.float64)
    colours = face.colours(theta)
    torch.testing.assert_close(colours[:-1].reshape(4, 4, 3), squash(theta))
    torch.testing.assert_close(colours[-1], torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    with pytest.raises(ValueError, match="expected theta of shape"):
        face.colours(torch.zeros(3, 4, 3))


def test_corners_run_clockwise_from_the_top_left_for_the_viewer():
    corners = face_corners_in_object(0.8)
    edge_right, edge_down = corners[1] - corners[0], corners[3] - corners[0]
    # Seen from +x: right x down points into the face, away from the viewer.
    np.testing.assert_allclose(np.cross(edge_right, edge_down) / 0.64, [-1.0, 0.0, 0.0], atol=1e-12)


def test_a_border_surrounds_the_face_as_it_is_drawn_for_a_viewer():
    drawn = np.random.default_rng(0).uniform(size=(10, 10, 3))
    panel = cube_face_object(0.6, 6, (0.1, 0.2, 0.3))
    framed = with_border(panel, drawn)
    assert framed.face_size_m == pytest.approx((0.6, 0.6))
    assert (framed.box_max - framed.box_min)[1:] == pytest.approx([1.0, 1.0])
    theta = torch.randn(6, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    colours = framed.colours(theta).numpy()
    # Row 0 is the top (largest z), column 0 the smallest y.
    front = colours[framed.slots[-1]][:, ::-1].transpose(1, 0, 2)
    expected = drawn.copy()
    expected[2:-2, 2:-2] = squash(theta).numpy()
    np.testing.assert_allclose(front, expected, atol=1e-12)
    np.testing.assert_allclose(
        squash(torch.from_numpy(framed.plain_theta)), np.tile([0.1, 0.2, 0.3], (36, 1))
    )
    for wrong in (drawn[:9, :9], drawn[:, :9], drawn[:6, :6]):
        with pytest.raises(ValueError, match="a border on every side of 6"):
            with_border(panel, wrong)


@pytest.mark.parametrize("bad", [{"size_m": 0.0}, {"depth_m": -1.0}, {"resolution": 0}])
def test_impossible_sizes_are_refused(bad):
    with pytest.raises(ValueError, match="expected positive sizes"):
        cube_face_object(**bad)
