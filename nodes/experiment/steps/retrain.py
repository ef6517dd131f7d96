"""Stage retrain: the defence. Attack, collect frames with the attacked objects, fine-tune on old and new, attack again, until attacks fail.

The paper retrains once and drives from an unseen start; here that is the first round, and later rounds show whether the defence holds
against an adaptive adversary. Every finished search, collection, training and drive is stored, so that a killed stage resumes.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.on_device import on_chosen_device
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.spaces.space import ColourSpace
from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import no_effect_m
from advnerf_core.files import write_json
from advnerf_core.learning.frames import Frames, FrameStore
from advnerf_core.learning.recipe import SourcePlan, labelled, near, recovery_states
from advnerf_core.learning.retrain import FineTuneConfig, fine_tune
from advnerf_core.learning.sources import steer_with
from advnerf_core.policies.policy_file import LoadedPolicy, load_policy
from hardware.worlds.world import World
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.victims import RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.given import victim_spec
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.show.spaces import colour_space, random_placements
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem, from_measured_starts, load_shown, surrogate_part
from nodes.experiment.steps.frozen import freeze
from nodes.experiment.steps.policy import plans
from nodes.experiment.steps.steering_gate import require_same_steering
from nodes.runtime.progress import Report

_NEAR_M, _TURNED_RAD, _GIVE_UP_M = 1.0, 0.15, 3.0  # metres for half a lane of 1.75 m
_PLACES_SEED = 10_000  # far from the seeds of pose attacks, which must not find the training places


Told = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """Result of one round of attacks.

    Attributes:
        thetas: Colours of all objects by scenario ``[K, 3]``.
        excess_m: |CTE| per tick over that past the plain objects [m], by domain and scenario.
    """

    thetas: dict[str, torch.Tensor]
    excess_m: dict[str, dict[str, float]]


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write a folder per round, and after each ``retrain.json`` with the curve and the drives under the old attacks, and ``curve.png``."""
    from nodes.experiment.steps import retrain_plot  # matplotlib

    wanted = experiment.config.retrain
    assert wanted is not None, "the stage runs only where the experiment asks for it"
    require_same_steering(experiment)
    space = colour_space(experiment)
    main = experiment.config.main_victim
    file, rounds, kept = Path(victim_spec(experiment, main)), [], _old_frames(experiment)
    victim = load_policy(file)
    thetas: list[torch.Tensor] = []
    pays_m = pays_from_m(experiment)
    with experiment.open_world() as scene:
        dressed = stand_in(
            experiment,
            scene,
            placed_objects(experiment),
            native=experiment.config.carrier.training == "native",
        )
        attacks = _Attacks(experiment, space, dressed)
        told = _part(report, 0.0, 1.0 / (wanted.rounds + 1), "round 0")
        first = attacks.first(victim, folder / "round0", told)
        old_attacks: dict[str, Any] = {}
        for number in range(wanted.rounds + 1):
            here = folder / f"round{number}"
            told = _part(report, number / (wanted.rounds + 1), 1.0 / (wanted.rounds + 1), f"round {number}")
            found = first if number == 0 else attacks.again(victim, here, told)
            rounds.append({"victim": victim.sha256, **found.excess_m})
            if number == 1:
                old_attacks = attacks.old(folder / "round0" / "policy.safetensors", first)
            summary = {
                "rounds": rounds,
                "old_attacks": old_attacks,
                "pays_m": pays_m,
                "final_policy": os.path.relpath(file, experiment.folder),
                "settings_hash": hash_of(wanted.model_dump(mode="json")),
            }
            # After every round: a loop takes hours, and may be interrupted.
            write_json(folder / "retrain.json", summary)
            retrain_plot.draw(folder / "curve.png", rounds, pays_m)
            if number == wanted.rounds or not max(found.excess_m["surrogate"].values()) > pays_m:
                break
            thetas += list(found.thetas.values())
            new = _collect(experiment, scene, victim, thetas, here, told)
            settings = FineTuneConfig(
                steps=wanted.steps, new_share=wanted.new_share, seed=wanted.seed + number
            )
            file = here / "policy.safetensors"
            if not file.exists():
                fine_tune(
                    victim,
                    kept,
                    new,
                    settings,
                    file,
                    _stepping(told, wanted.steps, experiment.car.control_unit),
                )
            victim, kept = load_policy(file), [*kept, *new]


def pays_from_m(experiment: Experiment) -> float:
    """Excess |CTE| per tick above which an attack pays [m]."""
    wanted = experiment.config.retrain
    assert wanted is not None, "the stage runs only where the experiment asks for it"
    return no_effect_m(experiment.limits.off_track_m) if wanted.pays_m is None else wanted.pays_m


def unseen_start(experiment: Experiment, scenario: str) -> torch.Tensor:
    """A start ``[1, 3]`` that no attack and no training drive used: a metre back, a third of a metre to the left."""
    x_m, y_m, yaw_rad = experiment.references[scenario].drive_start
    back, left = np.array([-np.cos(yaw_rad), -np.sin(yaw_rad)]), np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
    place = np.array([x_m, y_m]) + experiment.along_m(1.0) * back + experiment.across_m(0.35) * left
    return torch.tensor([[place[0], place[1], yaw_rad]], dtype=torch.float64)


def _part(report: Report, begin: float, share: float, name: str) -> Told:
    def told(part: float, text: str = "") -> None:
        report(min(begin + share * part, 1.0), f"{name}: {text}")

    return told


def _stepping(told: Told, steps: int, unit: str) -> Callable[[int, float], None]:
    def stepped(step: int, loss: float) -> None:
        told(0.7 + 0.3 * step / steps, f"fine-tuning: error {loss**0.5:.3f} {unit}")

    return stepped


def _old_frames(experiment: Experiment) -> list[Frames]:
    trained_in = experiment.config.policy_stage(RETRAINED)
    store = FrameStore(experiment.stage_folder(trained_in) / "frames")
    return [store.load(name) for name in store.names()]


@dataclass(frozen=True, eq=False)
class _Attacks:
    """Attacks of the first seed, searched in the surrogate and driven past in the deployment scene."""

    experiment: Experiment
    space: ColourSpace
    dressed: Dressed

    def first(self, victim: LoadedPolicy, folder: Path, report: Told) -> Found:
        """The results of the gradient's cells; they are searched here if they are missing."""
        experiment, thetas = self.experiment, dict[str, torch.Tensor]()
        for index, name in enumerate(experiment.config.paths):
            cell = Cell(name, experiment.config.main_victim, "gradient", experiment.config.seeds[0])
            at = experiment.cell_folder(cell)
            freeze(experiment, cell, at)

            def told(part: float, text: str = "", index: int = index, name: str = name) -> None:
                done = (index + part) / len(experiment.config.paths)
                report(0.4 * done, f"attacking, {name}: {text}")

            surrogate_part(experiment, self.space, cell, at, told)
            thetas[name] = load_shown(self.space, at, cell).colours
        return self._judged(victim, thetas, folder)

    def again(self, victim: LoadedPolicy, folder: Path, report: Told) -> Found:
        """The gradient attack on a retrained victim, as long as the attack on the first one."""
        config, thetas = self.experiment.config, dict[str, torch.Tensor]()
        for index, scenario in enumerate(config.paths):
            problem = attack_problem(self.experiment, self.space, victim, scenario, config.seeds[0])

            def told(evaluation: Any, index: int = index, scenario: str = scenario) -> None:
                done = (index + (evaluation.iteration + 1) / config.attack.evaluations) / len(config.paths)
                total_m = evaluation.predicted_total_cte_m
                report(0.4 * done, f"attacking again, {scenario}: total CTE {total_m:.1f} m")

            state, key = (
                folder / f"{scenario}.state.safetensors",
                {"victim": victim.sha256, "scenario": scenario},
            )
            result = gradient_attack(
                on_chosen_device(problem),
                config.attack.evaluations,
                config.attack.learning_rate,
                SearchRun(config.seeds[0], state, told, hash_of(key)),
            )
            thetas[scenario] = result.theta
        return self._judged(victim, thetas, folder)

    def _judged(self, policy: LoadedPolicy, thetas: dict[str, torch.Tensor], folder: Path) -> Found:
        """Excess of each attack for the same victim in both domains, from starts that no search had; stored in the folder of the round."""
        seed, kept = self.experiment.config.seeds[0], folder / "excess.json"
        digests = [hashlib.sha256(theta.numpy().tobytes()).hexdigest() for theta in thetas.values()]
        key = [policy.sha256, *digests]
        if kept.exists() and (known := read_json(kept))["of"] == key:
            return Found(thetas, known["excess_m"])
        excess_m: dict[str, dict[str, float]] = {"surrogate": {}, "deployed": {}}
        for scenario, theta in thetas.items():
            searched = attack_problem(self.experiment, self.space, policy, scenario, seed)
            problem = from_measured_starts(self.experiment, scenario, searched)
            colours = (theta, self.space.plain.colours)
            learned = [float(evaluate(problem, each)[1].protocol_cte_m.mean()) for each in colours]
            starts = self.experiment.measured_starts(scenario)
            driven = [self._total_cte_m(policy, scenario, starts, each) for each in (theta, None)]
            for domain, (attacked_m, plain_m) in (("surrogate", learned), ("deployed", driven)):
                excess_m[domain][scenario] = (attacked_m - plain_m) / self.experiment.config.horizon
        write_json(kept, {"of": key, "excess_m": excess_m})
        return Found(thetas, excess_m)

    def _total_cte_m(
        self, policy: LoadedPolicy, scenario: str, starts: torch.Tensor, theta: torch.Tensor | None
    ) -> float:
        """Total CTE [m] of deployed drives, the mean over starts ``[B, 3]``; plain objects for None."""
        shown = self.dressed.plain_theta() if theta is None else theta
        drives = deployed_drives(self.experiment, self.dressed, policy.policy, scenario, starts, shown)
        return float(np.mean([drive.metrics.total_cte_m for drive in drives]))

    def old(self, file: Path, first: Found) -> dict[str, Any]:
        """The retrained policy past its training attacks, from an unseen start, beside the original policy without attack."""
        original = load_victim(self.experiment, self.experiment.config.main_victim)
        policies, rows = {"original": original, "retrained": load_policy(file)}, {}
        for scenario, theta in first.thetas.items():
            start = unseen_start(self.experiment, scenario)
            row = {
                f"{name}_{how}_m": self._total_cte_m(policy, scenario, start, each)
                for name, policy in policies.items()
                for how, each in (("undisturbed", None), ("attacked", theta))
            }
            rows[scenario] = row | {"ratio": row["retrained_attacked_m"] / row["original_undisturbed_m"]}
        return rows


def _collect(
    experiment: Experiment,
    scene: World,
    victim: LoadedPolicy,
    thetas: Sequence[torch.Tensor],
    folder: Path,
    report: Told,
) -> list[Frames]:
    """Frames of both domains with the attacked objects: stills around the paths, and drives of the victim, labelled by the teacher.

    If requested also stills with all objects in random colours at random places.
    """
    wanted, store = experiment.config.retrain, FrameStore(folder / "frames")
    assert wanted is not None
    learns = replace(experiment, config=experiment.config.training(RETRAINED))
    found = plans(learns, scene, lambda rng: thetas[int(rng.integers(len(thetas)))])
    chosen = [(plan, wanted.stills, wanted.drives) for plan in found]
    places = random_placements(experiment, wanted.placements, seed=_PLACES_SEED + wanted.seed + len(thetas))
    for number, objects in enumerate(places):
        moved = plans(learns, scene, None, objects, f"-moved{number}")
        chosen += [(plan, math.ceil(wanted.stills / len(places)), 0) for plan in moved]
    for number, (plan, stills, drives) in enumerate(chosen):
        if plan.source.name not in store.names():
            rng = np.random.default_rng([wanted.seed, len(thetas), number])
            frames = _frames(plan, victim, stills, drives, wanted.drive_steps, rng, experiment.across_m(1.0))
            store.append(plan.source.name, frames)
        report(0.4 + 0.3 * (number + 1) / len(chosen), f"collecting: {plan.source.name}")
    return [store.load(plan.source.name) for plan, _, _ in chosen]


def _frames(
    plan: SourcePlan,
    victim: LoadedPolicy,
    stills: int,
    drives: int,
    steps: int,
    rng: np.random.Generator,
    width: float,
) -> Frames:
    """Frames of one plan; lateral distances are ``width`` times the junction's."""
    expert, near_m = plan.expert, width * _NEAR_M
    assert expert is not None, "every plan of a world has its own teacher"
    places = recovery_states(expert.path, stills, rng, near_m, _TURNED_RAD, plan.driven_m)
    size = plan.source.batch_size
    parts = [plan.source.look(places[first : first + size], rng) for first in range(0, stills, size)]
    # Early on the path: the following part is driven through.
    begin_m = None if plan.driven_m is None else 0.3 * plan.driven_m
    starts = recovery_states(expert.path, 2 * drives, rng, 0.5 * near_m, 0.5 * _TURNED_RAD, begin_m)
    steer = steer_with(victim.policy, torch.tensor([plan.goal]))

    keep = near(expert.path, width * _GIVE_UP_M)
    # Two side by side, so that one of them meets an attacked texture throughout.
    for first in range(0, 2 * drives, 2):
        parts.append(plan.source.drive(steer, starts[first : first + 2], steps, keep, rng))
    return labelled(parts, expert, plan.goal)
