"""Families of random textures that train and judge a victim, and the verdicts in a run folder; `benchmarks.hardening` makes these."""

from __future__ import annotations

from collections.abc import Iterable

from advnerf_core.report.evidence.hardness import FILE, read_hardness
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.show.context import Experiment

VALIDATED_ON = ("random_natural",)


def trained_on(config: ExperimentConfig, victim: str) -> tuple[str, ...]:
    """The families of random textures that trained a victim."""
    return config.training(victim).policy.families


def unseen(methods: Iterable[str], config: ExperimentConfig) -> list[str]:
    """The methods whose textures neither trained nor judged the main victim, each once."""
    seen = (*trained_on(config, config.main_victim), *VALIDATED_ON)
    return [name for name in dict.fromkeys(methods) if name not in seen]


def passing_digest(experiment: Experiment, policy_sha256: str) -> str:
    """Digest of the passing verdict of a policy; empty without one: then no page calls the victim hardened."""
    verdict = read_hardness(experiment.folder / FILE).passing(policy_sha256)
    return "" if verdict is None else verdict.digest
