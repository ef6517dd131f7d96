"""The searches of an audit, round by round: results at a spot decide where the next round searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from advnerf_core.attack.problem import ZeroGradientError
from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import drive_metrics
from nodes.audit.cluster import SearchJob, search_on_cluster
from nodes.audit.learning import Copies
from nodes.audit.plan import AuditPlan, as_listed
from nodes.audit.question import SELECTION_STARTS, VICTIM
from nodes.audit.schedule import LEARNING_RATE, PlannedSearch, Round, planned, rounds_for
from nodes.audit.spots import Spot
from nodes.experiment.engine.run_folder import ATTACK, SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.object_kinds import PANEL
from nodes.experiment.run.cells import search_cell
from nodes.experiment.show.context import Experiment
from nodes.runtime.progress import Report, StageDisplay

SEARCHES = "searches"
ZERO_GRADIENT = "the policy's gradient is exactly zero"
Say = Callable[[str], None]


@dataclass(frozen=True)
class FoundAttack:
    """A finished search.

    Attributes:
        setting: Name of its setting in the experiment file.
        spot: Number of the spot where the object stands.
        effect_m: Increase of the largest |CTE| over the drive without the attack, mean over the selection starts [m].
        left: Selection starts from which the car left its lane.
    """

    setting: str
    folder: Path
    spot: int
    method: str
    seed: int
    evaluations: int
    effect_m: float
    left: int

    @property
    def attack(self) -> Path:
        """Path of its attack file."""
        return self.folder / ATTACK

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key for the best attack."""
        return self.left, self.effect_m


@dataclass
class Searches:
    """All searches of one victim at one place.

    Attributes:
        plan: Plan, to which a setting is added for each search.
        spots: Possible places of the object, the most visible first.
        evaluations: Evaluations that the budget buys, from one start.
        differentiable: Whether the policy has a gradient.
        remembers: Whether its output depends on earlier images.
        limit_m: |CTE| beyond which the car has left its lane [m].
        cluster: Address of a Ray cluster for the searches; None for this process.
        flat: Settings of the searches that found a gradient of zero, so that they could not begin.
    """

    copies: Copies
    plan: AuditPlan
    spots: Sequence[Spot]
    victim: str
    evaluations: int
    differentiable: bool
    remembers: bool
    limit_m: float
    cluster: str | None = None
    found: list[FoundAttack] = field(default_factory=list)
    flat: list[str] = field(default_factory=list)

    @property
    def rounds(self) -> tuple[Round, ...]:
        """The schedule."""
        return rounds_for(self.differentiable, self.copies.question.kind == PANEL, self.remembers)

    @property
    def planned(self) -> list[list[PlannedSearch]]:
        """The searches of each round; fewer if there are fewer spots."""
        rounds = planned(self.rounds, self.evaluations, self._ticks)
        return [[each for each in row if each.spot < len(self.spots)] for row in rounds]

    @property
    def cost(self) -> int:
        """Evaluations of the whole schedule, from one start each."""
        rows = zip(self.rounds, self.planned, strict=True)
        return sum(each.evaluations * wanted.starts for wanted, row in rows for each in row)

    @cached_property
    def _ticks(self) -> int:
        return self.copies.experiment("place").searched_ticks

    @property
    def best(self) -> FoundAttack | None:
        """The attack with the largest effect on the selection starts."""
        return max(self.found, key=lambda each: each.rank, default=None)

    def run(
        self, say: Say, display: StageDisplay, enough: Callable[[FoundAttack], bool] = lambda found: False
    ) -> None:
        """Search until the schedule ends, or a result is enough."""
        for wanted, row in zip(self.rounds, self.planned, strict=True):
            spots = self._spots(wanted.spots)
            jobs: Iterable[SearchJob] = (self._job(wanted, each, spots[each.spot]) for each in row)
            if self.cluster is not None:  # its results in the folders are then only read here
                jobs = list(jobs)
                search_on_cluster(self.cluster, jobs)
            for search, job in zip(row, jobs, strict=True):
                spot = spots[search.spot]
                report = display.start(f"{wanted.method} at spot {spot + 1}")
                try:
                    found = self._search(wanted, search, spot, job, report)
                except ZeroGradientError:
                    self.flat.append(job.setting)
                    say(
                        f"{wanted.method} at spot {spot + 1}: {ZERO_GRADIENT}, so that it cannot search there"
                    )
                    continue
                self.found.append(found)
                say(
                    f"{found.method} at spot {found.spot + 1}, {found.evaluations} evaluations: largest deviation "
                    f"{found.effect_m:+.2f} m, off the lane from {found.left} of {SELECTION_STARTS} starts"
                )
                if enough(found):
                    return

    def _spots(self, count: int) -> list[int]:
        """The best spots yet; unsearched ones come last, by visibility."""
        best: dict[int, tuple[int, float]] = {}
        for each in self.found:
            best[each.spot] = max(each.rank, best.get(each.spot, each.rank))
        ranked = sorted(best, key=lambda spot: best[spot], reverse=True)
        return [*ranked, *(spot for spot in range(len(self.spots)) if spot not in best)][:count]

    def _search(
        self, wanted: Round, search: PlannedSearch, spot: int, job: SearchJob, report: Report
    ) -> FoundAttack:
        experiment, folder = job.experiment(), Path(job.folder)
        clean = search_cell(experiment, job.cell, folder, report)
        return FoundAttack(
            job.setting,
            folder,
            spot,
            wanted.method,
            search.seed,
            search.evaluations * wanted.starts,
            *_effect(experiment, folder, clean, self.limit_m),
        )

    def _job(self, wanted: Round, search: PlannedSearch, spot: int) -> SearchJob:
        """The search, after its setting was written and its object built."""
        setting = self._setting(wanted, search)
        self.plan.add(
            setting,
            [as_listed(self.spots[spot])],
            attack={
                "evaluations": search.evaluations,
                "starts": wanted.starts,
                "learning_rate": LEARNING_RATE,
            },
            over={"method": [wanted.method], "seed": [search.seed]},
        )
        experiment = self.copies.ready(setting)
        return SearchJob(
            str(self.copies.file),
            setting,
            tuple(self.copies.overrides(judged=False)),
            str(self.copies.searched),
            Cell.of(experiment.config.paths[0], self.victim, wanted.method, search.seed),
            str(self.copies.file.parent / SEARCHES / setting),
        )

    def _setting(self, wanted: Round, search: PlannedSearch) -> str:
        victim = "" if self.victim == VICTIM else f"{self.victim}-"
        return f"{victim}{search.round_ + 1}-{wanted.method.replace('_', '-')}-{search.spot + 1}"


def _effect(experiment: Experiment, folder: Path, clean: Path, limit_m: float) -> tuple[float, int]:
    """Effect and number of starts off the lane, over the drives from the selection starts."""
    path = experiment.paths[experiment.config.paths[0]]
    attacked, without = (
        np.array(
            [
                drive_metrics(path, states, experiment.limits).max_cte_m
                for states in read_json(at / SEARCHED)["states"]
            ]
        )
        for at in (folder, clean)
    )
    return float((attacked - without).mean()), int((attacked > limit_m).sum())
