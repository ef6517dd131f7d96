"""Fine-tuning of a policy on the attacks that misled it: old and new frames in one set, starting from its own weights.

The paper's defence (section 4, "Retraining"): drive with the attacked objects, label every frame with the expert's steering, and continue
training on old and new data together. New frames are fewer than old ones, so a batch takes a fixed share of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import finite_or_none
from advnerf_core.learning.augment import AugmentConfig
from advnerf_core.learning.fit import FitConfig, fit, mean_absolute_error
from advnerf_core.learning.frames import Frames, FrameSet, FrameStoreError
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.policy_file import LoadedPolicy, architecture_of, save_policy


@dataclass(frozen=True)
class FineTuneConfig:
    """Settings of a fine-tuning.

    Attributes:
        learning_rate: Peak; lower than for training from scratch.
        new_share: Share of the training frames that is new, by repeating them; 0.5 weighs old and new alike. None repeats
            nothing.
        holdout_every: One block of frames in this many is held out for validation.
    """

    steps: int = 400
    batch_size: int = 64
    learning_rate: float = 5e-4
    new_share: float | None = 0.4
    holdout_every: int = 10
    seed: int = 0
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        if self.new_share is not None and not 0.0 < self.new_share < 1.0:
            raise ValueError(f"expected a share of new frames between 0 and 1, or none, got {self.new_share}")


@dataclass(frozen=True)
class Retrained:
    """A fine-tuned policy.

    Attributes:
        old_mae_rad: Mean absolute error on held-out old frames, before and after [rad].
        new_mae_rad: The same on held-out new frames [rad].
    """

    path: Path
    sha256: str
    old_mae_rad: tuple[float, float]
    new_mae_rad: tuple[float, float]


class MixedFrames(FrameSet):
    """Old and new frames, with the new ones repeated until they are a given share of the training frames.

    Args:
        old: Shards that the policy was trained on.
        new: Shards with the found objects.
    """

    def __init__(
        self, old: Sequence[Frames], new: Sequence[Frames], new_share: float | None, holdout_every: int
    ) -> None:
        if not old or not new:
            raise FrameStoreError(
                f"expected old and new frames, got {len(old)} old and {len(new)} new shards"
            )
        super().__init__([*old, *new], True, holdout_every)
        self._first_new = len(old)
        if new_share is not None:
            self.training = self._weighted(new_share).reshape(-1, 2)

    def held_out_rows(self, new: bool) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
        """Rows of ``held_out`` that are new, or old."""
        return self.held_out[(self.held_out[:, 0] >= self._first_new) == new].reshape(-1, 2)

    def _weighted(self, share: float) -> NDArray[np.int64]:
        is_new = self.training[:, 0] >= self._first_new
        old, new = self.training[~is_new], self.training[is_new]
        if not len(old) or not len(new):
            raise FrameStoreError(
                f"expected old and new frames to train on, got {len(old)} and {len(new)}: hold fewer out, or collect more"
            )
        wanted = max(len(new), round(len(old) * share / (1.0 - share)))
        return np.concatenate([old, np.resize(new, (wanted, 2))])


def fine_tune(
    policy: LoadedPolicy,
    old: Sequence[Frames],
    new: Sequence[Frames],
    config: FineTuneConfig,
    out_file: Path,
    report: Callable[[int, float], None] | None = None,
) -> Retrained:
    """Continue training a policy on old and new frames; a checkpoint beside ``out_file`` makes it resumable to the bit.

    Args:
        policy: The policy to start from; it is not changed.
        old: Shards it was trained on.
        new: Shards with the found objects, labelled by the expert.
        report: Called with the step and the running mean square error [rad^2].

    Raises:
        FrameStoreError: No frames of one kind, goals of another size, or a checkpoint of other settings.
        PolicyFileError: The policy's architecture cannot be trained here.
    """
    frames = MixedFrames(old, new, config.new_share, config.holdout_every)
    if frames.goal_size != policy.policy.goal_size:
        raise FrameStoreError(
            f"expected frames with goals of size {policy.policy.goal_size} for this policy, got {frames.goal_size}"
        )
    network = architecture_of(policy.policy).build(policy.policy.goal_size, policy.policy.max_steering_rad)
    network.load_state_dict(policy.policy.state_dict())
    before = _errors(network, frames)
    fitting = FitConfig(
        config.steps, config.batch_size, config.learning_rate, seed=config.seed, augment=config.augment
    )
    fit(network, frames, fitting, out_file.with_suffix(".checkpoint.safetensors"), report)
    after = _errors(network, frames)
    metadata = {
        "fine_tuned_from": policy.sha256,
        "settings": json.loads(json.dumps(asdict(config))),
        "old_mae_rad": finite_or_none(after[0]),
        "new_mae_rad": finite_or_none(after[1]),
        "old_frames": sum(map(len, old)),
        "new_frames": sum(map(len, new)),
    }
    digest = save_policy(out_file, network, policy.view, metadata)
    return Retrained(out_file, digest, (before[0], after[0]), (before[1], after[1]))


def _errors(network: SteeringNetwork, frames: MixedFrames) -> tuple[float, float]:
    """Mean absolute error [rad] on held-out old and new frames; NaN where none are held out."""
    network.eval()
    errors = []
    for new in (False, True):
        rows, kept = frames.held_out_rows(new), frames.held_out
        frames.held_out = rows
        errors.append(mean_absolute_error(network, frames) if len(rows) else float("nan"))
        frames.held_out = kept
    return errors[0], errors[1]
