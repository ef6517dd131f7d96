"""Runs an audit: learn the place, check that the policy drives there, search under the schedule, judge, and report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console

from advnerf_core.data.image_files import write_image
from advnerf_core.errors import AdvnerfError
from advnerf_core.report.audit_result import AuditComparison, AuditResult, Evidence, PlantedControl
from nodes.audit.budget import Costs
from nodes.audit.comparing import ATTACK_KEPT, Before
from nodes.audit.drives import (
    FOUND,
    NO_OBJECT,
    PLAIN_OBJECT,
    arm_of,
    learned,
    pictures_along,
    red_all_over,
    with_starts,
)
from nodes.audit.hardening import FOLDER as HARDEN
from nodes.audit.hardening import export_frames
from nodes.audit.judging import COMPARED, drive_arms, judge_found, seen_on
from nodes.audit.kept import compared_drives
from nodes.audit.learning import Copies, fidelity_of
from nodes.audit.outcome import AFTER, BEFORE, Known, result_of, write_result
from nodes.audit.plan import AuditPlan, as_listed
from nodes.audit.planted import policy_code, strength, write_module
from nodes.audit.question import (
    JUDGING_SEED,
    PLANTED,
    SELECTION_SEED,
    SELECTION_STARTS,
    VICTIM,
    AuditedQuestion,
)
from nodes.audit.searching import ZERO_GRADIENT, FoundAttack, Searches
from nodes.audit.spots import Spot, best_spots, place_sha256
from nodes.experiment.plan.object_kinds import footprint_m
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import given_victim
from nodes.experiment.show.placing import clean_poses
from nodes.experiment.show.victims import look_at_given
from nodes.runtime.progress import ProgressDisplay

# In half lanes: width of an object without a given one.
_WIDTH = 0.8
_SPOTS = 3
# A policy that leaves its lane from more of the starts, without any object, does not drive.
_LEAVES_AT_MOST = 0.25
# Steering of the planted weakness past an object that is red all over, relative to the largest control.
_PLANTED_SHARE = 1.0
# Settings with the plain object at the first spot, and at its place in an earlier audit; and the budget of an audit in continuous integration.
_FIRST, _BEFORE = "first", "before"
CI_EVALUATIONS, USUAL_MIN = 80, 15.0
_JUDGING = {"surrogate": "judging in the learned place", "world": "judging in the world"}
_OVER = 1.1
Say = Callable[[str], None]


class CannotJudgeError(AdvnerfError):
    """The audit ends without a verdict; the message gives the reasons."""

    def __init__(self, *reasons: str) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


@dataclass
class Audit:
    """One audit in its folder; existing parts are not repeated.

    Attributes:
        say: Callback for messages.
        console: Console for progress.
        minutes: Time for the whole audit; converted once into evaluations. None for `USUAL_MIN`, or that of an audit that is resumed.
        evaluations: Number of evaluations, instead of the time.
        against: Result of an earlier audit to compare this policy with.
        harden: Whether to export frames for hardening.
        timed: Whether the result says when it ended and how long it took.
        cluster: Address of a Ray cluster for the searches; None for this process.
        began_s: When the command began, by the monotonic clock [s].
    """

    question: AuditedQuestion
    folder: Path
    say: Say
    console: Console
    minutes: float | None
    evaluations: int | None
    against: Path | None
    harden: bool
    timed: bool
    cluster: str | None
    began_s: float
    before: Before | None = field(default=None, init=False)

    def run(self) -> AuditResult:
        """Run or resume the audit, and write its result; Ctrl-C ends the searches, and judges their best attack.

        Raises:
            AdvnerfError: The question is wrong, or a file cannot be read.
        """
        self.before = None if self.against is None else Before(self.against)
        known = Known(self.question, self.minutes)
        try:
            self._run(known)
        except CannotJudgeError as ended:
            known.reasons = ended.reasons
        if self.timed:
            known.seconds, known.ended = (
                time.monotonic() - self.began_s,
                datetime.now(timezone.utc).replace(microsecond=0),
            )
        result = result_of(known, self.folder)
        with ProgressDisplay(self.console) as display:
            missing = write_result(known, result, self.folder, display.start("film and page"))
        if missing:
            self.say(missing)
        return result

    def _run(self, known: Known) -> None:
        plan = AuditPlan.of(self.folder, self.question)
        self.minutes, self.evaluations = plan.agreed(self.minutes, self.evaluations)
        if self.evaluations is None:
            self.minutes = self.minutes or USUAL_MIN
        known.minutes = self.minutes
        copies = Copies.of(plan.save(), self.question)
        experiments = copies.learn(self.console)
        experiment = experiments[0]
        known.file, known.experiment = copies.file, experiment
        known.fidelity = fidelity = fidelity_of(experiments)
        self.say(
            f"the learned place: {fidelity.psnr_db:.1f} dB on {fidelity.views} pictures that it was not learned from"
        )
        if not fidelity.trusted:
            raise CannotJudgeError(*fidelity.why)
        if self.before is not None:  # first, as a policy that no longer drives is worse, too
            known.against, known.compared = self._compare(self.before, copies, plan, known.limit_m)
        self._require_drives(experiment, known.limit_m)
        spots = self._spots(plan, experiment)
        known.spots = spots
        plan.add(_FIRST, [as_listed(spots[0])])
        self._show(copies.ready(_FIRST), spots[0], PLAIN_OBJECT, BEFORE)
        searches = self._searches(copies, plan, spots, VICTIM, known.limit_m)
        known.searches = searches
        try:
            with ProgressDisplay(self.console) as display:
                searches.run(self.say, display)
        except KeyboardInterrupt:
            known.interrupted = True
            self.say("interrupted: what was found is judged; Ctrl-C again ends at once")
        if searches.best is None:
            raise CannotJudgeError(
                f"{ZERO_GRADIENT} at every spot, and no search without one was run; check it ('advnerf policy check')"
                if searches.flat
                else "interrupted before the first search was finished"
            )
        self._judge(known, copies, plan, searches.best)
        assert known.judged
        if known.judged[-1].judgement.found or (known.against is not None and known.against.is_worse):
            return
        if known.interrupted and len(searches.found) < sum(map(len, searches.planned)):
            raise CannotJudgeError("interrupted before the end of the schedule, with nothing found so far")
        known.planted = self._plant(copies, plan, spots, known.limit_m)
        if not known.planted.found:
            raise CannotJudgeError(
                "the search does not find a planted weakness of this policy at this place with this budget; give it a larger --budget or object (--object-size)"
            )

    def _require_drives(self, experiment: Experiment, limit_m: float) -> None:
        """Raise for a policy that leaves its lane in the learned place without any object."""
        nothing = arm_of(experiment, NO_OBJECT)
        there = learned(with_starts(experiment, SELECTION_STARTS, SELECTION_SEED), nothing)
        left = there.left(limit_m)
        self.say(
            f"without any object: largest deviation {there.largest_m.mean():.2f} m of {limit_m:g} m, off the lane from {left.sum()} of {len(left)} starts"
        )
        if left.mean() > _LEAVES_AT_MOST:
            raise CannotJudgeError(
                f"the policy does not drive here: without any object it leaves its lane from {left.sum()} of {len(left)} starts; check its declaration "
                "(advnerf policy check), the car, the speed and the path"
            )

    def _spots(self, plan: AuditPlan, experiment: Experiment) -> list[Spot]:
        """Possible places of the object, decided once in this learned place."""
        place = place_sha256(experiment)
        if plan.spots(place) is None:
            kind, width_m = self.question.kind, footprint_m(self.question.kind)[1]
            wanted_m = self.question.size_m or _WIDTH * experiment.world.off_track_m
            plan.choose(best_spots(experiment, kind, wanted_m / width_m, _SPOTS), place)
        spots = plan.spots(place)
        if not spots:
            raise CannotJudgeError(
                "there is no spot beside the path where the object is seen; give it another --object-size, or the path another start"
            )
        for number, spot in enumerate(spots, start=1):
            at, seen_s = spot.placed, spot.seen_ticks * experiment.config.dt_s
            self.say(f"spot {number}: x {at.x_m:.2f} m, y {at.y_m:.2f} m, seen for {seen_s:.1f} s of a drive")
        return spots

    def _searches(
        self, copies: Copies, plan: AuditPlan, spots: list[Spot], victim: str, limit_m: float
    ) -> Searches:
        declared = given_victim(copies.experiment("place"), VICTIM).declared
        searches = Searches(
            copies,
            plan,
            spots,
            victim,
            plan.decided.evaluations or self.evaluations or 1,
            declared.differentiable,
            declared.has_memory,
            limit_m,
            self.cluster,
        )
        if plan.decided.evaluations is None:
            if self.minutes is not None:
                searches.evaluations = self._bought(copies.ready(_FIRST), searches, self.minutes)
            plan.decide(evaluations=searches.evaluations, minutes=self.minutes)
        self.say(f"searching {searches.cost} evaluations")
        return searches

    def _bought(self, experiment: Experiment, searches: Searches, minutes: float) -> int:
        """The evaluations that the rest of the budget buys; at least those of the smallest schedule."""
        question = self.question
        costs = Costs.measured(experiment, question, searches.differentiable)
        judging_s, used_s = costs.judging_s(question), time.monotonic() - self.began_s
        count = sum(map(len, searches.planned))
        searches.evaluations = costs.evaluations(60.0 * minutes - used_s, question, count)
        search_s = searches.cost * costs.evaluation_s + costs.choosing_s(count)
        self.say(
            f"of {minutes:g} min, {used_s / 60.0:.1f} are used, and judging takes about {judging_s / 60.0:.1f}; searching takes about "
            f"{search_s / 60.0:.1f}, and up to as long again for a planted weakness if nothing is found"
        )
        if used_s + judging_s + 2.0 * search_s > _OVER * 60.0 * minutes:
            self.say(
                "that is more than the budget: less cannot be searched, and the audit goes on to its verdict"
            )
        return searches.evaluations

    def _show(
        self, experiment: Experiment, spot: Spot, arm: str, name: str, found: Path | None = None
    ) -> None:
        """Write a picture of the object from the pose on the path at which it is largest."""
        poses = clean_poses(experiment, experiment.config.paths[0])[[spot.largest_tick]]
        write_image(self.folder / name, seen_on(experiment, arm_of(experiment, arm, found), poses, None)[0])
        self.say(f"picture of the object where it stands: {self.folder / name}")

    def _judge(self, known: Known, copies: Copies, plan: AuditPlan, best: FoundAttack) -> None:
        """Judge in the other copy, or in the world, which comes last."""
        question = self.question
        starts = question.judging, JUDGING_SEED, known.limit_m
        self.say(f"judging {best.setting} from {question.judging} starts that nothing has used")
        known.best = best
        spot = known.spots[best.spot]
        self._show(copies.ready(best.setting), spot, FOUND, AFTER, best.attack)
        there = copies.ready(best.setting, judged=True)
        kinds: tuple[Evidence, ...] = ("surrogate", "world") if question.place.is_driven else ("surrogate",)
        with ProgressDisplay(self.console) as display:
            for kind in kinds:
                report = display.start(_JUDGING[kind])
                known.judged.append(judge_found(there, best.attack, *starts, kind, report))
        if self.harden:
            self.say(f"frames past the object: {export_frames(known.judged[-1], self.folder / HARDEN)}")

    def _compare(
        self, before: Before, copies: Copies, plan: AuditPlan, limit_m: float
    ) -> tuple[AuditComparison, dict[str, Any]]:
        """Drive past the object of an earlier audit, from its starts; the drives are to be kept."""
        plan.add(_BEFORE, [before.listed(self.question.kind)])
        starts, evidence = before.result.starts.judging, self.question.place.evidence
        there = with_starts(copies.ready(_BEFORE, judged=True), starts.count, starts.seed)
        arms = {name: arm_of(there, name, before.folder / ATTACK_KEPT) for name in COMPARED}
        with ProgressDisplay(self.console) as display:
            drives = drive_arms(there, arms, evidence, display.start("driving as then"))
        found = before.compare(drives, evidence, limit_m)
        return found, compared_drives(there, drives, limit_m, before.folder, evidence)

    def _plant(self, copies: Copies, plan: AuditPlan, spots: list[Spot], limit_m: float) -> PlantedControl:
        """Search a planted weakness with the same schedule, until it is found."""
        name, wanted = (
            "it also steers to the left for red, to the right for green",
            SELECTION_STARTS // 2 + 1,
        )
        try:
            spec = self._planted_victim(copies.ready(_FIRST))
        except ValueError:
            return PlantedControl(name=name, found=False, evaluations=0)
        self.say("nothing found: the search is tried on the policy with a planted weakness")
        victims = {VICTIM: {"policy": self.question.policy}, PLANTED: {"policy": spec}}
        question = replace(self.question, sections={**self.question.sections, "victims": victims})
        with_it = replace(plan, question=question)
        with_it.save()
        copies = replace(copies, question=question)
        look_at_given(copies.experiment("place"))
        searches = self._searches(copies, with_it, spots, PLANTED, limit_m)
        with ProgressDisplay(self.console) as display:
            searches.run(self.say, display, enough=lambda found: found.left >= wanted)
        best = searches.best
        return PlantedControl(
            name=name,
            found=best is not None and best.left >= wanted,
            evaluations=sum(each.evaluations for each in searches.found),
            effect_m=None if best is None else best.effect_m,
        )

    def _planted_victim(self, experiment: Experiment) -> str:
        """Write the planted policy, with the strength that an object at the first spot allows."""
        states = clean_poses(experiment, experiment.config.paths[0])
        controls = [arm_of(experiment, name).shown for name in (NO_OBJECT, PLAIN_OBJECT)]
        plain = [pictures_along(experiment, states, shown) for shown in controls]
        red = pictures_along(experiment, states, red_all_over(experiment))
        wanted = _PLANTED_SHARE * experiment.car.largest_control
        loads = policy_code(self.question.policy, experiment)
        return write_module(self.folder, loads, *strength(plain, red, wanted))
