"""The learned copies of a place, and their fidelity: by held-out views, and by each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from advnerf_core.attack.spaces.space import Shown
from advnerf_core.documents import read_json
from advnerf_core.geometry import Array
from advnerf_core.policies.network import tensor_to_images
from advnerf_core.report.audit_result import AuditFidelity
from nodes.audit.drives import pictures_along
from nodes.audit.question import HALF, OTHER_HALF, VICTIM, AuditedQuestion, half_overrides
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import FIDELITY
from nodes.experiment.show.placing import clean_poses
from nodes.experiment.show.victims import load_victim, told
from nodes.experiment.steps.run import load_experiment, make_ready
from nodes.experiment.steps.steering_gate import (
    LEAST_CORRELATION,
    SteeringDifference,
    other_steering,
    steering_of_victims,
)
from nodes.lab.policy_data.evaluate import predict

# Share of the largest control: a smaller difference does not divert a car, even if the policy steers little overall.
_NEGLIGIBLE = 0.02
_EMPTY = Shown((), torch.zeros(0, 3))


@dataclass(frozen=True)
class Copies:
    """The copies that an audit searches and judges in, by their run folders; one copy does for both if the audit judges in a world."""

    file: Path
    searched: Path
    judged: Path
    question: AuditedQuestion

    @classmethod
    def of(cls, file: Path, question: AuditedQuestion) -> Copies:
        """The copies of a place in the folder of the experiment file."""
        names = ("place", "place") if question.place.is_driven else (HALF, OTHER_HALF)
        return cls(file, file.parent / names[0], file.parent / names[1], question)

    def experiment(self, setting: str, judged: bool = False) -> Experiment:
        """The experiment of a setting, in the copy for searching or judging."""
        folder = self.judged if judged else self.searched
        return load_experiment(self.file, setting, self.overrides(judged), folder)

    def overrides(self, judged: bool) -> list[str]:
        """Changes of the experiment file in the copy for searching or judging."""
        folder = self.judged if judged else self.searched
        return [*half_overrides(self.question, folder.name), *self.question.overrides]

    def ready(self, setting: str, judged: bool = False) -> Experiment:
        """The same experiment, after the setting's object was built."""
        make_ready(self.experiment(setting, judged), until="object", console=Console(quiet=True))
        return self.experiment(setting, judged)  # read again, with the outputs of its stages

    def learn(self, console: Console) -> list[Experiment]:
        """Learn the missing copies, each once."""
        found = []
        for judged in (False, True)[: 1 + (self.judged != self.searched)]:
            make_ready(self.experiment("place", judged), until="bake", console=console)
            found.append(self.experiment("place", judged))
        return found


def fidelity_of(copies: list[Experiment]) -> AuditFidelity:
    """Fidelity of the learned copies.

    In each copy the policy must steer as on held-out real pictures, and along the path it must steer the same in both.
    """
    why, differences = [], []
    for experiment in copies:
        views = steering_of_victims(experiment)[VICTIM]
        real, learned = (np.array([view[name] for view in views]) for name in ("real", "surrogate"))
        differences.append(float(np.abs(real - learned).mean()))
        wrong = other_steering(views, experiment.car.control_unit)
        if wrong and differences[-1] > _NEGLIGIBLE * experiment.car.largest_control:
            why.append(wrong)
    agree = None
    if len(copies) == 2:
        apart = _apart(*copies)
        agree = not apart
        why += [apart] if apart else []
    listed = [read_json(each.stage_folder("scene") / FIDELITY) for each in copies]
    rows = [row for each in listed for row in each["views"]]
    return AuditFidelity(
        views=len(rows) // len(copies),
        psnr_db=float(np.mean([row["psnr_policy_db"] for row in rows])),
        ssim=float(np.mean([row["ssim_policy"] for row in rows])),
        steering_difference=max(differences),
        halves_agree=agree,
        trusted=not why,
        why=tuple(why),
    )


def _apart(one: Experiment, other: Experiment) -> str:
    """Difference of the steering in two copies along the path, as a sentence; empty if the gate allows it."""
    scenario = one.config.paths[0]
    poses = clean_poses(one, scenario)
    first, second = (_steering_along(each, poses) for each in (one, other))
    found = SteeringDifference.between(first, second)
    if found.alike or found.mean <= _NEGLIGIBLE * one.car.largest_control:
        return ""
    return (
        f"two scenes, each learned from one half of the photographs, do not agree: along the path the policy's steering differs by "
        f"{found.mean:.3g} {one.car.control_unit} in the mean, at most {found.allowed:.3g} is allowed, and correlates by "
        f"{found.correlation:.2f}, at least {LEAST_CORRELATION:g}; take more photographs"
    )


def _steering_along(experiment: Experiment, poses: Array) -> NDArray[np.float64]:
    policy = load_victim(experiment, VICTIM).policy
    pictures = tensor_to_images(pictures_along(experiment, poses, _EMPTY))
    return predict(policy, pictures, told(experiment, policy, experiment.config.paths[0]))
