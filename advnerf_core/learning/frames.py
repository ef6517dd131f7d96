"""Training frames on disk: shards of memory-mappable arrays, each written whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.errors import AdvnerfError

HOLDOUT_BLOCK = 16

Batch = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]
"""Images ``[B, 66, 200, 3]``, labels ``[B]`` and goals ``[B, G]``."""


class FrameStoreError(AdvnerfError, ValueError):
    """Training frames on disk cannot be used."""


@dataclass(frozen=True)
class Frames:
    """Images, and the expert's controls for them.

    Attributes:
        images: ``[N, 66, 200, 3]`` uint8 RGB policy images.
        states: ``[N, 3]`` float64 x [m], y [m], yaw [rad] of the rear axle.
        steering_rad: ``[N]`` float32 labels [rad].
        goals: ``[N, G]`` float32 goal vectors; ``G`` may be 0.
        textured: ``[N]`` bool: the object showed a random texture instead of its plain colour.
    """

    images: NDArray[np.uint8]
    states: NDArray[np.float64]
    steering_rad: NDArray[np.float32]
    goals: NDArray[np.float32]
    textured: NDArray[np.bool_]

    def __post_init__(self) -> None:
        count = len(self.images)
        good = (
            self.images.ndim == 4
            and self.images.dtype == np.uint8
            and self.states.shape == (count, 3)
            and self.steering_rad.shape == self.textured.shape == (count,)
            and self.goals.ndim == 2
            and len(self.goals) == count
        )
        if not good:
            shapes = {field.name: list(np.shape(getattr(self, field.name))) for field in fields(self)}
            raise FrameStoreError(f"expected arrays of one length with the shapes of Frames, got {shapes}")
        if not np.isfinite(self.steering_rad).all():
            raise FrameStoreError(
                "expected finite steering labels, got NaN or infinity; check the expert and the poses"
            )

    def __len__(self) -> int:
        return len(self.images)


class FrameStore:
    """A folder of named shards.

    Args:
        folder: Folder of the shards; created on the first write.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def names(self) -> list[str]:
        """Names of the finished shards, sorted."""
        if not self.folder.is_dir():
            return []
        return sorted(
            entry.name for entry in self.folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")
        )

    def append(self, name: str, frames: Frames) -> None:
        """Add a shard; it appears complete or not at all. A shard of the same name must not exist."""
        target = self.folder / name
        if target.exists():
            raise FrameStoreError(
                f"expected a new shard name, got {name!r} which is already in {self.folder}"
            )
        partial = self.folder / f".{name}.{os.getpid()}.tmp"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        try:
            for field in fields(frames):
                np.save(partial / f"{field.name}.npy", getattr(frames, field.name), allow_pickle=False)
            partial.replace(target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise

    def load(self, name: str) -> Frames:
        """One shard, memory-mapped."""
        folder = self.folder / name
        try:
            arrays = {
                field.name: np.load(folder / f"{field.name}.npy", mmap_mode="r", allow_pickle=False)
                for field in fields(Frames)
            }
        except (OSError, ValueError) as error:
            raise FrameStoreError(
                f"expected a frame shard in {folder}, got {error}; delete it and collect again"
            ) from error
        return Frames(**arrays)


class FrameSet:
    """Several shards as one, and a selection of their frames.

    Args:
        shards: At least one shard; all with the same goal size.
        include_textured: Whether frames with random textures are selected.
        holdout_every: Every n-th block of 16 consecutive selected frames is kept for validation; 0 keeps none. Blocks, because
            neighbours show the same pose in several textures, or the next moment of the same drive.
    """

    def __init__(
        self, shards: Sequence[Frames], include_textured: bool = True, holdout_every: int = 0
    ) -> None:
        if not shards or len({shard.goals.shape[1] for shard in shards}) != 1:
            raise FrameStoreError(
                f"expected shards with one goal size, got {len(shards)} shards of different or no goals"
            )
        self._shards = list(shards)
        training: list[tuple[int, int]] = []
        held_out: list[tuple[int, int]] = []
        for index, shard in enumerate(shards):
            chosen = np.flatnonzero(
                np.ones(len(shard), bool) if include_textured else ~np.asarray(shard.textured)
            )
            for order, row in enumerate(chosen):
                target = (
                    held_out
                    if holdout_every and order // HOLDOUT_BLOCK % holdout_every == holdout_every - 1
                    else training
                )
                target.append((index, int(row)))
        self.training = np.array(training, dtype=np.int64).reshape(-1, 2)
        self.held_out = np.array(held_out, dtype=np.int64).reshape(-1, 2)
        self.goal_size = int(shards[0].goals.shape[1])

    def batch(self, rows: NDArray[np.int64]) -> Batch:
        """Images ``[B, 66, 200, 3]``, labels ``[B]`` and goals ``[B, G]`` of rows of ``training`` or ``held_out``."""
        images = np.empty((len(rows), *self._shards[0].images.shape[1:]), np.uint8)
        labels, goals = np.empty(len(rows), np.float32), np.empty((len(rows), self.goal_size), np.float32)
        for index, shard in enumerate(self._shards):
            chosen = rows[:, 0] == index
            row = rows[chosen, 1]
            images[chosen], labels[chosen], goals[chosen] = (
                shard.images[row],
                shard.steering_rad[row],
                shard.goals[row],
            )
        return images, labels, goals
