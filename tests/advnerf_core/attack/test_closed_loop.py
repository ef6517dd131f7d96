"""The cosine to a closed loop of which it is known."""

import json
import zlib

import numpy as np
import pytest
import torch

from advnerf_core.attack.closed_loop import closed_loop_cosine

N = 400


def direction(seed, size=N):
    raw = torch.randn(size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return raw / raw.norm()


def smooth(slope):
    """A loss with that slope at zero, curved as much as one of a drive."""
    return lambda theta: float((slope * theta).sum() + 0.3 * torch.sin(slope * theta).sum() ** 2)


def test_the_gradient_of_a_smooth_loop_has_a_cosine_of_one_and_a_narrow_interval():
    slope = 5.0 * direction(1)
    found = closed_loop_cosine(smooth(slope), torch.zeros(N, dtype=torch.float64), slope)
    cosine, low, high = found.interval
    assert cosine == pytest.approx(1.0, abs=1e-3)
    assert high - low < 1e-3
    assert len(found.plateau) >= 4
    assert "agree at steps" in found.in_words
    assert json.loads(json.dumps(found.to_dict()))["interval"] == [cosine, low, high]


@pytest.mark.parametrize("truth", [0.9, 0.3, -0.6])
def test_the_interval_holds_the_true_cosine_as_often_as_it_says(truth):
    gradient = direction(1)
    other = direction(2)
    other = other - (other * gradient).sum() * gradient
    slope = truth * gradient + np.sqrt(1.0 - truth**2) * other / other.norm()
    covered = 0
    for seed in range(100):
        found = closed_loop_cosine(
            smooth(slope), torch.zeros(N, dtype=torch.float64), 7.0 * gradient, seed=seed
        )
        _, low, high = found.interval
        covered += low <= truth <= high
        assert np.sign(low) == np.sign(high) == np.sign(truth)
    assert covered >= 88  # 95 of 100 in the mean


def test_all_directions_of_a_small_problem_leave_nothing_open():
    slope, gradient = torch.tensor([3.0, 4.0, 0.0]).double(), torch.tensor([1.0, 0.0, 0.0]).double()
    found = closed_loop_cosine(smooth(slope), torch.zeros(3, dtype=torch.float64), gradient)
    cosine, low, high = found.interval
    assert cosine == pytest.approx(0.6, abs=1e-3)
    assert high - low < 1e-3


def test_a_loop_that_jumps_at_every_scale_cannot_be_told():
    slope = direction(1)

    def jumping(theta):
        along = float((slope * theta).sum())
        # Pixel edges: each smaller step finds finer ones, whose jumps are no slope.
        return along + sum(
            0.6 * width * np.floor(along / width + 0.5 + 1e-9) * (-1) ** k
            for k, width in enumerate((1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5))
        )

    found = closed_loop_cosine(jumping, torch.zeros(N, dtype=torch.float64), slope)
    slopes = [at.along for at in found.at_steps]
    assert max(slopes) > 1.3 * min(slopes)  # one step alone would have been believed
    assert found.plateau is None
    assert found.interval is None
    assert "CANNOT BE TOLD: its finite differences depend on their step" in found.in_words


def test_random_jumps_of_one_size_cannot_be_told():
    slope = direction(1)

    def rough(theta):
        key = torch.round(theta * 1e7).numpy().tobytes()
        jump = np.random.default_rng(zlib.crc32(key)).normal(0.0, 0.01)
        return float((slope * theta).sum()) + jump

    found = closed_loop_cosine(rough, torch.zeros(N, dtype=torch.float64), slope)
    assert found.interval is None


def test_a_flat_loop_and_a_zero_gradient_cannot_be_told():
    zero = torch.zeros(N, dtype=torch.float64)
    assert "does not change" in closed_loop_cosine(lambda theta: 1.0, zero, direction(1)).in_words
    assert closed_loop_cosine(smooth(direction(1)), zero, zero).interval is None
    with pytest.raises(ValueError, match="at least 1 direction, got 0"):
        closed_loop_cosine(smooth(direction(1)), zero, direction(1), directions=0)
