"""The gate of every experiment: a scene in which the policy steers differently from real pictures is not attacked.

A mean PSNR does not show whether the wall by which the car steers was learned. The steering on held-out views along the paths does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from nodes.experiment.plan.config import POLICY
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.policy import agreement
from nodes.runtime.errors import RuntimeFault

STEERING = "steering"
# The room's victims differ by 0.04; all published sets, of wheel angles and turn rates, correlate by 0.998 or better.
MOST_DIFFERENCE, LEAST_CORRELATION = 0.25, 0.9


def require_same_steering(
    experiment: Experiment, may_go_on: bool = False, say: Callable[[str], None] = print
) -> None:
    """Raise for a learned scene in which a victim steers differently from real pictures of the same places, where the key ``gate`` is ``steering``.

    Of the victims that the section policy trains as it is the first one is judged, of all others each. If the run may go on, a rejection is
    only said, as a warning.

    Raises:
        RuntimeFault: The scene is rejected.
    """
    if experiment.config.gate != STEERING:
        return
    for victim, views in steering_of_victims(experiment).items():
        wrong = other_steering(views, experiment.car.control_unit)
        if wrong and not may_go_on:
            raise RuntimeFault(
                f"victim {victim}: {wrong}; --no-gate, or gate: null in the experiment, attacks it all the same"
            )
        if wrong:
            say(f"fidelity gate: victim {victim}: {wrong}")


def steering_of_victims(experiment: Experiment) -> dict[str, list[dict[str, float]]]:
    """Control of the victims that `require_same_steering` judges on each held-out view, ``real``, and on the learned scene's image of it, ``surrogate``."""
    config = experiment.config
    alike = [name for name in config.trained if config.policy_stage(name) == POLICY]
    found = {
        name: agreement(experiment, load_victim(experiment, name).policy)
        for name in config.attacked
        if name not in alike
    }
    if alike:
        kept = read_json(experiment.stage_folder(POLICY) / "policy.json")
        found = {alike[0]: kept["on_held_out_views"], **found}
    return found


@dataclass(frozen=True)
class SteeringDifference:
    """Difference of the steering on two sets of pictures of the same places.

    Attributes:
        mean: Mean of the absolute differences, in the unit of the car's control.
        allowed: The largest mean at which both count as equal.
    """

    mean: float
    allowed: float
    correlation: float

    @classmethod
    def between(cls, one: NDArray[np.float64], other: NDArray[np.float64]) -> SteeringDifference:
        """The difference of steering ``[N]`` from the steering on the first pictures."""
        varies = min(np.ptp(one), np.ptp(other)) > 0.0
        correlation = np.corrcoef(one, other)[0, 1] if varies else np.array_equal(one, other)
        spread = float(np.abs(one - one.mean()).mean())
        return cls(float(np.abs(other - one).mean()), MOST_DIFFERENCE * spread, float(correlation))

    @property
    def alike(self) -> bool:
        """Whether the gate counts both as equal."""
        return self.mean <= self.allowed and self.correlation >= LEAST_CORRELATION


def other_steering(views: Sequence[dict[str, float]], unit: str) -> str:
    """Difference between the steering on learned and on real pictures, as a sentence; empty if they count as equal."""
    real, learned = (np.array([view[name] for view in views], np.float64) for name in ("real", "surrogate"))
    found = SteeringDifference.between(real, learned)
    if found.alike:
        return ""
    worst = int(np.abs(learned - real).argmax())
    return (
        f"the learned scene lacks what the policy steers by: on {len(views)} held-out views its control differs by {found.mean:.3g} {unit} "
        f"in the mean, at most {found.allowed:.3g} is allowed ({MOST_DIFFERENCE:.0%} of how it varies), and correlates by "
        f"{found.correlation:.2f}, at least {LEAST_CORRELATION:g}; worst in view {worst}; look at scene/views, photograph what is missing, or "
        "train longer (scene.steps, policy.first_steps)"
    )
