"""The conversion of a budget in minutes into evaluations: what remains once the drives of the verdict are paid for.

The costs are measured where the audit runs. The place that was learned by then counts, and the searches for a planted weakness count as
much as those for an object, since they follow if nothing is found. An audit that finds an object ends earlier.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from nodes.audit.drives import NO_OBJECT, PLAIN_OBJECT, arm_of, driven, learned, with_starts
from nodes.audit.judging import FILMED, LEARNED_ARMS, WORLD_ARMS, open_world
from nodes.audit.question import SELECTION_SEED, VICTIM, AuditedQuestion
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import colour_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem


@dataclass(frozen=True)
class Costs:
    """Durations at this place, on this machine.

    Attributes:
        evaluation_s: One evaluation from one start, with the gradient if there is one [s].
        learned_s: One drive in the learned place [s].
        world_s: One drive in the world; 0 without a world [s].
        opening_s: Opening the world, with the first drive; 0 without a world [s].
    """

    evaluation_s: float
    learned_s: float
    world_s: float = 0.0
    opening_s: float = 0.0

    @classmethod
    def measured(cls, experiment: Experiment, question: AuditedQuestion, differentiable: bool) -> Costs:
        """Measure by a few evaluations and drives of the policy past the plain object.

        Args:
            experiment: Experiment with the object at a spot.
            question: The audit's question.
            differentiable: Whether the policy has a gradient.
        """
        evaluation_s = _seconds_of_evaluation(experiment, differentiable)
        several = with_starts(experiment, question.selection, SELECTION_SEED)
        learned_s = _seconds(lambda: learned(several, VICTIM, arm_of(several, PLAIN_OBJECT)))
        found = cls(evaluation_s, learned_s / question.selection)
        if not question.place.is_driven:
            return found
        one = with_starts(experiment, 1, SELECTION_SEED)
        began = time.perf_counter()
        with open_world(one, "world") as world:
            assert world is not None, "it is a world that is driven"
            first, second = (
                _seconds(lambda: driven(one, VICTIM, arm_of(one, NO_OBJECT), world)) for _ in range(2)
            )
        return replace(
            found, world_s=second, opening_s=time.perf_counter() - began - second - min(first, second)
        )

    def judging_s(self, question: AuditedQuestion) -> float:
        """Duration of the drives of the verdict, with the film [s]."""
        world = question.place.is_driven
        filmed_s = len(FILMED) * (self.world_s if world else self.learned_s)
        drives_s = len(LEARNED_ARMS) * self.learned_s + len(WORLD_ARMS) * self.world_s
        return (
            question.judging * drives_s + filmed_s + 2.0 * self.opening_s
        )  # for the drives, and for the film

    def choosing_s(self, question: AuditedQuestion, searches: int) -> float:
        """Duration of the drives that compare the results of so many searches [s]."""
        return searches * question.selection * 2.0 * self.learned_s  # with and without the attack

    def evaluations(self, left_s: float, question: AuditedQuestion, searches: int) -> int:
        """Evaluations for a policy, such that as many for the planted weakness, and the judging, end in time.

        Args:
            left_s: Remaining time of the budget [s].
            question: The audit's question.
            searches: Number of searches of the schedule.
        """
        searching_s = 0.5 * (left_s - self.judging_s(question)) - self.choosing_s(question, searches)
        return max(1, int(searching_s / self.evaluation_s))


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _seconds_of_evaluation(experiment: Experiment, differentiable: bool) -> float:
    space, policy = colour_space(experiment), load_victim(experiment, VICTIM)
    one = experiment.config.attack.model_copy(update={"starts": 1})
    alone = replace(experiment, config=experiment.config.model_copy(update={"attack": one}))
    problem = attack_problem(alone, space, policy, experiment.config.paths[0], 0)
    evaluated = adjoint_gradient if differentiable else evaluate
    seconds = [_seconds(lambda: evaluated(problem, space.plain.colours)) for _ in range(2)]
    return seconds[-1]  # the first compiles kernels
