"""Seeds searched in one batch against the same seeds searched alone."""

import dataclasses

import pytest
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.robustness import Smoothness
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.attack.search.together import gradient_attacks
from advnerf_core.scene.many_textures import ManyTextures
from tests.support.attack_toy import toy_problem

SEEDS = (3, 4, 5)


@pytest.fixture(scope="module")
def problems():
    alone = toy_problem(5)
    moved = [alone.start_states + torch.tensor([0.0, 0.02 * k, 0.01 * k]).double() for k in range(3)]
    return [dataclasses.replace(alone, start_states=starts) for starts in moved]


def together(problems):
    starts = len(problems[0].start_states)
    return dataclasses.replace(
        problems[0],
        sensor=ManyTextures(problems[0].sensor, len(problems), starts),
        start_states=torch.cat([p.start_states for p in problems]),
    )


@pytest.mark.parametrize(("time_batch", "cache_bytes"), [(2, 0), (8, 2**40)])
def test_every_texture_gets_its_own_gradient(problems, time_batch, cache_bytes):
    theta = torch.randn(
        3, *problems[0].sensor.theta_shape, dtype=torch.float64, generator=torch.manual_seed(0)
    )
    batch = dataclasses.replace(together(problems), time_batch=time_batch, cache_bytes=cache_bytes)
    result = adjoint_gradient(batch, theta)
    for k, problem in enumerate(problems):
        alone = adjoint_gradient(problem, theta[k])
        torch.testing.assert_close(3.0 * result.gradient[k], alone.gradient, rtol=1e-9, atol=1e-12)
        rows = slice(2 * k, 2 * k + 2)
        torch.testing.assert_close(
            result.totals.protocol_cte_m[rows], alone.totals.protocol_cte_m, rtol=1e-9, atol=0.0
        )


@pytest.mark.slow
def test_a_search_together_ends_where_searches_alone_do(problems):
    smooth = [dataclasses.replace(p, regulariser=Smoothness(p.sensor.objects, 0.05)) for p in problems]
    results = gradient_attacks(smooth, SEEDS, 3)
    for problem, seed, result in zip(smooth, SEEDS, results, strict=True):
        alone = gradient_attack(problem, 3, run=SearchRun(seed))
        torch.testing.assert_close(result.theta, alone.theta, rtol=1e-6, atol=1e-9)
        assert [e.loss_m for e in result.history] == pytest.approx(
            [e.loss_m for e in alone.history], rel=1e-9
        )
        assert result.best.iteration == alone.best.iteration
    assert not torch.equal(results[0].theta, results[1].theta)


@pytest.mark.slow
def test_stopped_and_resumed_it_gives_the_same_bits(problems, tmp_path):
    whole = gradient_attacks(problems, SEEDS, 4, state_path=tmp_path / "whole")

    class Stop(Exception):
        pass

    def stop(k, evaluation):
        if evaluation.iteration == 1 and k == 1:
            raise Stop

    with pytest.raises(Stop):
        gradient_attacks(problems, SEEDS, 4, state_path=tmp_path / "state", on_evaluation=stop)
    resumed = gradient_attacks(problems, SEEDS, 4, state_path=tmp_path / "state")
    for one, other in zip(whole, resumed, strict=True):
        assert torch.equal(one.theta, other.theta)
        assert [e.loss_m for e in one.history] == [e.loss_m for e in other.history]
    with pytest.raises(SearchStateError, match="other settings"):
        gradient_attacks(problems, (3, 4, 6), 4, state_path=tmp_path / "state")
    (tmp_path / "state").write_bytes(b"not a state")
    with pytest.raises(SearchStateError, match="delete it to start afresh"):
        gradient_attacks(problems, SEEDS, 4, state_path=tmp_path / "state")


def test_what_cannot_be_batched_is_refused(problems):
    with pytest.raises(ValueError, match="a problem for each seed"):
        gradient_attacks(problems, (1,), 2)
    with pytest.raises(ValueError, match="differ in seed and start poses only"):
        gradient_attacks([problems[0], dataclasses.replace(problems[1], steps=7)], (1, 2), 2)
    with pytest.raises(ValueError, match="in multiples of 6"):
        ManyTextures(problems[0].sensor, 3, 2).sense(
            problems[0].start_states, torch.zeros(3, *problems[0].sensor.theta_shape)
        )
