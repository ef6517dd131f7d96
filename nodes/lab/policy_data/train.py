"""Trains a policy on recordings. Frames are extracted once, a stopped training resumes, and the result is written atomically."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import torch

from advnerf_core.data.logs.choice import LogError
from advnerf_core.documents import read_json
from advnerf_core.driving.expert import Expert
from advnerf_core.files import write_atomically, write_json
from advnerf_core.learning.fit import FitConfig, fit, mean_absolute_error
from advnerf_core.learning.frames import HOLDOUT_BLOCK, Frames, FrameSet, FrameStore
from advnerf_core.learning.imitation import ImitationProgress, train_policy
from advnerf_core.learning.recipe import ImitationConfig, SourcePlan
from advnerf_core.places import require_utf8
from advnerf_core.policies.policy_file import copy_policy, save_policy
from advnerf_core.policies.view import PolicyView
from nodes.lab.policy_data.logs import OpenLog
from nodes.lab.policy_data.recordings import recorded_frames
from nodes.runtime.progress import Report

POLICY = "policy.safetensors"
_FRAMES = "frames"
_MOST_SHARED = 0.1  # of the images of a log; two drives of a simulator may start with the same ones
_IS_DIGEST = re.compile("[0-9a-f]{16}")


@dataclass(frozen=True)
class Training:
    """Result of a training.

    Attributes:
        validation_mae_rad: Mean absolute steering error on held-out frames [rad].
        frames: Number of frames of each recording, and of the surrogate.
        left_out: Number of skipped images of each recording, by reason.
        unchecked: Recordings without checksums, and why.
    """

    path: Path
    sha256: str
    validation_mae_rad: float
    frames: dict[str, int]
    left_out: dict[str, dict[str, int]]
    unchecked: dict[str, str]


def train_from_recordings(
    logs: Sequence[OpenLog],
    view: PolicyView,
    expert: Expert,
    config: ImitationConfig,
    out: Path,
    surrogate: SourcePlan | None = None,
    progress: Report | None = None,
) -> Training:
    """Train on logs, and on the surrogate if given, and write ``policy.safetensors`` to ``out``.

    Frames and checkpoints are in ``out/work/<digest of all inputs>``. The same call resumes, or returns at once if finished. Other
    recordings or settings start a new training, and remove the earlier work when they are finished.

    Raises:
        LogError: Two logs, or two parts of one, have the same images.
    """
    require_utf8(out.absolute())
    digests = {log.name: _digest_of(log) for log in logs}
    claim = {
        "parts": digests,
        "view": view.to_dict(),
        "expert": expert.to_dict(),
        "config": config.settings(),
        "surrogate": None
        if surrogate is None
        else [surrogate.source.name, surrogate.stills, surrogate.drives],
    }
    work = out / "work" / _digest(claim)
    report: Report = progress or (lambda share, text="": None)
    store = FrameStore(work / _FRAMES)
    left_out = {log.name: _cut(log, digests[log.name], view, expert, store, work, report) for log in logs}
    _refuse_shared_images({name: store.load(_shard(digest)) for name, digest in digests.items()})
    if surrogate is None:
        sha256, mae = _clone(store, view, expert, config, work, {"recordings": digests}, report)
    else:
        bare: ImitationProgress = lambda share, text, learned=None: report(share, text)  # noqa: E731 - typed
        trained = train_policy(config, [surrogate], expert, view, work, bare)
        sha256, mae = trained.sha256, trained.validation_mae_rad
    copy_policy(work / POLICY, out / POLICY)
    frames = {name: len(store.load(name)) for name in store.names()}
    named = {name: frames.pop(_shard(digest)) for name, digest in digests.items()}
    unchecked = {each.name: each.log.unchecked for each in logs if each.log.unchecked}
    result = Training(out / POLICY, sha256, mae, {**named, **frames}, left_out, unchecked)
    summary = {**asdict(result), "path": POLICY, "settings": claim}
    write_json(out / "policy.json", summary)
    _remove_earlier(work)
    return result


def _remove_earlier(work: Path) -> None:
    """Remove the work of earlier trainings beside ``work``, and no other folder that the user keeps there."""
    for old in work.parent.iterdir():
        if old != work and _IS_DIGEST.fullmatch(old.name) and (old / _FRAMES).is_dir():
            shutil.rmtree(old, ignore_errors=True)


def _cut(
    log: OpenLog, digest: str, view: PolicyView, expert: Expert, store: FrameStore, work: Path, report: Report
) -> dict[str, int]:
    """Extract the frames of a log to a shard, once. Returns the numbers of skipped images."""
    shard = _shard(digest)
    record = work / f"{shard}.json"
    if shard not in store.names() or not record.is_file():
        report(0.0, f"cutting {log.name}")
        shutil.rmtree(store.folder / shard, ignore_errors=True)
        recording = recorded_frames(log, view, expert)
        write_atomically(record, json.dumps(recording.counts) + "\n")
        store.append(shard, recording.frames)
    return {reason: int(count) for reason, count in read_json(record).items()}


def _refuse_shared_images(shards: Mapping[str, Frames]) -> None:
    """Refuse one drive twice, in one log or in two, in whatever formats: what is held out of one would be learned from the other."""
    images = {
        name: [hashlib.sha256(image.tobytes()).digest() for image in shard.images]
        for name, shard in shards.items()
    }
    for name, digests in images.items():
        if (again := _shown_again(digests)) > _MOST_SHARED * len(digests):
            raise LogError(
                f"expected every drive once, as its frames are learned from or held out, got {name}, in which {again} of {len(digests)} images "
                "are those of an earlier part; remove one of the parts"
            )
    distinct = {name: set(digests) for name, digests in images.items()}
    for one, other in combinations(distinct, 2):
        shared = len(distinct[one] & distinct[other])
        if shared > _MOST_SHARED * min(len(distinct[one]), len(distinct[other])):
            raise LogError(
                f"expected every drive once, as its frames are learned from or held out, got {one} and {other}, which have {shared} images "
                "in common; remove one of them"
            )


def _shown_again(digests: Sequence[bytes]) -> int:
    """Number of images that were seen before, but not within the last block of frames: those of a standing car are no copies."""
    last: dict[bytes, int] = {}
    again = 0
    for number, digest in enumerate(digests):
        again += number - last.get(digest, number) > HOLDOUT_BLOCK
        last[digest] = number
    return again


def _clone(
    store: FrameStore,
    view: PolicyView,
    expert: Expert,
    config: ImitationConfig,
    work: Path,
    metadata: dict[str, Any],
    report: Report,
) -> tuple[str, float]:
    torch.manual_seed(config.seed)
    policy = config.architecture.build(0, config.max_steering_rad)
    frames = FrameSet([store.load(name) for name in store.names()], True, config.holdout_every)
    settings = FitConfig(
        steps=config.first_steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        seed=config.seed,
        augment=config.augment,
    )

    def tell(step: int, loss: float) -> None:
        report(
            step / config.first_steps,
            f"training: step {step}/{config.first_steps}, error {loss**0.5:.3f} rad",
        )

    fit(policy, frames, settings, work / "clone.checkpoint.safetensors", tell)
    mae = mean_absolute_error(policy, frames)
    details = {
        **metadata,
        "settings": config.settings(),
        "expert": expert.to_dict(),
        "validation_mae_rad": mae,
    }
    return save_policy(work / POLICY, policy, view, details), mae


def _shard(digest: str) -> str:
    return f"recording-{digest}"


def _digest_of(opened: OpenLog) -> str:
    """Digest of a log's files and options. Where sizes or times of files change, it counts as another log."""
    # What is missing is told when it is read.
    stats = [(file.name, file.stat()) for file in opened.log.files if file.exists()]
    files = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return _digest([opened.name, files, {**asdict(opened.choice), "labels": opened.labels}])


def _digest(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:16]
