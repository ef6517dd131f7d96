"""Searches without a gradient: their estimates on functions that are known, and equal terms on a closed loop."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import BlackBoxError, adjoint_gradient
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.search.cem import CrossEntropy
from advnerf_core.attack.search.evolution import Evolution, rank_utilities
from advnerf_core.attack.search.population import Coarse, population_search
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.errors import NotFiniteError
from tests.support.attack_toy import random_policy, toy_problem

STRATEGIES = [CrossEntropy(), Evolution()]


@pytest.fixture(scope="module")
def problem():
    return toy_problem(4, dtype=torch.float32)


@pytest.mark.parametrize("strategy", [CrossEntropy(sigma=2.0), Evolution(sigma=0.3, learning_rate=0.2)])
def test_a_bowl_is_descended_to_its_bottom(strategy):
    bottom = torch.tensor([1.0, -2.0, 0.5, 1.5])
    generator = torch.Generator().manual_seed(0)
    known = strategy.fresh((4,))
    for _ in range(60):
        candidates = strategy.ask(known, 20, generator)
        known = strategy.tell(known, candidates, ((candidates - bottom) ** 2).sum(1).double())
    torch.testing.assert_close(known["mean"], bottom, rtol=0, atol=0.25)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_only_the_order_of_losses_counts(strategy):
    known = strategy.fresh((3,))
    candidates = strategy.ask(known, 10, torch.Generator().manual_seed(0))
    losses = candidates.sum(1).double()
    for mapped in (torch.exp(losses), 5 * losses - 3):
        for one, other in zip(
            strategy.tell(known, candidates, losses).values(),
            strategy.tell(known, candidates, mapped).values(),
            strict=True,
        ):
            torch.testing.assert_close(one, other)


def test_the_evolution_strategy_estimates_the_direction_of_a_slope():
    slope = torch.randn(30, generator=torch.Generator().manual_seed(1))
    strategy = Evolution()
    known = strategy.fresh((30,))
    candidates = strategy.ask(known, 4000, torch.Generator().manual_seed(2))
    torch.testing.assert_close(candidates[0::2], -candidates[1::2])
    known = strategy.tell(known, candidates, (candidates @ slope).double())
    assert torch.cosine_similarity(known["m"], slope, dim=0) > 0.95


def test_utilities_of_four_ranks_written_out():
    raw = np.array([np.log(3.0), np.log(3.0) - np.log(2.0), 0.0, 0.0])
    expected = raw / raw.sum() - 0.25
    got = rank_utilities(torch.tensor([7.0, -1.0, 3.0, 5.0], dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), expected[[3, 0, 1, 2]], atol=1e-6)


def test_a_coarse_texture_is_interpolated_between_its_cells():
    coarse = Coarse((8, 8, 3), 2)
    assert coarse.shape == (2, 2, 3)
    ramp = torch.tensor([[0.0, 8.0], [0.0, 8.0]])[..., None].expand(2, 2, 3)
    theta = coarse.expand(ramp)
    # Cell centres of the coarse texture lie at columns 1.5 and 5.5 of the fine one; beyond them it is clamped.
    expected = np.clip(8.0 * (np.arange(8) - 1.5) / 4.0, 0.0, 8.0)
    np.testing.assert_allclose(theta[3, :, 1].numpy(), expected, atol=1e-6)
    assert Coarse((8, 8, 3), 0).shape == Coarse((8, 8, 3), 9).shape == (8, 8, 3)
    assert Coarse((100, 3), 2).shape == (100, 3)


@pytest.mark.parametrize("strategy", STRATEGIES, ids=lambda s: s.name)
def test_a_search_stopped_anywhere_resumes_to_the_bit(problem, tmp_path, strategy):
    class StoppedError(Exception):
        pass

    whole = population_search(problem, strategy, 11, population=4, cells=2, run=SearchRun(1))
    path = tmp_path / "state.safetensors"
    for stop in (1, 3, 4, 8):  # within a generation, at its end, at its begin

        def stop_there(evaluation, stop=stop):
            if evaluation.iteration == stop:
                raise StoppedError

        with pytest.raises(StoppedError):
            population_search(
                problem, strategy, 11, 4, 2, run=SearchRun(1, state_path=path, on_evaluation=stop_there)
            )
    resumed = population_search(problem, strategy, 11, 4, 2, run=SearchRun(1, state_path=path))
    assert torch.equal(resumed.theta, whole.theta)
    strip = [[dataclasses.replace(e, seconds=0.0) for e in result.history] for result in (whole, resumed)]
    assert strip[0] == strip[1]
    assert len(whole.history) == 11
    with pytest.raises(SearchStateError, match="other settings"):
        population_search(
            problem, dataclasses.replace(strategy, sigma=9.0), 12, 4, 2, run=SearchRun(1, state_path=path)
        )


class BlackBox:
    """A policy outside torch: thresholds of the mean colour."""

    stateless = True
    differentiable = False

    def __call__(self, images, goals=None):
        means = images.detach().numpy().mean((1, 2, 3))
        return torch.from_numpy(np.round(8.0 * (means - 0.5)) / 20.0)


def test_a_black_box_can_be_searched_but_not_differentiated(problem):
    closed = dataclasses.replace(problem, policy=BlackBox())
    result = population_search(closed, Evolution(), 6, population=4, cells=2)
    assert len(result.history) == 6
    with pytest.raises(
        BlackBoxError,
        match=r"differentiable = False; search with a method that asks for answers only",
    ):
        adjoint_gradient(closed, result.theta)


def test_a_policy_without_an_answer_is_one_clear_error(problem):
    class Broken(BlackBox):
        def __call__(self, images, goals=None):
            return torch.full((len(images),), torch.nan)

    with pytest.raises(NotFiniteError, match="finite steering from the policy, got nan at tick 0"):
        population_search(dataclasses.replace(problem, policy=Broken()), CrossEntropy(), 4, 4)


def test_a_policy_with_random_weights_is_attacked_better_than_grey(problem):
    searched = population_search(
        dataclasses.replace(problem, policy=random_policy(3, torch.float32)),
        CrossEntropy(),
        24,
        8,
        cells=2,
        run=SearchRun(2),
    )
    totals = [e.predicted_total_cte_m for e in searched.history]
    assert max(totals) == searched.best.predicted_total_cte_m
    assert np.mean(totals[-8:]) > np.mean(totals[:8])
