"""Learning to drive from the expert: behaviour cloning with recovery starts, then DAgger (Ross et al., 2011).

:func:`train_policy` is the whole recipe. It collects frames at random poses about the path, clones the expert, then in each
DAgger round lets the current policy drive, labels what it saw by the expert, and continues training on everything. Every
step stores its result, so that an interrupted run resumes there; the same settings give the same policy.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path as FilePath
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from advnerf_core.documents import read_json
from advnerf_core.driving.expert import Expert
from advnerf_core.files import write_atomically
from advnerf_core.learning.fit import FitConfig, fit, mean_absolute_error
from advnerf_core.learning.frames import FrameSet, FrameStore, FrameStoreError
from advnerf_core.learning.recipe import (
    ImitationConfig,
    SourcePlan,
    TrainedPolicy,
    labelled,
    near,
    recovery_states,
)
from advnerf_core.learning.sources import PolicyImages, steer_with
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView


class Learned(NamedTuple):
    """Training error of a network in training.

    Attributes:
        naive: Whether this is the policy trained on plain frames only.
        step: Optimiser steps of this policy over all rounds.
        error_rad: Running root mean square error of the control on training frames [rad, or rad/s where it is a turn rate].
    """

    naive: bool
    step: int
    error_rad: float


class ImitationProgress(Protocol):
    """Progress callback of a training."""

    def __call__(self, fraction: float, text: str, learned: Learned | None = None) -> None:
        """Report the finished fraction (0..1), the current step, and in training the running error."""


def train_policy(
    config: ImitationConfig,
    plans: Sequence[SourcePlan],
    expert: Expert,
    view: PolicyView,
    out_dir: FilePath,
    progress: ImitationProgress | None = None,
    number_type: torch.dtype | None = None,
) -> TrainedPolicy:
    """Collect, clone, and improve by DAgger; writes ``policy.safetensors`` (and ``naive.safetensors``) into ``out_dir``.

    Args:
        plans: At least one source with its amounts; names differ. Plans with different goals and experts train
            one policy on several paths.
        expert: The teacher of plans without one; poses are drawn around its path.
        view: Conversion of camera images to policy images; stored in the policy file.
        out_dir: Also keeps frames and checkpoints. Calling again with the same settings continues or returns at once; with
            other settings it is an error.
    """
    return _Recipe(config, plans, expert, view, out_dir, progress, number_type).run()


class _Recipe:
    def __init__(
        self,
        config: ImitationConfig,
        plans: Sequence[SourcePlan],
        expert: Expert,
        view: PolicyView,
        out_dir: FilePath,
        progress: ImitationProgress | None,
        number_type: torch.dtype | None,
    ) -> None:
        names = [plan.source.name for plan in plans]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"expected at least one source, with different names, got {names}")
        if len({len(plan.goal) for plan in plans}) != 1:
            raise ValueError(f"expected goals of one length, got {[list(plan.goal) for plan in plans]}")
        self.config, self.plans, self.expert, self.view, self.out_dir = config, plans, expert, view, out_dir
        self.store = FrameStore(out_dir / "frames")
        self.seconds = {"collect": 0.0, "train": 0.0}
        self._goal_size = len(plans[0].goal)
        self._progress, self._number_type = progress, number_type
        # Rough seconds per still or driven tick, and per optimiser step; only for an even progress bar.
        looks = sum(p.stills + config.dagger_rounds * p.drives * p.drive_steps for p in plans)
        steps = config.first_steps + config.dagger_rounds * config.round_steps + config.naive_steps
        self._total_work = 0.02 * looks + 0.0022 * config.batch_size * steps
        self._done_work = 0.0
        self._steps = 0  # of the current policy, in earlier rounds

    def run(self) -> TrainedPolicy:
        self._claim_folder()
        config = self.config
        torch.manual_seed(config.seed)
        policy = config.architecture.build(self._goal_size, config.max_steering_rad)
        for number, plan in enumerate(self.plans):
            self._collect(f"stills-{plan.source.name}", plan, plan.stills, self._stills(plan, number))
        self._train(policy, "clone", config.first_steps, config.learning_rate)
        for turn in range(config.dagger_rounds):
            for number, plan in enumerate(self.plans):
                name = f"drive{turn}-{plan.source.name}"
                self._collect(
                    name, plan, plan.drives * plan.drive_steps, self._drives(plan, policy, turn, number)
                )
            self._train(policy, f"dagger{turn}", config.round_steps, 0.5 * config.learning_rate)
        frames = self._frames(textured=True)
        mae = mean_absolute_error(policy, frames)
        digest = self._save("policy.safetensors", policy, mae, textured=True)
        naive_path, naive_digest, naive_mae = self._naive() if config.naive_steps else (None, None, None)
        return TrainedPolicy(
            path=self.out_dir / "policy.safetensors",
            sha256=digest,
            validation_mae_rad=mae,
            naive_path=naive_path,
            naive_sha256=naive_digest,
            naive_validation_mae_rad=naive_mae,
            frames=len(frames.training) + len(frames.held_out),
            seconds=dict(self.seconds),
        )

    def _naive(self) -> tuple[FilePath, str, float]:
        """A policy from the plain frames only, drives included."""
        torch.manual_seed(self.config.seed)
        self._steps = 0
        policy = self.config.architecture.build(self._goal_size, self.config.max_steering_rad)
        self._train(policy, "naive", self.config.naive_steps, self.config.learning_rate, textured=False)
        mae = mean_absolute_error(policy, self._frames(textured=False))
        return (
            self.out_dir / "naive.safetensors",
            self._save("naive.safetensors", policy, mae, textured=False),
            mae,
        )

    def _stills(self, plan: SourcePlan, number: int) -> Callable[[], list[PolicyImages]]:
        def collect() -> list[PolicyImages]:
            rng = np.random.default_rng([self.config.seed, 0, number])
            path = self._expert_of(plan).path
            states = recovery_states(
                path, plan.stills, rng, self.config.lateral_m, self.config.heading_rad, plan.driven_m
            )
            parts = []
            for start in range(0, plan.stills, plan.source.batch_size):
                batch = states[start : start + plan.source.batch_size]
                parts.append(plan.source.look(batch, rng))
                self._advance(
                    0.02 * len(batch), f"looking: {plan.source.name} {start + len(batch)}/{plan.stills}"
                )
            return parts

        return collect

    def _drives(
        self, plan: SourcePlan, policy: SteeringNetwork, turn: int, number: int
    ) -> Callable[[], list[PolicyImages]]:
        def collect() -> list[PolicyImages]:
            config = self.config
            rng = np.random.default_rng([config.seed, 1 + turn, number])
            path = self._expert_of(plan).path
            steer = steer_with(policy, torch.tensor([plan.goal]) if plan.goal else None)
            starts = recovery_states(
                path,
                plan.drives,
                rng,
                config.drive_lateral_m,
                config.drive_heading_rad,
                plan.drives_from_m or plan.driven_m,
            )
            parts = []
            # Two at a time at least, so that both plain and textured drives occur.
            size = max(2, plan.source.batch_size)
            for first in range(0, plan.drives, size):
                batch = starts[first : first + size]
                parts.append(
                    plan.source.drive(steer, batch, plan.drive_steps, near(path, config.give_up_m), rng)
                )
                work = 0.02 * len(batch) * plan.drive_steps
                self._advance(work, f"driving: {plan.source.name} {first + len(batch)}/{plan.drives}")
            return parts

        return collect

    def _expert_of(self, plan: SourcePlan) -> Expert:
        return plan.expert or self.expert

    def _collect(
        self, name: str, plan: SourcePlan, looks: int, collect: Callable[[], list[PolicyImages]]
    ) -> None:
        if looks == 0:
            return
        if name in self.store.names():
            self._advance(0.02 * looks, f"frames {name} are there")
            return
        start = time.perf_counter()
        self.store.append(name, labelled(collect(), self._expert_of(plan), plan.goal))
        self.seconds["collect"] += time.perf_counter() - start

    def _frames(self, textured: bool) -> FrameSet:
        shards = [self.store.load(name) for name in self.store.names()]
        return FrameSet(shards, textured, self.config.holdout_every)

    def _train(
        self, policy: SteeringNetwork, stage: str, steps: int, learning_rate: float, textured: bool = True
    ) -> None:
        start = time.perf_counter()
        config = self.config
        settings = FitConfig(
            steps=steps,
            batch_size=config.batch_size,
            learning_rate=learning_rate,
            seed=config.seed,
            augment=config.augment,
        )
        before = self._done_work
        work = 0.0022 * config.batch_size

        def report(step: int, loss: float) -> None:
            self._done_work = before + work * step
            learned = Learned(not textured, self._steps + step, loss**0.5)
            self._advance(0.0, f"training {stage}: step {step}/{steps}, error {loss**0.5:.3f} rad", learned)

        # Later shards must not change the data of an earlier stage, so a resumed stage reads the shards it began with.
        shard_names = self._claim_shards(stage)
        frames = FrameSet([self.store.load(name) for name in shard_names], textured, config.holdout_every)
        checkpoint = self.out_dir / f"{stage}.checkpoint.safetensors"
        fit(policy, frames, settings, checkpoint, report, self._number_type)
        self._done_work = before + work * steps
        self._steps += steps
        self.seconds["train"] += time.perf_counter() - start

    def _claim_shards(self, stage: str) -> list[str]:
        record = self.out_dir / f"{stage}.shards.json"
        if record.is_file():
            return list(read_json(record))
        names = self.store.names()
        write_atomically(record, json.dumps(names))
        return names

    def _save(self, name: str, policy: SteeringNetwork, mae: float, textured: bool) -> str:
        metadata = {
            "settings": self._settings(),
            "expert": self.expert.to_dict(),
            "random_textures": textured,
            "validation_mae_rad": mae,
            "shards": self.store.names(),
        }
        return save_policy(self.out_dir / name, policy, self.view, metadata)

    def _settings(self) -> dict[str, Any]:
        plans = [plan.settings() for plan in self.plans]
        return {**self.config.settings(), "plans": plans}

    def _claim_folder(self) -> None:
        """Raise if the folder has frames of other settings."""
        record = self.out_dir / "settings.json"
        data = {"settings": self._settings(), "expert": self.expert.to_dict(), "view": self.view.to_dict()}
        text = json.dumps(data, sort_keys=True, indent=1)
        if record.is_file() and record.read_text() != text:
            raise FrameStoreError(
                f"expected {self.out_dir} to be empty or to hold a run of the same settings, got a run of others;"
                " choose another folder or delete it"
            )
        write_atomically(record, text)

    def _advance(self, work: float, text: str, learned: Learned | None = None) -> None:
        self._done_work += work
        if self._progress is not None:
            self._progress(min(self._done_work / self._total_work, 1.0), text, learned)
