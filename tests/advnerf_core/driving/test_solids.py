"""Clearance between a car and rectangles, against points along their outlines and the separating axis theorem."""

import numpy as np
import pytest
import torch

from advnerf_core.driving.solids import Rectangle, Solids
from hardware.worlds.footprints import Footprint

BODY = Rectangle(0.13, 0.0, 0.254, 0.146)
BOXES = (Rectangle(1.0, 0.2, 0.4, 0.1, 0.5), Rectangle(-0.8, -0.6, 0.2, 0.3, -1.1))


def states(count: int = 60) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 4.0 - 2.0


def footprint(rectangle: Rectangle, x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0) -> Footprint:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = x_m + c * rectangle.x_m - s * rectangle.y_m, y_m + s * rectangle.x_m + c * rectangle.y_m
    return Footprint(x, y, rectangle.half_length_m, rectangle.half_width_m, rectangle.yaw_rad + yaw_rad)


def outline(rectangle: Footprint, per_edge: int = 200) -> np.ndarray:
    corners = np.array(rectangle.corners())
    share = np.linspace(0.0, 1.0, per_edge)[:, None]
    return np.concatenate(
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )


def test_apart_it_is_the_distance_of_the_outlines():
    found = Solids(BOXES, BODY).clearances_m(states()).numpy()
    apart = 0
    for state, row in zip(states().numpy(), found, strict=True):
        car = footprint(BODY, *state)
        for box, clearance in zip(map(footprint, BOXES), row, strict=True):
            assert (clearance < 0.0) == car.overlaps(box)
            if clearance > 0.0:
                apart += 1
                nearest = np.linalg.norm(outline(car)[:, None] - outline(box), axis=-1).min()
                assert clearance == pytest.approx(nearest, abs=2e-3)
                assert clearance <= nearest + 1e-12
    assert 60 < apart < 120


def test_overlapping_it_is_the_shortest_way_out():
    """Found by pushing the car in 720 directions."""
    inside = states(400)
    depth = -Solids(BOXES, BODY).clearances_m(inside).amin(1).numpy()
    box = {False: footprint(BOXES[1]), True: footprint(BOXES[0])}
    checked = 0
    for state, deep in zip(inside.numpy(), depth, strict=True):
        if deep <= 0.02 or checked == 4:
            continue
        checked += 1
        hit = box[footprint(BODY, *state).overlaps(box[True])]
        angles, shortest = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False), np.inf
        for angle in angles:
            way = np.array([np.cos(angle), np.sin(angle), 0.0])
            low, high = 0.0, 3.0
            while high - low > 1e-4:  # a convex body leaves another one once
                middle = 0.5 * (low + high)
                low, high = (
                    (middle, high)
                    if footprint(BODY, *(state + middle * way)).overlaps(hit)
                    else (low, middle)
                )
            shortest = min(shortest, high)
        assert deep == pytest.approx(shortest, abs=2e-3)
    assert checked == 4


def test_its_gradient_is_that_of_central_differences():
    solids = Solids(BOXES, BODY)
    at = states(12).requires_grad_()
    weights = torch.randn(12, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * solids.clearances_m(at)).sum(), at)
    numeric = torch.zeros_like(gradient)
    for k in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[k] = 1e-6
        ends = [solids.clearances_m(at.detach() + sign * step) for sign in (1.0, -1.0)]
        numeric[:, k] = (weights * (ends[0] - ends[1])).sum(1) / 2e-6
    torch.testing.assert_close(gradient, numeric, rtol=1e-6, atol=1e-8)


def test_nothing_to_hit_and_flat_rectangles_are_refused():
    with pytest.raises(ValueError, match="at least one solid rectangle"):
        Solids((), BODY)
    with pytest.raises(ValueError, match="half extents above 0 m"):
        Rectangle(0.0, 0.0, 1.0, 0.0)
