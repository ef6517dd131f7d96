"""Checks that a method of attack keeps its contract (docs/methods.md), with one finding for each part of it, on an attack of a second."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.methods import Method, MethodError, SearchRun, SearchSettings, load_method
from advnerf_core.attack.problem import AttackProblem, BlackBoxError
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.attack.spaces.space import require_driven
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.path import Line
from advnerf_core.driving.path import Path as Reference
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.geometry import Pinhole, camera_mount, make_transform
from advnerf_core.plugins import torch_left_as_it_is
from advnerf_core.scene.surrogate import Surrogate
from nodes.runtime.findings import CheckFinding, NotMet, look_at_all

_CAMERA = Pinhole(width=24, height=12, fx=15.0, fy=15.0, cx=12.0, cy=6.0)
_STEPS, _EVALUATIONS, _STOPPED_AFTER = 4, 6, 2
_SEED, _OTHER_SEED = 3, 4
_SETTINGS = SearchSettings(_EVALUATIONS, population=4, cells=2, probes=1, warm_pairs=2)
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class _Stopped(Exception):
    """The search was killed after an evaluation."""


class _Brighter:
    """A policy that steers towards the brighter half of the image and counts the images that it gets."""

    stateless, training, goal_size = True, False, 0

    def __init__(self, differentiable: bool = True) -> None:
        self.differentiable = differentiable
        self.asked = 0

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad] of images ``[B, 3, H, W]``."""
        self.asked += len(images)
        left, right = images.mean((1, 2)).chunk(2, dim=1)
        steering = 0.3 * torch.tanh(4.0 * (left.mean(1) - right.mean(1)))
        return steering if self.differentiable else steering.detach()


def _grey_room(poses: Any, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
    """Colours ``[B, H, W, 3]`` and depth ``[B, H, W]`` [m] around the car."""
    size = (len(poses), pinhole.height, pinhole.width)
    return torch.full((*size, 3), 0.5), torch.full(size, 8.0, dtype=torch.float64)


def _problem(differentiable: bool = True) -> AttackProblem:
    board = cube_face_object(
        0.8, 4, T_world_from_object=make_transform(np.diag([-1.0, -1.0, 1.0]), [3.0, 0.5, 0.2])
    )
    return AttackProblem(
        _Brighter(differentiable),
        Surrogate(_grey_room, _CAMERA, camera_mount(0.0, 0.0, 0.2, 0.0), board, dtype=torch.float32),
        Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1),
        Reference.from_segments((0.0, 0.0, 0.0), [Line(10.0)], closed=False),
        torch.tensor([[0.0, 0.05, 0.0], [0.0, -0.08, 0.0]], dtype=torch.float64),
        steps=_STEPS,
    )


@dataclass(frozen=True, eq=False)
class MethodBench:
    """A method under test.

    Attributes:
        settings: Budget and the method's own options.
        folder: An empty folder for states.
    """

    method: Method
    settings: SearchSettings
    folder: Path

    def search(
        self,
        seed: int = _SEED,
        state: str = "",
        stop_after: int = 0,
        settings_hash: str = "",
        problem: AttackProblem | None = None,
    ) -> tuple[SearchResult, list[Evaluation]]:
        """Result of a search, and the evaluations passed to its callback.

        Args:
            state: Name of its state file; empty for none.
            stop_after: Evaluations after which it is killed; 0 for never.
            problem: The attack problem; a fresh one if None.
        """
        told: list[Evaluation] = []

        def tell(evaluation: Evaluation) -> None:
            told.append(evaluation)
            if stop_after and len(told) == stop_after:
                raise _Stopped

        run = SearchRun(seed, self.folder / state if state else None, tell, settings_hash)
        with torch_left_as_it_is():
            found: object = self.method.search(problem or _problem(), self.settings, run)
        if not isinstance(found, SearchResult) or not isinstance(found.theta, Tensor):
            got = getattr(found, "theta", found)
            raise NotMet(
                f"expected search to return a SearchResult with a tensor theta, got {type(got).__name__}; return the state's result()"
            )
        return found, told


def keeps_to_its_budget(bench: MethodBench) -> str:
    """The history has as many evaluations as the method announces, at most the budget's, each called back once."""
    problem = _problem()
    planned = bench.method.evaluations(problem, bench.settings)
    result, told = bench.search(problem=problem)
    count = len(result.history)
    if planned > _EVALUATIONS:
        raise NotMet(f"expected Method.evaluations of at most the budget of {_EVALUATIONS}, got {planned}")
    if count != planned:
        raise NotMet(f"expected {planned} evaluations, as Method.evaluations says, got {count}")
    if len(told) != count:
        raise NotMet(
            f"expected run.on_evaluation to be called after each of {count} evaluations, got {len(told)} calls"
        )
    if [each.iteration for each in result.history] != list(range(count)):
        raise NotMet("expected evaluations numbered from 0 in their order")
    allowed = _EVALUATIONS * _STEPS * len(problem.start_states)
    if problem.policy.asked > allowed and not bench.method.needs_gradient:
        raise NotMet(
            f"expected at most {allowed} images that the policy is asked about, those of {_EVALUATIONS} drives, got {problem.policy.asked}; drives beside "
            "the counted ones are of the same budget"
        )
    return f"{count} evaluations of {_EVALUATIONS}; the policy was asked about {problem.policy.asked} images"


def returns_its_best(bench: MethodBench) -> str:
    """Theta has the sensor's shape and is finite, and gives the best evaluation, which is the largest of the history."""
    result, _ = bench.search()
    shape = tuple(_problem().sensor.theta_shape)
    if tuple(result.theta.shape) != shape or not bool(torch.isfinite(result.theta).all()):
        raise NotMet(f"expected finite theta of shape {list(shape)}, got {list(result.theta.shape)}")
    largest = max(each.predicted_total_cte_m for each in result.history)
    if result.best.predicted_total_cte_m != largest:
        raise NotMet(
            f"expected the best evaluation, {largest:.3f} m, got one of {result.best.predicted_total_cte_m:.3f} m"
        )
    try:
        require_driven(_problem(), result, within=1e-6)
    except MethodError as error:
        raise NotMet(str(error)) from None
    return f"theta {list(shape)}, best {largest:.3f} m"


def depends_on_the_seed(bench: MethodBench) -> str:
    """One seed gives the same bytes twice; another seed gives another start."""
    first, again, other = bench.search()[0], bench.search()[0], bench.search(_OTHER_SEED)[0]
    if not _same(first, again):
        raise NotMet(
            "expected the same bytes from the same seed, got others; draw from a generator with run.seed"
        )
    if torch.equal(first.theta, other.theta) and _losses(first) == _losses(other):
        raise NotMet(
            f"expected other textures from seed {_OTHER_SEED} than from {_SEED}, got the same; use run.seed"
        )
    return "the same bytes from one seed, other textures from another"


def resumes_to_the_bit(bench: MethodBench) -> str:
    """A search that is killed and resumed from its state file ends with the same bytes as an uninterrupted one."""
    whole, _ = bench.search()
    stops = [each for each in (1, _STOPPED_AFTER) if each < len(whole.history)]
    for stop_after in stops:
        name = f"resumed{stop_after}.state"
        with contextlib.suppress(_Stopped):
            bench.search(state=name, stop_after=stop_after)
        if not (bench.folder / name).is_file():
            raise NotMet(
                f"expected a state file after evaluation {stop_after}, got none; write run.state_path before run.on_evaluation"
            )
        resumed, told = bench.search(state=name)
        if len(told) != len(whole.history) - stop_after:
            raise NotMet(
                f"expected {len(whole.history) - stop_after} evaluations after {stop_after}, got {len(told)}; begin() reads the state file"
            )
        if not _same(whole, resumed):
            raise NotMet(
                f"expected the bytes of a search that was not stopped after evaluation {stop_after}, got others; keep everything that the"
                " next step needs in state.tensors, also the generator's state"
            )
    if not stops:
        return "not checked: the budget holds one evaluation only"
    return f"the same bytes after a stop at evaluation {' and at '.join(map(str, stops))}"


def refuses_another_state(bench: MethodBench) -> str:
    """A state file of another seed or other settings is rejected."""
    bench.search(state="other.state", settings_hash="one")
    for changed, values in (("seed", (_OTHER_SEED, "one")), ("settings_hash", (_SEED, "two"))):
        try:
            bench.search(values[0], "other.state", settings_hash=values[1])
        except SearchStateError:
            continue
        raise NotMet(
            f"expected SearchStateError for a state file of another {changed}, got a result; put run.{changed} into search_fingerprint"
        )
    return "state files of another seed and of other settings are refused"


def says_what_it_needs(bench: MethodBench) -> str:
    """A method that declares that it needs no gradient searches against a policy without one."""
    if bench.method.needs_gradient:
        return "needs a gradient, and says so"
    try:
        bench.search(problem=_problem(differentiable=False))
    except BlackBoxError as error:
        raise NotMet(f"expected needs_gradient=True of a method that asks for a gradient: {error}") from None
    return "needs no gradient"


def writes_only_its_state(bench: MethodBench) -> str:
    """The method writes no file but its state."""
    with _watched() as written:
        bench.search(state="written.state")
    # Compiled kernels and byte code are not results.
    outside = [path for path in written if not path.is_relative_to(bench.folder) and not _is_cache(path)]
    if outside:
        raise NotMet(
            f"expected no files but the state file, got {outside[0]}; keep what you need in state.tensors"
        )
    return "its state file alone"


CHECKS: Mapping[str, Callable[[MethodBench], str]] = {
    "budget": keeps_to_its_budget,
    "result": returns_its_best,
    "seeds": depends_on_the_seed,
    "resuming": resumes_to_the_bit,
    "state file": refuses_another_state,
    "needs": says_what_it_needs,
    "writes": writes_only_its_state,
}
"""Parts of the contract, in the order of the report."""


def check_method(reference: str, options: Mapping[str, Any] | None = None) -> list[CheckFinding]:
    """A finding for each part of the contract; the first one alone if the method cannot search at all.

    Args:
        reference: A built-in name, an entry point's name, or ``file.py:Name``.

    Raises:
        PluginError: The method is unknown, or cannot be loaded.
        MethodError: The method has no such options.
    """
    method = load_method(reference)
    settings = replace(_SETTINGS, options=method.options(options or {}))
    with tempfile.TemporaryDirectory(prefix="advnerf-method-") as folder:
        bench = MethodBench(method, settings, Path(folder).resolve())
        return look_at_all(CHECKS, bench)


def _losses(result: SearchResult) -> list[tuple[float, tuple[float, ...]]]:
    return [(each.loss_m, each.protocol_cte_m) for each in result.history]


def _same(one: SearchResult, other: SearchResult) -> bool:
    return torch.equal(one.theta, other.theta) and _losses(one) == _losses(other)


_watching: list[Path] | None = None
_hooked = False


def _on_audit(event: str, arguments: tuple[Any, ...]) -> None:
    if _watching is None or event not in ("open", "os.mkdir", "os.rename", "os.remove"):
        return
    path = arguments[0]
    if not isinstance(path, str | bytes | os.PathLike) or (event == "open" and not arguments[2] & _WRITING):
        return
    _watching.append(Path(os.path.abspath(os.fsdecode(path))))


@contextmanager
def _watched() -> Iterator[list[Path]]:
    """Files that Python code of this process writes, creates, renames or removes in this context."""
    global _watching, _hooked
    if not _hooked:
        sys.addaudithook(_on_audit)  # hooks cannot be removed
        _hooked = True
    written: list[Path] = []
    _watching = written
    try:
        yield written
    finally:
        _watching = None


def _is_cache(path: Path) -> bool:
    kernels = os.environ.get("NUMBA_CACHE_DIR")
    in_kernels = kernels is not None and path.is_relative_to(kernels)
    return in_kernels or "__pycache__" in path.parts or path == Path(os.devnull)
