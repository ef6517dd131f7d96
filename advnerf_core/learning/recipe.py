"""Inputs and outputs of a training recipe: settings, sources with their goals and teachers, and the distribution of poses."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from advnerf_core.driving.expert import Expert
from advnerf_core.driving.path import Array, Path
from advnerf_core.learning.augment import AugmentConfig
from advnerf_core.learning.frames import Frames
from advnerf_core.learning.sources import FrameSource, KeepDriving, PolicyImages
from advnerf_core.policies.architecture import Architecture


@dataclass(frozen=True)
class SourcePlan:
    """The amounts taken from one source.

    Attributes:
        stills: Number of stills before the first training.
        drives: Drives in each DAgger round.
        drive_steps: Ticks of each of these drives.
        goal: Goal vector of these frames, for example a one-hot exit; the same length in all plans.
        expert: Their teacher, around whose path poses are drawn; None for the recipe's own.
        driven_m: Poses are drawn along this length of an open path [m]; None for all of it.
        drives_from_m: Drives start within this length of the path [m], so that they pass the places to learn; None for all of it.
    """

    source: FrameSource
    stills: int
    drives: int = 8
    drive_steps: int = 40
    goal: tuple[float, ...] = ()
    expert: Expert | None = None
    driven_m: float | None = None
    drives_from_m: float | None = None

    def settings(self) -> dict[str, Any]:
        """As plain data; keys that only goal-conditioned recipes have are left out without a goal."""
        values = {
            "source": self.source.name,
            "stills": self.stills,
            "drives": self.drives,
            "drive_steps": self.drive_steps,
        }
        special = {
            "goal": list(self.goal),
            "expert": None if self.expert is None else self.expert.to_dict(),
            "driven_m": self.driven_m,
            "drives_from_m": self.drives_from_m,
        }
        return values | {name: value for name, value in special.items() if value}


@dataclass(frozen=True)
class ImitationConfig:
    """Settings of the recipe.

    Attributes:
        seed: Seed of poses, textures, initial weights, batches and augmentation.
        dagger_rounds: Rounds of driving, labelling and continued training.
        first_steps: Optimiser steps of behaviour cloning.
        round_steps: Optimiser steps after each DAgger round.
        naive_steps: Optimiser steps of a second policy that never sees a random texture; 0 trains none.
        learning_rate: Peak learning rate; continued training starts at half of it.
        lateral_m: Stills are up to this far from the path [m].
        heading_rad: Stills are turned up to this much from the path's heading [rad].
        drive_lateral_m: DAgger drives start up to this far from the path [m].
        drive_heading_rad: DAgger drives are turned up to this much from the path's heading [rad].
        give_up_m: A drive ends when |CTE| exceeds this [m]; frames from further away teach little.
        max_steering_rad: Bound of the policy's output [rad].
        holdout_every: One block of frames in this many is kept for validation.
    """

    seed: int = 0
    dagger_rounds: int = 2
    first_steps: int = 500
    round_steps: int = 250
    naive_steps: int = 0
    batch_size: int = 64
    learning_rate: float = 1e-3
    lateral_m: float = 0.35
    heading_rad: float = 0.45
    drive_lateral_m: float = 0.2
    drive_heading_rad: float = 0.25
    give_up_m: float = 0.7
    max_steering_rad: float = 0.30
    architecture: Architecture = field(default_factory=Architecture)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    holdout_every: int = 20

    def settings(self) -> dict[str, Any]:
        """As plain data, equal on every machine: it is stored in policy files."""
        values = asdict(self)
        del values["architecture"]
        return {**values, **self.architecture.described()}


@dataclass(frozen=True)
class TrainedPolicy:
    """Result of the recipe.

    Attributes:
        validation_mae_rad: Mean absolute steering error on held-out frames [rad].
        naive_path: File of the policy that never saw a random texture, if one was asked for.
        naive_validation_mae_rad: Mean absolute error of that policy on held-out plain frames [rad].
        seconds: Time spent in this call on each part: collect, train [s].
    """

    path: FilePath
    sha256: str
    validation_mae_rad: float
    naive_path: FilePath | None
    naive_sha256: str | None
    naive_validation_mae_rad: float | None
    frames: int
    seconds: dict[str, float]


def recovery_states(
    path: Path,
    count: int,
    rng: np.random.Generator,
    lateral_m: float,
    heading_rad: float,
    driven_m: float | None = None,
) -> Array:
    """Poses ``[count, 3]`` about the path, or its first ``driven_m`` [m], evenly along it: half spread over the full range, half near the path."""
    s = (
        (np.arange(count) + rng.random(count))
        / max(count, 1)
        * (path.length_m if driven_m is None else driven_m)
    )
    pose = path.pose_at(rng.permutation(s))
    spread = np.where(np.arange(count)[:, None] % 2 == 0, 1.0, 0.35)
    lateral, heading = (rng.uniform(-1.0, 1.0, (count, 2)) * spread * [lateral_m, heading_rad]).T
    pose[:, 0] -= lateral * np.sin(pose[:, 2])
    pose[:, 1] += lateral * np.cos(pose[:, 2])
    pose[:, 2] += heading
    return pose


def near(path: Path, give_up_m: float) -> KeepDriving:
    """Whether cars are still this close to a path [m]."""
    return lambda states: np.abs(path.project(states[:, :2]).cte_m) <= give_up_m


def labelled(parts: list[PolicyImages], expert: Expert, goal: tuple[float, ...]) -> Frames:
    """Frames of what was seen, in one shard, with the controls of a teacher."""
    seen = PolicyImages.join(parts)
    labels = expert.steer_states(seen.states).astype(np.float32)
    goals = np.tile(np.array(goal, np.float32), (len(labels), 1))
    return Frames(seen.images, seen.states, labels, goals, seen.textured)
