"""Attacks by questions alone: what they estimate, how often they ask, and that they go on to the bit."""

import dataclasses
import math
from dataclasses import replace
from pathlib import Path as FilePath

import pytest
import torch
from torch import nn

from advnerf_core.attack.adjoint import AttackProblem, BlackBoxError, adjoint_gradient, evaluate
from advnerf_core.attack.methods import METHODS, MethodError, SearchRun, SearchSettings
from advnerf_core.attack.robustness import Disturbances
from advnerf_core.attack.search.black_box import BlackBoxSearch, BudgetError, black_box_attack
from advnerf_core.attack.search.distil import Distillation, Lessons, Student
from advnerf_core.attack.search.evolution import Evolution
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.population import population_search
from advnerf_core.attack.search.query_count import CountedPolicy, VictimError, calls_per_evaluation
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.attack.search.visited import VisitedDrive
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.path import Path
from advnerf_core.scene.surrogate import Rendered, Surrogate
from tests.support.attack_toy import toy_problem

STEPS, EDGE = 8, 8
SHAPE = (3, EDGE, EDGE)


class StoppedError(Exception):
    pass


class Linear(nn.Module):
    """Steering linear in the image: its slope is its weights, in closed form."""

    stateless = True
    goal_size = 0

    def __init__(self, weights):
        super().__init__()
        self.weights = nn.Parameter(weights)

    def forward(self, images, goals=None):
        return (images.to(self.weights) * self.weights).sum((1, 2, 3))


class Poster:
    """A camera that sees the texture and nothing else, dimmed by where it is: closed loop, no renderer."""

    theta_shape = (EDGE, EDGE, 3)

    def initial_theta(self, generator):
        return 1e-4 * torch.randn(self.theta_shape, generator=generator)

    def sense(self, states, theta):
        light = (0.7 + 0.3 * torch.sin(3.0 * states[:, 0] + states[:, 1])).to(theta)[:, None, None, None]
        colours = torch.sigmoid(theta)
        slope = colours * (1 - colours)
        images = light * colours.permute(2, 0, 1)
        return Rendered(images, lambda grad: (light * grad).sum(0).permute(1, 2, 0) * slope, images.nbytes)


def coarse_weights(seed):
    """Weights that vary slowly over the picture."""
    small = torch.randn(1, 3, 4, 4, generator=torch.Generator().manual_seed(seed))
    weights = nn.functional.interpolate(small, SHAPE[1:], mode="bilinear")[0]
    return 5e-3 * (weights - weights.mean())


def linear_problem(**options):
    starts = torch.tensor([[-1.1, -1.75, 0.05], [-0.9, -1.6, 0.0]], dtype=torch.float64)
    settings = {
        "sensor": Poster(),
        "policy": Linear(coarse_weights(0)).eval().requires_grad_(False),
        "steps": STEPS,
        **options,
    }
    dynamics, path = Ackermann(0.25, 0.8, 0.1), Path.rounded_square(4.0, 1.1)
    return AttackProblem(dynamics=dynamics, path=path, start_states=starts, **settings)


def linear_student(shape, goal_size, bound_rad):
    """The right kind of network, knowing nothing yet."""
    assert goal_size == 0
    assert bound_rad > 0
    return Linear(torch.zeros(shape))


LIGHT = Distillation(
    warm_pairs=6, warm_passes=2, fresh_pairs=6, steps=2, memory_pairs=10, batch_pairs=4, learning_rate=1e-3
)
GUIDED = BlackBoxSearch("guided", probes=3, cells=2, distillation=LIGHT, student=linear_student)
DISTILLED = replace(GUIDED, method="distilled", probes=1)


def cosine(one, other):
    return float(
        torch.cosine_similarity(one.detach().flatten().double(), other.detach().flatten().double(), dim=0)
    )


def least_calls(search, problem, evaluations):
    return search.first_calls() + evaluations * search.step_calls(problem)


def first_estimate(problem, search, tmp_path):
    """The first gradient of a search, read from its state: Adam's mean is a tenth of it after one step."""
    from safetensors.torch import load_file

    path = tmp_path / f"{search.method}.safetensors"
    result = black_box_attack(
        problem, search, least_calls(search, problem, 1), run=SearchRun(state_path=path)
    )
    return result.theta, 10.0 * load_file(path)["m"]


def test_a_student_of_a_linear_policy_finds_its_slope():
    generator = torch.Generator().manual_seed(0)
    victim = Linear(torch.randn(3, 4, 5, generator=generator))
    images = torch.randint(0, 256, (100, 2, 3, 4, 5), generator=generator, dtype=torch.uint8)
    answers = victim(images.flatten(0, 1) / 255.0).detach().reshape(-1, 2)
    lessons = Lessons(images, torch.zeros(100, 0), answers)
    student = Student(lessons, Distillation(learning_rate=0.03), 0, linear_student)
    cosines = []
    for _ in range(2):
        student.learn(120, generator)
        cosines.append(cosine(student.network.weights, victim.weights))
    assert 0.8 < cosines[0] < cosines[1]
    assert cosines[1] > 0.995


def test_enough_orthogonal_questions_are_the_gradient_itself(tmp_path):
    problem = linear_problem()
    search = replace(GUIDED, probes=math.prod(SHAPE), probe_sigma=0.02, cells=0)
    theta, estimate = first_estimate(problem, search, tmp_path)
    truth = adjoint_gradient(problem, theta).gradient
    assert cosine(estimate, truth) > 0.999
    torch.testing.assert_close(estimate, truth, rtol=0.05, atol=0.02 * float(truth.abs().max()))


def test_the_guided_estimate_is_never_worse_than_the_student_it_is_guided_by(tmp_path):
    problem = linear_problem()
    theta, own = first_estimate(problem, replace(DISTILLED, probes=3), tmp_path)
    same, guided = first_estimate(problem, GUIDED, tmp_path)
    torch.testing.assert_close(same, theta)
    truth = adjoint_gradient(problem, theta).gradient
    assert cosine(guided, truth) > cosine(own, truth) + 0.02
    # A projection: what it leaves out is orthogonal to it.
    assert abs(float(((truth - guided) * guided).sum())) < 0.05 * float((guided**2).sum())


def test_guided_beats_plain_evolution_at_equal_calls_and_comes_near_the_white_box():
    problem = linear_problem()
    white = gradient_attack(problem, 12, learning_rate=0.5)
    search = replace(GUIDED, learning_rate=0.5, probes=4, cells=4)
    calls = least_calls(search, problem, 12)
    guided = black_box_attack(problem, search, calls, run=SearchRun(0))
    plain = population_search(
        problem, Evolution(), calls // calls_per_evaluation(problem), population=8, cells=4, run=SearchRun(0)
    )
    none = white.history[0].predicted_total_cte_m
    gain = [result.best.predicted_total_cte_m - none for result in (white, guided, plain)]
    assert gain[1] > gain[2] > 0
    assert gain[1] > 0.6 * gain[0]


@pytest.mark.parametrize("search", [GUIDED, DISTILLED], ids=lambda s: s.method)
def test_calls_are_exactly_what_was_announced_and_never_more_than_allowed(search):
    problem = linear_problem()
    counter = CountedPolicy(problem.policy)
    for evaluations in (1, 3):
        allowed = least_calls(search, problem, evaluations) + search.step_calls(problem) - 1
        counter.calls = 0
        result = black_box_attack(replace(problem, policy=counter), search, allowed)
        assert len(result.history) == evaluations == search.evaluations(problem, allowed)
        assert counter.calls == least_calls(search, problem, evaluations)
    with pytest.raises(BudgetError, match=f"at least {least_calls(search, problem, 1)} policy calls"):
        black_box_attack(problem, search, least_calls(search, problem, 1) - 1)


@pytest.mark.parametrize(
    "options", [{}, {"disturbances": Disturbances(noise=0.02, gain=0.05)}, {"cache_bytes": 0}]
)
@pytest.mark.parametrize("search", [GUIDED, DISTILLED], ids=lambda s: s.method)
def test_a_search_stopped_anywhere_resumes_to_the_bit(tmp_path, search, options):
    problem = linear_problem(**options)
    calls = least_calls(search, problem, 4)
    whole = black_box_attack(problem, search, calls, run=SearchRun(1))
    path = tmp_path / "state.safetensors"
    for stop in (0, 2):

        def stop_there(evaluation, stop=stop):
            if evaluation.iteration == stop:
                raise StoppedError

        with pytest.raises(StoppedError):
            black_box_attack(
                problem, search, calls, run=SearchRun(1, state_path=path, on_evaluation=stop_there)
            )
    resumed = black_box_attack(problem, search, calls, run=SearchRun(1, state_path=path))
    assert torch.equal(resumed.theta, whole.theta)
    strip = [[dataclasses.replace(e, seconds=0.0) for e in result.history] for result in (whole, resumed)]
    assert strip[0] == strip[1]
    with pytest.raises(SearchStateError, match="other settings"):
        black_box_attack(problem, replace(search, probe_sigma=0.2), calls, run=SearchRun(1, state_path=path))


@pytest.mark.slow
def test_what_is_kept_of_rendered_frames_changes_nothing():
    problem = toy_problem(2, 4, torch.float32)

    class Plain:
        """The same sensor, hiding that it could keep frames."""

        theta_shape, initial_theta, sense = (
            problem.sensor.theta_shape,
            problem.sensor.initial_theta,
            problem.sensor.sense,
        )

    assert isinstance(problem.sensor, Surrogate)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    others = [problem, replace(problem, cache_bytes=0), replace(problem, sensor=Plain())]
    seen = [VisitedDrive(each, theta).images(theta + 1.0) for each in others]
    torch.testing.assert_close(seen[1], seen[0], rtol=0, atol=0)
    torch.testing.assert_close(seen[2], seen[0], rtol=0, atol=0)
    assert float((seen[0] - VisitedDrive(problem, theta).images(theta)).abs().max()) > 0.05


def test_an_evaluation_is_the_closed_loop_of_the_victim():
    problem = linear_problem()
    result = black_box_attack(problem, GUIDED, least_calls(GUIDED, problem, 3))
    _, totals = evaluate(problem, result.theta)
    assert result.best.predicted_total_cte_m == pytest.approx(float(totals.protocol_cte_m.mean()), rel=1e-9)


def test_a_goal_reaches_victim_and_student():
    class GoalPolicy(Linear):
        goal_size = 2

        def forward(self, images, goals=None):
            assert goals.shape == (len(images), 2)
            return super().forward(images) * (goals[:, 0] - goals[:, 1])

    problem = linear_problem(goals=torch.tensor([[1.0, 0.0], [0.0, 1.0]]))
    victim = GoalPolicy(coarse_weights(0)).eval().requires_grad_(False)

    def student(shape, goal_size, bound_rad):
        assert goal_size == 2
        return GoalPolicy(torch.zeros(shape))

    search = replace(GUIDED, student=student)
    problem = replace(problem, policy=victim)
    result = black_box_attack(problem, search, least_calls(search, problem, 2))
    assert math.isfinite(result.best.loss_m)


def test_the_student_may_be_of_any_architecture(tmp_path):
    method, problem = METHODS["distilled"], linear_problem()
    own = FilePath(__file__).parents[3] / "examples" / "my_architecture.py"
    small = {"student": f"{own}:Mixer", "configuration": {"width": 8}}
    settings = SearchSettings(4, warm_pairs=2, cells=2, options=method.options(small))
    state = tmp_path / "state.safetensors"
    found = method.search(problem, settings, SearchRun(state_path=state))
    assert math.isfinite(found.best.loss_m)
    again = method.search(problem, settings, SearchRun(state_path=state))
    assert torch.equal(again.theta, found.theta)
    with pytest.raises(SearchStateError, match="other settings"):
        method.search(problem, replace(settings, options=None), SearchRun(state_path=state))
    with pytest.raises(MethodError, match=r"expected an architecture of pilotnet, .* got 'resnt'"):
        method.options({"student": "resnt"})
    with pytest.raises(MethodError, match=r"expected a setting of resnet of widths"):
        method.options({"student": "resnet", "configuration": {"depth": 3}})


def test_a_policy_with_memory_and_bad_settings_are_refused():
    class Remembering(Linear):
        stateless = False

    with pytest.raises(VictimError, match="stateless"):
        CountedPolicy(Remembering(coarse_weights(0)))
    for wrong in ({"probes": 0}, {"learning_rate": 0.0}, {"probe_sigma": -1.0}):
        with pytest.raises(ValueError, match="expected probes"):
            replace(GUIDED, **wrong)
    with pytest.raises(ValueError, match="counts >= 1"):
        replace(LIGHT, warm_pairs=0)


def test_lessons_keep_their_number_and_take_the_new_in():
    def lesson(count, value):
        return Lessons(
            torch.full((count, 2, 3, 2, 2), value, dtype=torch.uint8),
            torch.zeros(count, 0),
            torch.full((count, 2), float(value)),
        )

    kept = lesson(4, 1)
    kept.add(lesson(3, 2), 6, torch.Generator().manual_seed(0))
    assert len(kept) == 6
    assert int((kept.answers[:, 0] == 2.0).sum()) == 3
    assert torch.equal(kept.images[:, 0, 0, 0, 0].float(), kept.answers[:, 0])
    kept.add(lesson(9, 3), 6, torch.Generator().manual_seed(0))
    assert torch.equal(kept.answers, torch.full((6, 2), 3.0))


def test_an_onnx_policy_refuses_gradients_and_is_attacked_all_the_same(tmp_path):
    from advnerf_core.geometry import Pinhole
    from advnerf_core.policies.contract import PolicyContract
    from advnerf_core.policies.load import load_any_policy
    from advnerf_core.policies.onnx_policy import export_onnx
    from advnerf_core.policies.pilotnet import PilotNet
    from advnerf_core.policies.view import PolicyView

    torch.manual_seed(0)
    view = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
    export_onnx(PilotNet().eval(), PolicyContract(view), tmp_path / "victim.onnx")
    problem = toy_problem(2, 4, torch.float32, policy=load_any_policy(tmp_path / "victim.onnx").policy)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    with pytest.raises(BlackBoxError):
        adjoint_gradient(problem, theta)
    with pytest.raises(BlackBoxError):
        gradient_attack(problem, 1)
    search = BlackBoxSearch(probes=2, distillation=LIGHT)
    result = black_box_attack(problem, search, least_calls(search, problem, 3))
    assert len(result.history) == 3
    assert result.history[0].total_cte_m != result.history[2].total_cte_m


class Normalised(nn.Module):
    """A student with running statistics, which are no parameters."""

    def __init__(self):
        super().__init__()
        self.scale, self.out = nn.BatchNorm2d(3), nn.Linear(3, 1)

    def forward(self, images, goals=None):
        return self.out(self.scale(images).mean((2, 3)))[:, 0]


def test_a_student_comes_back_with_its_buffers():
    """A search that was stopped had gone on with a student that steers otherwise."""
    generator = torch.Generator().manual_seed(0)
    images = (torch.rand(16, 2, *SHAPE, generator=generator) * 255).to(torch.uint8)
    lessons = Lessons(images, torch.zeros(16, 0), torch.randn(16, 2, generator=generator))
    student = Student(lessons, Distillation(), 0, lambda *shape: Normalised())
    student.learn(10, generator)
    again = Student.from_tensors(student.tensors(), Distillation(), lambda *shape: Normalised())
    seen = torch.rand(4, *SHAPE, generator=generator)
    assert torch.equal(again(seen), student(seen))
