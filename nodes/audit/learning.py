"""The learned copies of a place, and how far they can be trusted: by views that nothing learned from, and by each other."""

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
from advnerf_core.report.audit_result import AuditFidelity
from nodes.audit.drives import pictures_along
from nodes.audit.question import HALF, OTHER_HALF, VICTIM, AuditedQuestion, half_overrides
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.images import as_uint8
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

# Of the largest control: such a difference drives no car elsewhere, however little the policy steers in all.
_NEGLIGIBLE = 0.02
_EMPTY = Shown((), torch.zeros(0, 3))


@dataclass(frozen=True)
class Copies:
    """Where an audit searches, and where it judges.

    Attributes:
        file: The experiment file.
        searched: Run folder of the copy that is searched in.
        judged: Run folder of the copy that is judged in; the same where there is a world to judge in.
        question: What is asked.
    """

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
        """The experiment of a setting, in the copy that is searched or judged in."""
        folder = self.judged if judged else self.searched
        return load_experiment(self.file, setting, self.overrides(judged), folder)

    def overrides(self, judged: bool) -> list[str]:
        """Changes of the experiment file in the copy that is searched or judged in."""
        folder = self.judged if judged else self.searched
        return [*half_overrides(self.question, folder.name), *self.question.overrides]

    def ready(self, setting: str, judged: bool = False) -> Experiment:
        """The same with the object of the setting built."""
        make_ready(self.experiment(setting, judged), until="object", console=Console(quiet=True))
        return self.experiment(setting, judged)  # which knows now what its stages wrote

    def learn(self, console: Console) -> list[Experiment]:
        """Learn the copies that are not there yet; each once."""
        found = []
        for judged in (False, True)[: 1 + (self.judged != self.searched)]:
            make_ready(self.experiment("place", judged), until="bake", console=console)
            found.append(self.experiment("place", judged))
        return found


def fidelity_of(copies: list[Experiment]) -> AuditFidelity:
    """How much the learned copies are to be trusted.

    The policy must steer in each as on real pictures that it did not learn from, and in one as in the other along the path.
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
    """How the steering in two copies differs along the path, in a sentence; empty if it does not by more than the gate allows."""
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
    pictures = np.stack([as_uint8(each) for each in pictures_along(experiment, poses, _EMPTY)])
    return predict(policy, pictures, told(experiment, policy, experiment.config.paths[0]))
