"""Families of random textures that train and judge a victim, and the verdicts in a run folder; `nodes.experiment.steps.hardening` makes these."""

from __future__ import annotations

from collections.abc import Iterable

from advnerf_core.report.evidence.hardness import FILE, HardnessRecord, read_hardness
from nodes.experiment.show.context import Experiment

# `objects.random_theta` draws the textures of a training: white noise on every cell.
TRAINED_ON = ("random",)
VALIDATED_ON = ("random_natural",)


def unseen(methods: Iterable[str]) -> list[str]:
    """The methods whose textures neither trained nor judged the victim, each once."""
    return [name for name in dict.fromkeys(methods) if name not in (*TRAINED_ON, *VALIDATED_ON)]


def hardness_record(experiment: Experiment) -> HardnessRecord:
    """The verdicts in the run folder of an experiment."""
    return read_hardness(experiment.folder / FILE)


def passing_digest(experiment: Experiment, policy_sha256: str) -> str:
    """Digest of the passing verdict of a policy; empty without one: then no page calls the victim hardened."""
    verdict = hardness_record(experiment).passing(policy_sha256)
    return "" if verdict is None else verdict.digest
