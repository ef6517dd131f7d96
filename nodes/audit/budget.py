"""The conversion of a budget in minutes into evaluations: what remains once the drives of the verdict are paid for.

The costs are measured where the audit runs. The place that was learned by then counts, and the searches for a planted weakness count as
much as those for an object, since they follow if nothing is found. An audit that finds an object ends earlier.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from nodes.audit.drives import PLAIN_OBJECT, arm_of, driven, learned, with_starts
from nodes.audit.judging import FILMED, LEARNED_ARMS, WORLD_ARMS, open_world, seen_on
from nodes.audit.question import SELECTION_SEED, SELECTION_STARTS, VICTIM, AuditedQuestion
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.placing import clean_poses
from nodes.experiment.show.spaces import colour_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem
from nodes.experiment.steps.films import filmed


@dataclass(frozen=True)
class Costs:
    """Durations at this place, on this machine.

    Attributes:
        evaluation_s: One evaluation from one start, with the gradient if there is one [s].
        learned_s: One drive in the learned place [s].
        film_s: The film [s].
        world_s: One drive in the world; 0 without a world [s].
        opening_s: Opening the world, and by how much its first drive is slower; 0 without a world [s].
    """

    evaluation_s: float
    learned_s: float
    film_s: float
    world_s: float = 0.0
    opening_s: float = 0.0

    @classmethod
    def measured(cls, experiment: Experiment, question: AuditedQuestion, differentiable: bool) -> Costs:
        """Measure by a few evaluations and drives of the policy past the plain object, which stands at a spot."""
        evaluation_s = _seconds_of_evaluation(experiment, differentiable)
        several = with_starts(experiment, SELECTION_STARTS, SELECTION_SEED)
        plain, one = arm_of(experiment, PLAIN_OBJECT), with_starts(experiment, 1, SELECTION_SEED)
        learned_s = _seconds(lambda: learned(several, plain)) / SELECTION_STARTS
        driven_s, began_s = [0.0], time.perf_counter()
        with open_world(one, question.place.evidence) as world:
            opening_s = time.perf_counter() - began_s
            if world is not None:
                driven_s = [_seconds(lambda: driven(one, plain, world)) for _ in range(2)]
            poses = clean_poses(one, one.config.paths[0])[:1]
            frame_s = _seconds(lambda: seen_on(one, plain, poses, world))
        every, _ = filmed(one.config.dt_s)
        film_s = len(FILMED) * (1 + one.config.horizon // every) * frame_s
        return cls(evaluation_s, learned_s, film_s, driven_s[-1], opening_s + driven_s[0] - driven_s[-1])

    def judging_s(self, question: AuditedQuestion) -> float:
        """Duration of the drives of the verdict, and of their film, for each of which the world is opened [s]."""
        drives_s = len(LEARNED_ARMS) * self.learned_s + len(WORLD_ARMS) * self.world_s
        return question.judging * drives_s + self.film_s + 2.0 * self.opening_s

    def choosing_s(self, searches: int) -> float:
        """Duration of the drives that compare the results of so many searches [s]."""
        return searches * SELECTION_STARTS * 2.0 * self.learned_s  # with and without the attack

    def evaluations(self, left_s: float, question: AuditedQuestion, searches: int) -> int:
        """Evaluations for a policy, such that as many for the planted weakness, and the judging, end in the remaining time [s]."""
        searching_s = 0.5 * (left_s - self.judging_s(question)) - self.choosing_s(searches)
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
