import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.random_search import random_search
from advnerf_core.attack.search.search import SearchState, SearchStateError, draw_start_states, load_state
from advnerf_core.errors import NotFiniteError
from advnerf_core.scene.surrogate import Rendered
from tests.support.attack_toy import toy_problem


@pytest.fixture(scope="module")
def problem():
    return toy_problem(6, dtype=torch.float32)


def without_times(history):
    return [dataclasses.replace(evaluation, seconds=0.0) for evaluation in history]


def test_the_first_iterations_are_adam_written_out(problem):
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(5)).double()
    m = v = torch.zeros_like(theta)
    losses = []
    for step in range(1, 4):
        result = adjoint_gradient(problem, theta.float())
        losses.append(result.loss)
        g = result.gradient.double()
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        theta = theta - 0.1 * (m / (1 - 0.9**step)) / ((v / (1 - 0.999**step)).sqrt() + 1e-8)
    result = gradient_attack(problem, 3, 0.1, SearchRun(5))
    np.testing.assert_allclose([e.loss_m for e in result.history], losses, rtol=1e-5)


def test_the_attack_raises_the_error_and_keeps_its_best(problem):
    seen = []
    result = gradient_attack(problem, iterations=8, run=SearchRun(on_evaluation=seen.append))
    totals = [e.predicted_total_cte_m for e in result.history]
    assert seen == list(result.history)
    assert max(totals) > totals[0]
    assert result.best.predicted_total_cte_m == max(totals)
    _, again = evaluate(problem, result.theta)
    np.testing.assert_allclose(again.protocol_cte_m.mean().item(), max(totals), rtol=1e-6)


@pytest.mark.parametrize("search", [gradient_attack, random_search])
def test_a_stopped_search_resumes_to_the_bit(problem, tmp_path, search):
    class StoppedError(Exception):
        pass

    def stop_at_two(evaluation):
        if evaluation.iteration == 2:
            raise StoppedError

    whole = search(problem, 5, run=SearchRun(1))
    path = tmp_path / "state.safetensors"
    with pytest.raises(StoppedError):
        search(problem, 5, run=SearchRun(1, state_path=path, on_evaluation=stop_at_two))
    seen = []
    resumed = search(problem, 5, run=SearchRun(1, state_path=path, on_evaluation=seen.append))
    assert [e.iteration for e in seen] == [3, 4]
    assert torch.equal(resumed.theta, whole.theta)
    assert without_times(resumed.history) == without_times(whole.history)
    # Nothing is left to do: the same result, no evaluation.
    assert torch.equal(search(problem, 5, run=SearchRun(1, state_path=path)).theta, whole.theta)


@pytest.mark.parametrize("search", [gradient_attack, random_search])
def test_a_state_of_other_settings_or_garbage_is_refused(problem, tmp_path, search):
    path = tmp_path / "state.safetensors"
    search(problem, 1, run=SearchRun(1, state_path=path))
    with pytest.raises(SearchStateError, match="other settings"):
        search(problem, 2, run=SearchRun(2, state_path=path))
    with pytest.raises(SearchStateError, match="other settings"):
        search(problem, 2, run=SearchRun(1, state_path=path, settings_hash="other policy"))
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(SearchStateError, match="delete it to start afresh"):
        search(problem, 2, run=SearchRun(1, state_path=path))


def test_two_names_for_one_tensor_are_two_tensors_in_the_state(tmp_path):
    whole = torch.arange(6.0).reshape(2, 3)
    parts = {"a": whole, "again": whole, "part": whole[0], "turned": whole.T}
    state = SearchState(parts, whole.clone())
    state.save(tmp_path / "state", "f")
    found = load_state(tmp_path / "state", "f")
    assert found.tensors.keys() == parts.keys()
    assert all(torch.equal(found.tensors[name], part) for name, part in parts.items())
    for wrong, message in (({"number": 3}, "got number: int"), ({"best_theta": whole}, "got best_theta")):
        with pytest.raises(SearchStateError, match=f"expected tensors under names of their own.*{message}"):
            SearchState(wrong, whole).save(tmp_path / "state", "f")


def test_random_textures_have_the_spread_and_differ_by_seed(problem):
    thetas = []

    class Recording:
        theta_shape = problem.sensor.theta_shape

        def sense(self, states, theta):
            thetas.append(theta.clone())
            return problem.sensor.sense(states, theta)

    random_search(dataclasses.replace(problem, sensor=Recording(), steps=1), 20, sigma=5.0)
    drawn = torch.stack(thetas)
    assert abs(drawn.std().item() - 5.0) < 0.3
    assert len({float(t.sum()) for t in thetas}) == 20


def test_a_gradient_that_is_not_finite_is_one_clear_error(problem):
    class Broken:
        theta_shape = problem.sensor.theta_shape
        initial_theta = problem.sensor.initial_theta

        def sense(self, states, theta):
            rendered = problem.sensor.sense(states, theta)
            return Rendered(
                rendered.images, lambda grad: torch.full(self.theta_shape, torch.nan), rendered.nbytes
            )

    with pytest.raises(NotFiniteError, match="at evaluation 0"):
        gradient_attack(dataclasses.replace(problem, sensor=Broken()), 2)


def test_starts_are_drawn_once_around_the_nominal_one():
    starts = draw_start_states((-1.1, -2.0, 0.0), 400, 0.1, seed=2)
    assert torch.equal(starts, draw_start_states((-1.1, -2.0, 0.0), 400, 0.1, seed=2))
    assert starts[0].tolist() == [-1.1, -2.0, 0.0]
    np.testing.assert_allclose(starts.mean(0).numpy(), [-1.1, -2.0, 0.0], atol=0.02)
    np.testing.assert_allclose(starts.std(0).numpy(), [0.1, 0.1, 0.025], rtol=0.1)
    with pytest.raises(ValueError, match="at least one start"):
        draw_start_states((0, 0, 0), 0)
