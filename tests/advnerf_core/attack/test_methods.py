"""The table of methods, and methods that users bring."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.methods import (
    GRADIENT_RATE,
    METHODS,
    Method,
    MethodError,
    SearchRun,
    SearchSettings,
    alternatives,
    black_box_methods,
    load_method,
    method_digest,
    method_names,
    require_method,
)
from advnerf_core.attack.search import textures
from advnerf_core.attack.search.black_box import BlackBoxSearch, BudgetError, black_box_attack
from advnerf_core.attack.search.cem import CrossEntropy
from advnerf_core.attack.search.distil import Distillation
from advnerf_core.attack.search.evolution import Evolution
from advnerf_core.attack.search.frame import CleanFrames, better_side
from advnerf_core.attack.search.gradient import Slope, adjoint_slope, climb, gradient_attack
from advnerf_core.attack.search.population import population_search
from advnerf_core.attack.search.random_search import best_drawn, random_search
from advnerf_core.attack.search.search import SearchStateError, gradient_step, random_spread
from advnerf_core.fields.colour_grid import colour_grid
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.plugins import PluginError, name_in_results
from advnerf_core.report.conditions import order_of
from advnerf_core.scene.surrogate import Surrogate
from tests.support.attack_toy import MOUNT, VIEW, painted_room, toy_problem
from tests.support.strangers import install_method, spiral_code, spiral_theta, write_spiral

ROOT = Path(__file__).parents[3]
LESSONS = Distillation(warm_pairs=2)


@pytest.fixture(scope="module")
def problem():
    return toy_problem(2, resolution=4, dtype=torch.float32)


def by_hand(problem):
    """What each method is, said with its own function and defaults."""
    black_box = {"cells": 2, "distillation": LESSONS}
    (only,) = problem.sensor.objects
    run = SearchRun(seed=3)

    def family(name, draw):
        return best_drawn(
            problem, lambda g: 5.0 * draw(colour_grid(only), g).reshape(4, 4, 3), 4, run, method=name
        )

    def frames():
        looked = CleanFrames(problem, problem.sensor.plain_theta())
        side = better_side(looked, problem.sensor.initial_theta(torch.Generator().manual_seed(3)))

        def slope(drawn, theta):
            return Slope(0.0, evaluate(drawn, theta)[1], -side * looked.deviation(theta)[1])

        return climb(problem, slope, 4, GRADIENT_RATE, run, method="frame")

    return {
        "random": lambda: random_search(problem, 4, 5.0, run=SearchRun(3)),
        "random_coarse": lambda: family("random_coarse", textures.coarse(2)),
        "random_levels": lambda: family("random_levels", textures.levels),
        "random_pink": lambda: family("random_pink", textures.pink),
        "random_natural": lambda: family("random_natural", textures.natural),
        "cem": lambda: population_search(problem, CrossEntropy(3.0), 4, 4, 2, run=SearchRun(3)),
        "evolution": lambda: population_search(problem, Evolution(1.0, 0.5), 4, 4, 2, run=SearchRun(3)),
        "gradient": lambda: gradient_attack(problem, 4, GRADIENT_RATE, run=SearchRun(3)),
        "gradient_coarse": lambda: climb(
            problem, adjoint_slope, 4, GRADIENT_RATE, run, 2, method="gradient_coarse"
        ),
        "frame": frames,
        # 4 evaluations of 2 starts and 2 ticks: 16 calls. 4 for the first lesson, 12 for a drive with one pair of questions.
        "guided": lambda: black_box_attack(
            problem, BlackBoxSearch("guided", 0.3, 1, **black_box), 16, run=SearchRun(3)
        ),
        "distilled": lambda: black_box_attack(
            problem, BlackBoxSearch("distilled", 0.1, 1, **black_box), 16, run=SearchRun(3)
        ),
    }


@pytest.mark.parametrize("name", METHODS)
def test_a_row_is_the_search_that_it_names(problem, name):
    settings = SearchSettings(4, population=4, cells=2, probes=1, warm_pairs=2)
    told = []
    result = METHODS[name].search(problem, settings, SearchRun(seed=3, on_evaluation=told.append))
    expected = by_hand(problem)[name]()
    assert torch.equal(result.theta, expected.theta)
    assert [e.protocol_cte_m for e in result.history] == [e.protocol_cte_m for e in expected.history]
    assert len(told) == len(result.history) == METHODS[name].evaluations(problem, settings)


def test_rows_are_in_the_order_of_tables():
    assert sorted(METHODS, key=order_of) == list(METHODS)


def test_what_is_asked_for_reaches_the_search(problem):
    def found(name, **settings):
        return (
            METHODS[name]
            .search(problem, SearchSettings(4, population=4, cells=2, **settings), SearchRun())
            .theta
        )

    assert torch.equal(found("random", sigma=2.0), random_search(problem, 4, 2.0).theta)
    assert torch.equal(found("random", random_sigma=2.0), random_search(problem, 4, 2.0).theta)
    assert torch.equal(found("gradient", learning_rate=0.5), gradient_attack(problem, 4, 0.5).theta)
    assert torch.equal(found("gradient", gradient_rate=0.5), gradient_attack(problem, 4, 0.5).theta)
    # What is usual for random textures and for gradients does not concern the others.
    usual = {"random_sigma": 2.0, "gradient_rate": 0.5}
    assert torch.equal(found("cem", **usual), population_search(problem, CrossEntropy(), 4, 4, 2).theta)
    evolution = Evolution(0.4, 0.2)
    assert torch.equal(
        found("evolution", sigma=0.4, learning_rate=0.2), population_search(problem, evolution, 4, 4, 2).theta
    )


def test_a_budget_of_questions_is_planned_as_it_is_spent(problem):
    # 12 evaluations are 48 calls; 600 of them would go into the usual first lesson.
    for name, drives in (("distilled", 3), ("guided", 1)):  # (48 - 4) // 12, (48 - 4) // 28
        assert METHODS[name].evaluations(problem, SearchSettings(12, warm_pairs=2)) == drives
        with pytest.raises(BudgetError, match="expected at least 6"):
            METHODS[name].evaluations(problem, SearchSettings(12))
    assert METHODS["gradient"].evaluations(problem, SearchSettings(12)) == 12


def test_a_sensor_with_a_scale_of_its_own_says_it(problem):
    mesh = MeshField(unwrapped(sphere(0.4, (0.5, 0.5, 0.5), 1), 8), np.eye(4))
    sensor = ShapeSensor(Surrogate(painted_room, VIEW, MOUNT, [mesh]), ShapeLimits(bound_m=0.2))
    shaped = dataclasses.replace(problem, sensor=sensor)
    assert gradient_step(shaped, SearchSettings()) == pytest.approx(0.05 * 0.2)
    assert random_spread(shaped, SearchSettings()) == sensor.random_sigma
    asked = SearchSettings(learning_rate=0.3, sigma=0.7)
    assert (gradient_step(shaped, asked), random_spread(shaped, asked)) == (0.3, 0.7)
    assert (gradient_step(problem, SearchSettings()), random_spread(problem, SearchSettings())) == (0.3, 5.0)


def test_names_and_needs_are_known_without_torch():
    code = (
        "import sys; from advnerf_core.attack.methods import METHODS, load_method, require_method; require_method('cem'); "
        "assert load_method('guided').single_images; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=600)


def test_methods_without_a_gradient():
    drawn = ("random", "random_coarse", "random_levels", "random_pink", "random_natural")
    assert black_box_methods() == (*drawn, "cem", "evolution", "guided", "distilled")
    assert black_box_methods(stateless=False) == (*drawn, "cem", "evolution")
    assert alternatives(black_box_methods(stateless=False)) == f"{', '.join(drawn)}, cem or evolution"
    assert alternatives(["random"]) == "random"


def test_a_method_of_a_file_searches_and_resumes(problem, tmp_path):
    write_spiral(tmp_path)
    spiral = load_method("spiral.py:Spiral", tmp_path)
    assert (spiral.needs_gradient, spiral.evaluations(problem, SearchSettings(7))) == (False, 7)
    settings = SearchSettings(5, options=spiral.options({"turns": 0.25}))
    whole = spiral.search(problem, settings, SearchRun(seed=2))
    best = spiral_theta(problem.sensor.theta_shape, whole.best.iteration, seed=2, turns=0.25)
    torch.testing.assert_close(whole.theta, best, rtol=1e-5, atol=1e-5)

    class StoppedError(Exception):
        pass

    def stop(evaluation):
        if evaluation.iteration == 2:
            raise StoppedError

    state = tmp_path / "state.safetensors"
    with pytest.raises(StoppedError):
        spiral.search(problem, settings, SearchRun(2, state, stop))
    resumed = spiral.search(problem, settings, SearchRun(2, state))
    assert torch.equal(resumed.theta, whole.theta)
    assert [e.loss_m for e in resumed.history] == [e.loss_m for e in whole.history]
    with pytest.raises(SearchStateError, match="other settings"):
        spiral.search(problem, dataclasses.replace(settings, options=spiral.options({})), SearchRun(2, state))


def test_a_method_of_an_installed_package_is_known_by_its_name(tmp_path, monkeypatch):
    install_method(tmp_path, monkeypatch, spiral_code())
    assert method_names() == (*METHODS, "spiral")
    assert isinstance(load_method("spiral"), Method)
    assert len(method_digest("spiral")) == 16
    with pytest.raises(
        PluginError,
        match=r"expected an attack method of random, .*, spiral; got 'spirel' \(did you mean spiral\?\)",
    ):
        load_method("spirel")


def test_names_are_fit_for_files_and_tables(tmp_path, monkeypatch):
    file = write_spiral(tmp_path)
    assert name_in_results(f"{file}:Spiral") == "Spiral"
    assert name_in_results("cem") == "cem"
    file.write_text(spiral_code() + "\ngradient = empty = Spiral\n")
    for taken in ("gradient", "empty"):
        with pytest.raises(PluginError, match=f"expected a name that no other condition has, got {taken}"):
            load_method(f"{file}:{taken}")
    install_method(tmp_path, monkeypatch, spiral_code(), "a spiral/of mine")
    with pytest.raises(PluginError, match="expected a name of letters, digits, - and _"):
        load_method("a spiral/of mine")


def test_the_digest_of_a_method_is_that_of_its_code(tmp_path):
    file = write_spiral(tmp_path)
    (tmp_path / "copy").mkdir()
    before, copied = (
        method_digest(f"{file}:Spiral"),
        method_digest(f"{write_spiral(tmp_path / 'copy')}:Spiral"),
    )
    assert before == copied != ""
    file.write_text(spiral_code() + "\n# another one\n")
    assert method_digest(f"{file}:Spiral") not in ("", before)
    assert {method_digest(name) for name in (*METHODS, "none")} == {""}


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (None, "expected a Python file at .*spiral.py, found none"),
        ("import a_package_that_is_not_there\n", "cannot be loaded: ModuleNotFoundError"),
        ("def search(:\n", "cannot be loaded: SyntaxError"),
        ("spiral = 1\n", r"expected a name in spiral.py of spiral; got 'Spiral' \(did you mean spiral\?\)"),
        (
            "def Spiral(problem, settings, run): ...\n",
            "expected a Method .*, got an object of type function; see docs/methods.md",
        ),
        ("class Spiral: ...\n", "expected a Method .*, got the class Spiral"),
        (
            "from advnerf_core.attack.methods import Method\nSpiral = Method(print, Options=dict(turns=1))\n",
            "cannot be loaded: MethodError: expected Options to be a dataclass or a pydantic model, got {'turns': 1}",
        ),
    ],
)
def test_a_broken_method_is_one_line_and_harms_no_other(tmp_path, body, message):
    if body is not None:
        (tmp_path / "spiral.py").write_text(body)
        require_method("spiral.py:Spiral", tmp_path)  # nothing is loaded
    with pytest.raises(PluginError, match=message) as caught:
        load_method("spiral.py:Spiral", tmp_path)
    assert "\n" not in str(caught.value)
    assert load_method("random") is METHODS["random"]


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            {"turn": 1},
            r"search.options.turn: expected an option of this method of turns, growth; got 'turn' \(did you mean turns\?\)",
        ),
        ({"turns": "many"}, "search.options.turns: input should be a valid number, .*got 'many'"),
    ],
)
def test_wrong_options_are_one_line_with_their_key(tmp_path, written, message):
    write_spiral(tmp_path)
    spiral = load_method("spiral.py:Spiral", tmp_path)
    assert dataclasses.asdict(spiral.options({"turns": 3})) == {"turns": 3.0, "growth": 0.2}
    with pytest.raises(MethodError, match=message):
        spiral.options(written, "search.options")
    with pytest.raises(
        MethodError,
        match=r"search.options.turns: expected no option of this method, as there is none; got 'turns'",
    ):
        METHODS["gradient"].options({"turns": 1}, "search.options")
