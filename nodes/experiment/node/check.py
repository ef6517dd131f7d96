"""``advnerf attack check``: checks whether the gradient is correct for this scene, this policy and these objects, and useful."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from advnerf_core.attack.adjoint import AdjointResult, AttackProblem, BlackBoxError, adjoint_gradient
from advnerf_core.attack.closed_loop import ClosedLoopCosine, closed_loop_cosine
from advnerf_core.attack.health import (
    TickHealth,
    TimeSplit,
    central_slopes,
    closed_loss,
    frozen_loss,
    random_directions,
    relative_error,
    slopes_of,
    tick_health,
    time_split,
)
from advnerf_core.attack.health_plot import draw_health
from advnerf_core.attack.methods import alternatives, black_box_methods
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.files import write_atomically, write_json
from nodes.experiment.node.memory import measured_mib
from nodes.experiment.node.prepare import prepare
from nodes.experiment.plan.space_config import MeshShapeConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import colour_space
from nodes.experiment.steps.attack import Prepared
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

# Smooth parts agree to 1e-7 in float64; a kink of |CTE| or a clipped pixel within a step costs some of that.
EXACT, FLOAT32_EXACT = 1e-4, 1e-2
MEMORY_GROWTH, MUCH = 1.1, 0.5
_STEP = 1e-3  # in theta, along unit directions
_CLOSED_DIRECTIONS = 4  # each costs twelve drives of the closed loop


@dataclass(frozen=True)
class Check:
    """Result of the check.

    Attributes:
        frozen_error: Relative error of the gradient against finite differences with frozen poses, float64.
        float32_error: Relative difference of the gradient as the attack computes it to the one in float64.
        closed: The cosine to the true closed loop, over steps of the finite differences; information only.
        adjoint: Derivatives along the directions, by the adjoint.
        frozen: Derivatives along the directions, by finite differences with frozen poses.
        ticks: Adjoints, saturation and visibility over time.
        memory_mib: Peak above idle by horizon, with an empty cache; empty if it was not measured.
        unit: Unit of the objective.
    """

    frozen_error: float
    float32_error: float
    gradient_norm: float
    adjoint: tuple[float, ...]
    frozen: tuple[float, ...]
    clean: CleanDrive
    closed: ClosedLoopCosine
    ticks: TickHealth
    split: TimeSplit
    memory_mib: dict[int, float]
    unit: str

    @property
    def sound(self) -> bool:
        """Whether the gradient is correct, and not zero."""
        return self.frozen_error <= EXACT and self.float32_error <= FLOAT32_EXACT and self.gradient_norm > 0.0

    @property
    def verdict(self) -> list[str]:
        """The result as text."""
        return [*_on_the_gradient(self), *_on_the_drive(self), *_on_the_cost(self)]


def check(request: Experiment, directions: int, memory: bool, report: Report) -> Check:
    """Measure everything at the start of the attack; disturbances and smoothness as requested.

    Raises:
        BlackBoxError: The policy has no gradient.
        ConfigError: Shapes are attacked, whose gradient is random.
    """
    prepared = prepare(request)
    colours = colour_space(request, prepared.space.surrogate)
    prepared = replace(prepared, space=colours, problem=replace(prepared.problem, sensor=colours.sensor))
    if not prepared.problem.differentiable:
        raise BlackBoxError(
            f"victim {prepared.cell.victim} has no gradient that could be checked; search with {alternatives(black_box_methods())}"
        )
    if isinstance(request.config.space, MeshShapeConfig):
        raise ConfigError(
            "the gradient of shapes is a Monte Carlo estimate, which this check would call wrong; 'python -m benchmarks.mesh_render' "
            "compares it with finite differences"
        )
    theta = colours.surrogate.initial_theta(torch.Generator().manual_seed(prepared.seed))
    report(0.05, "time of a gradient")
    split, result = time_split(prepared.problem, theta)
    ticks = tick_health(prepared.problem, result)
    report(0.15, "finite differences with frozen poses")
    exact = in_double(prepared)
    along = random_directions(theta.double(), directions, prepared.seed)
    reference, frozen = _frozen_slopes(exact, theta.double(), along)
    closed = closed_loop_cosine(
        partial(closed_loss, exact),
        theta.double(),
        reference.gradient,
        min(directions, _CLOSED_DIRECTIONS),
        seed=prepared.seed,
        told=lambda done: report(0.3 + 0.4 * done, "finite differences of the closed loop"),
    )
    adjoint = slopes_of(reference.gradient, along)
    return Check(
        relative_error(adjoint, frozen),
        relative_error(result.gradient.double().flatten().numpy(), reference.gradient.flatten().numpy()),
        float(reference.gradient.norm()),
        tuple(adjoint),
        tuple(frozen),
        prepared.clean_drive,
        closed,
        ticks,
        split,
        _memory(request, report) if memory else {},
        prepared.problem.objective.unit,
    )


def in_double(prepared: Prepared) -> AttackProblem:
    """The problem in float64, where finite differences can confirm a gradient; the learned background stays float32.

    Its frames are remembered, as finite differences with frozen poses ask for the same ones again.
    """
    problem, policy = prepared.problem, prepared.problem.policy
    if isinstance(policy, nn.Module):
        policy = copy.deepcopy(policy).double().eval()
    goals = None if problem.goals is None else problem.goals.double()
    surrogate = prepared.space.surrogate.in_type(torch.float64).remembering(problem.cache_bytes)
    sensor = colour_space(prepared.experiment, surrogate).sensor
    return replace(problem, policy=policy, sensor=sensor, goals=goals)


def _frozen_slopes(problem: AttackProblem, theta: Tensor, along: Tensor) -> tuple[AdjointResult, Any]:
    reference = adjoint_gradient(problem, theta)
    loss = partial(frozen_loss, problem, rollout=reference.rollout)
    return reference, central_slopes(loss, theta, along, _STEP)


def _memory(request: Experiment, report: Report) -> dict[int, float]:
    # Below two time batches the batch itself is not full yet.
    found, shortest = {}, max(request.searched_ticks, 2 * request.config.attack.time_batch)
    report(0.7, "memory")
    for ticks, mib in measured_mib(request, (shortest, 2 * shortest, 4 * shortest)):
        found[ticks] = mib
        report(0.7 + len(found) / 10, f"memory at T = {ticks}")
    return found


def _on_the_gradient(found: Check) -> list[str]:
    if not any((*found.ticks.lambda_position, *found.ticks.lambda_yaw)):
        return [
            "NO GRADIENT: the objective does not change with the car's states on this drive: is it a hinge that is not reached, or a count?"
        ]
    if found.gradient_norm == 0.0 and any(found.ticks.visible):
        return [
            "NO GRADIENT: an object is seen, but the policy's gradient in the picture is zero: look for argmax, rounding, clamping or a saturated output, "
            "or it does not use the picture (advnerf policy check); methods without a gradient still work"
        ]
    if found.gradient_norm == 0.0:
        return ["NO GRADIENT: no pixel of an object reaches a control; move the objects, or the start poses"]
    right = found.frozen_error <= EXACT
    lines = [
        f"gradient {'right' if right else 'WRONG'}: {found.frozen_error:.1e} from finite differences with frozen poses "
        f"(expected <= {EXACT:.0e})"
    ]
    if not right:
        lines.append(
            "  is the policy smooth, in eval mode, and free of randomness? is its declared stateless true?"
        )
    if found.float32_error > FLOAT32_EXACT:
        lines.append(
            f"float32 NOT ENOUGH: {found.float32_error:.1e} from float64 (expected <= {FLOAT32_EXACT:.0e})"
        )
    lines.append(f"{found.closed.in_words} (information; the method does not claim it)")
    return lines


def _on_the_drive(found: Check) -> list[str]:
    ticks, lines = found.ticks, found.clean.lines
    saturated = sum(ticks.saturated) / len(ticks.saturated)
    lines.append(
        f"steering saturated in {saturated:.0%} of the frames"
        + _because(
            saturated > MUCH, "they give no gradient: is the policy too sharp, or the start too far off?"
        )
    )
    if ticks.visible:
        seen = sum(ticks.visible) / len(ticks.visible)
        lines.append(
            f"an object is seen in {seen:.0%} of the frames"
            + _because(seen < 0.1, "the attack has little to work with: move the objects toward the path")
        )
    largest = max(ticks.lambda_yaw)
    lines.append(
        f"adjoint of the yaw: {ticks.lambda_yaw[0]:.3g} {found.unit}/rad at the start, at most {largest:.3g}"
    )
    return lines


def _on_the_cost(found: Check) -> list[str]:
    split, lines = found.split, []
    each = {
        "render": split.render_s,
        "policy in the drive": split.drive_s,
        "policy backward": split.backward_s,
        "vjp": split.vjp_s,
    }
    times = ", ".join(f"{name} {1e3 * seconds / split.frames:.1f}" for name, seconds in each.items())
    lines.append(f"time a frame [ms]: {times}")
    if found.memory_mib:
        peaks = list(found.memory_mib.values())
        growth = peaks[-1] / peaks[0]
        text = ", ".join(f"{mib:.0f} MiB at T = {ticks}" for ticks, mib in found.memory_mib.items())
        lines.append(f"peak memory {text}" + _because(growth > MEMORY_GROWTH, "it grows with the horizon"))
    return lines


def _because(bad: bool, why: str) -> str:
    return f" - {why}" if bad else ""


def write_check(found: Check, folder: Path) -> tuple[Path, Path]:
    """Write ``check.json`` and ``check.png``."""
    data = {
        **asdict(found),
        "closed": found.closed.to_dict(),
        "clean": found.clean.to_dict(),
        "sound": found.sound,
        "verdict": found.verdict,
    }
    data["gradient_pass_ms_per_frame"] = 1e3 * found.split.gradient_pass_s / found.split.frames
    table, picture = folder / "check.json", folder / "check.png"
    write_json(table, data)
    image = draw_health(
        found.adjoint, found.frozen, found.closed, found.ticks, found.memory_mib, found.split, found.unit
    )
    write_atomically(picture, image)
    return table, picture
