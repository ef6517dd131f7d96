"""Common parts of all searches: the record of evaluations, the best evaluation, and a state file to resume from.

The closed loop is chaotic, so the last evaluation is rarely the best: every search keeps the best by the value of the problem's
objective. A state file is written after every evaluation, whole or not at all; a search resumed from it gives the same bits (on one machine
and one number of threads) as one that was never stopped.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, Totals, evaluate
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.objective import CrossTrackError
from advnerf_core.attack.problem import ScaledSensor, ZeroGradientError
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.errors import AdvnerfError, NotFiniteError
from advnerf_core.files import read_tensors, write_atomically

_FORMAT = "advnerf-search-1"


class SearchStateError(AdvnerfError, ValueError):
    """A search cannot be resumed from its state file."""


@dataclass
class SearchState:
    """Everything a search needs to resume; ``tensors`` depends on the kind of search.

    Attributes:
        tensors: Search-specific tensors: current theta, optimiser moments, random generator.
        best_theta: Best parameters yet; None before the first evaluation.
    """

    tensors: dict[str, Tensor]
    best_theta: Tensor | None = None
    history: list[Evaluation] = field(default_factory=list)

    @property
    def best(self) -> Evaluation:
        """The best finished evaluation; the first of equals."""
        return max(self.history, key=lambda e: (e.value, -e.iteration))

    def record(self, theta: Tensor, loss_m: float, totals: Totals, seconds: float) -> Evaluation:
        """Add an evaluation of ``theta``."""
        evaluation = Evaluation(
            len(self.history),
            loss_m,
            tuple(totals.total_cte_m.tolist()),
            tuple(totals.protocol_cte_m.tolist()),
            seconds,
            tuple(totals.values.tolist()),
        )
        self.history.append(evaluation)
        if self.best is evaluation:
            # Files keep no strides, such as those of a transposed theta.
            self.best_theta = theta.detach().clone(memory_format=torch.contiguous_format)
        return evaluation

    def result(self) -> SearchResult:
        """The current result.

        Raises:
            SearchStateError: Nothing was evaluated.
        """
        if self.best_theta is None:
            raise SearchStateError("expected at least one evaluation before the result of a search, got none")
        return SearchResult(self.best_theta, self.best, tuple(self.history))

    def save(self, path: Path, fingerprint: str) -> None:
        """Write the state file. Each name gets its own tensor, even if a method has two names for one.

        Raises:
            SearchStateError: A value in ``tensors`` is not a tensor, or has the name of the best theta.
        """
        assert self.best_theta is not None
        wrong = [name for name, value in self.tensors.items() if not isinstance(value, Tensor)]
        if wrong or "best_theta" in self.tensors:
            got = (
                f"{wrong[0]}: {type(self.tensors[wrong[0]]).__name__}"
                if wrong
                else "best_theta, which is kept for the method"
            )
            raise SearchStateError(
                f"expected tensors under names of their own in a search's state, got {got}"
            )
        header = {"format": _FORMAT, "fingerprint": fingerprint}
        header["history"] = json.dumps([asdict(evaluation) for evaluation in self.history])
        kept = {
            name: value.detach().clone(memory_format=torch.contiguous_format)
            for name, value in self.tensors.items()
        }
        write_atomically(path, save({**kept, "best_theta": self.best_theta}, metadata=header))


def load_state(path: Path, fingerprint: str) -> SearchState:
    """Read a state file that a search with the same settings wrote."""
    try:
        header, tensors = read_tensors(path, "torch")
        if header.get("format") != _FORMAT:
            raise SearchStateError(
                f"expected {path} to be a search state of format {_FORMAT}; delete it to start afresh"
            )
        history = [evaluation_from_json(entry) for entry in json.loads(header["history"])]
        best_theta = tensors.pop("best_theta")
    except (OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, SearchStateError):
            raise
        raise SearchStateError(f"cannot resume from {path} ({error}); delete it to start afresh") from error
    if header.get("fingerprint") != fingerprint:
        raise SearchStateError(
            f"{path} belongs to a search with other settings, or to one before a file that it names has changed; delete it, or use another folder"
        )
    return SearchState(tensors, best_theta, history)


def begin(path: Path | None, fingerprint: str, fresh: Callable[[], dict[str, Tensor]]) -> SearchState:
    """The state in ``path`` if the file exists, else a fresh one with these tensors."""
    if path is not None and path.exists():
        return load_state(path, fingerprint)
    return SearchState(fresh())


def begin_drawing(
    run: SearchRun, fingerprint: str, fresh: Callable[[torch.Generator], dict[str, Tensor]]
) -> tuple[SearchState, torch.Generator]:
    """The state of a search that draws, and its generator in the state's position.

    Args:
        fresh: Tensors of a new search; their random values come from the generator.
    """
    generator = torch.Generator().manual_seed(run.seed)

    def started() -> dict[str, Tensor]:
        tensors = fresh(generator)
        return {**tensors, "generator": generator.get_state()}

    state = begin(run.state_path, fingerprint, started)
    generator.set_state(state.tensors["generator"])
    return state, generator


def go_on(
    state: SearchState, run: SearchRun, fingerprint: str, evaluations: int, step: Callable[[], Evaluation]
) -> SearchResult:
    """Evaluate until a state has ``evaluations`` evaluations.

    Args:
        run: State file, and callback, which is called when the state is on disk.
        evaluations: Total evaluations, including a resumed state's.
        step: Makes and records the next evaluation, and updates the tensors of the state.
    """
    if evaluations < 1:
        raise ValueError(f"expected at least one evaluation, got {evaluations}")
    while len(state.history) < evaluations:
        _keep(step(), state, run, fingerprint)
    return state.result()


def _keep(evaluation: Evaluation, state: SearchState, run: SearchRun, fingerprint: str) -> Evaluation:
    if run.state_path is not None:
        state.save(run.state_path, fingerprint)
    if run.on_evaluation is not None:
        run.on_evaluation(evaluation)
    return evaluation


def without_gradient(problem: AttackProblem, theta: Tensor, number: int) -> tuple[float, Totals]:
    """Loss and totals of evaluation ``number`` of a search without a gradient."""
    _, totals = evaluate(problem.at_draw(number), theta)
    loss_m = float(totals.losses.mean())
    if problem.regulariser is not None:
        loss_m += problem.regulariser(theta)[0]
    return loss_m, totals


def require_slope(theta: Tensor, gradient: Tensor, number: int) -> None:
    """Raise `ZeroGradientError` if the gradient of the first evaluation is zero."""
    if number == 0 and not bool(gradient.any()):
        raise ZeroGradientError(theta)


def require_finite(loss_m: float, gradient: Tensor, number: int) -> None:
    """Raise `NotFiniteError` unless loss and gradient of evaluation ``number`` are finite."""
    if not (math.isfinite(loss_m) and bool(torch.isfinite(gradient).all())):
        raise NotFiniteError(
            f"expected a finite loss and gradient at evaluation {number}, got loss {loss_m}; the policy's own gradient is finite: check the gradients of "
            "the objects and the scene for NaN"
        )


def evaluate_theta(
    problem: AttackProblem, theta: Tensor, state: SearchState, run: SearchRun, fingerprint: str
) -> Evaluation:
    """The next evaluation of a search without a gradient: driven, recorded, saved, then reported to the callback.

    Args:
        theta: Theta to evaluate, of the sensor's ``theta_shape``.
        state: State of the search, with tensors ready to be saved.
        fingerprint: Fingerprint of the search, see `search_fingerprint`.

    Raises:
        NotFiniteError: The drive is not finite.
    """
    began = time.perf_counter()
    loss_m, totals = without_gradient(problem, theta, len(state.history))
    evaluation = state.record(theta, loss_m, totals, time.perf_counter() - began)
    return _keep(evaluation, state, run, fingerprint)


def gradient_step(problem: AttackProblem, settings: SearchSettings) -> float:
    """Step of Adam along a gradient: from the settings, else from the sensor, else the usual one of colours."""
    if settings.learning_rate is not None:
        return settings.learning_rate
    return (
        problem.sensor.learning_rate if isinstance(problem.sensor, ScaledSensor) else settings.gradient_rate
    )


def random_spread(problem: AttackProblem, settings: SearchSettings) -> float:
    """Spread of random thetas: from the settings, else from the sensor, else the usual one of colours."""
    if settings.sigma is not None:
        return settings.sigma
    return problem.sensor.random_sigma if isinstance(problem.sensor, ScaledSensor) else settings.random_sigma


def evaluation_from_json(entry: dict[str, Any]) -> Evaluation:
    """Restore an evaluation from the JSON of its ``dataclasses.asdict``; state files without values belong to ``cte``."""
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()
    }
    values.setdefault("values", values["protocol_cte_m"])
    return Evaluation(**values)


def search_fingerprint(problem: AttackProblem, theta_shape: tuple[int, ...], **settings: Any) -> str:
    """Hash of everything that must be the same when a search is resumed (its length may differ)."""
    if problem.objective != CrossTrackError():
        # Addresses of what a user's objective keeps differ in the process that goes on.
        kept = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(vars(problem.objective)))
        settings["objective"] = type(problem.objective).__qualname__, kept
    text = json.dumps({"steps": problem.steps, "theta_shape": list(theta_shape), **settings}, sort_keys=True)
    digest = hashlib.sha256(text.encode())
    if problem.disturbances is not None:
        digest.update(repr(problem.disturbances).encode())
    digest.update(problem.start_states.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def draw_start_states(
    nominal: tuple[float, float, float],
    count: int,
    sigma: float = 0.1,
    seed: int = 0,
    path: int = 0,
    nominal_first: bool = True,
) -> Tensor:
    """Start poses ``[count, 3]`` float64, normal around the nominal one: the rule of experiments and of requests.

    Args:
        nominal: x [m], y [m], yaw [rad].
        count: Number of starts.
        sigma: Spread of x and y [m]; of headings a quarter of it [rad], as a tenth of a radian is 2.4 m of error at the junction.
        seed: Seed, drawn once per attack.
        path: Number of the path, so that paths have different starts.
        nominal_first: Whether the first start is the nominal one.
    """
    if count < 1:
        raise ValueError(f"expected at least one start, got {count}")
    noise = np.random.default_rng([seed, path]).standard_normal((count, 3))
    if nominal_first:
        noise[0] = 0.0
    return torch.from_numpy(np.array(nominal) + sigma * np.array([1.0, 1.0, 0.25]) * noise)
