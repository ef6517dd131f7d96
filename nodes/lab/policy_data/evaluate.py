"""Evaluates a policy on a recording: error table, steering plot and saliency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.data.image_files import write_image
from advnerf_core.driving.rollout import Remembering
from advnerf_core.files import write_atomically
from advnerf_core.learning.frames import HOLDOUT_BLOCK
from advnerf_core.report.clips import write_video
from nodes.lab.policy_data.frames import HOLDOUT_EVERY, RecordedFrames, held_out
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError

_BATCH = 64
_VIDEO_SCALE = 4
_REVERSED_R = -0.5


@dataclass(frozen=True)
class Errors:
    """Statistics of predicted minus true steering.

    Attributes:
        bias_rad: Mean error; positive means further left [rad].
        correlation: Pearson correlation; NaN if one side is constant.
        zero_rad: Mean absolute error of always steering straight, for comparison [rad].
    """

    count: int
    mean_abs_rad: float
    rms_rad: float
    worst_rad: float
    bias_rad: float
    correlation: float
    zero_rad: float

    @property
    def problem(self) -> str:
        """Why these errors look like another side of the steering; empty if they do not."""
        if not (self.correlation < _REVERSED_R and self.mean_abs_rad > self.zero_rad):
            return ""
        return (
            f"the steering seems reversed (r {self.correlation:.2f}, errors larger than those of driving straight on): check steering-positive of the log, "
            "and the side that the policy declares"
        )


def compare(predicted_rad: NDArray[np.floating[Any]], true_rad: NDArray[np.floating[Any]]) -> Errors:
    """Compute the errors over the frames in which both are known."""
    known = np.isfinite(predicted_rad) & np.isfinite(true_rad)
    predicted, true = np.asarray(predicted_rad, float)[known], np.asarray(true_rad, float)[known]
    if not len(true):
        raise ConfigError(
            "expected frames with a recorded or labelled steering angle, got none; use another recording or --labels"
        )
    error = predicted - true
    varies = predicted.std() > 0.0 and true.std() > 0.0
    return Errors(
        len(true),
        float(np.abs(error).mean()),
        float(np.sqrt((error**2).mean())),
        float(np.abs(error).max()),
        float(error.mean()),
        float(np.corrcoef(predicted, true)[0, 1]) if varies else float("nan"),
        float(np.abs(true).mean()),
    )


def compared(
    recording: RecordedFrames, predicted_rad: NDArray[np.float64], labels: str, only_held_out: bool
) -> dict[str, Errors]:
    """Errors against the labels, and against the recorded steering if that is something else and there is any.

    Args:
        predicted_rad: Steering ``[N]`` for all frames [rad].
        labels: Name of the labels, for the result.
        only_held_out: Compare only the frames that a training on this log keeps out.
    """
    rows = held_out(recording) if only_held_out else np.arange(len(predicted_rad))
    if not len(rows):
        raise ConfigError(
            f"expected frames of {recording.name} that are held out, got none of {len(predicted_rad)}: "
            f"every {HOLDOUT_EVERY}th block of {HOLDOUT_BLOCK} frames is; use a longer log, or remove --held-out"
        )
    found = {labels: compare(predicted_rad[rows], np.asarray(recording.frames.steering_rad)[rows])}
    if labels == "expert" and np.isfinite(recording.recorded_rad[rows]).any():
        found["recorded"] = compare(predicted_rad[rows], recording.recorded_rad[rows])
    return found


def predict(
    policy: Any, images: NDArray[np.uint8], goal: tuple[float, ...] = (), drive_starts: Sequence[int] = (0,)
) -> NDArray[np.float64]:
    """Compute the steering ``[N]`` [rad] of a loaded policy for policy images ``[N, H, W, 3]`` uint8.

    Args:
        drive_starts: Numbers of the images before which a policy with memory has none.

    Raises:
        ConfigError: The policy answers an image by no finite number.
    """
    has_memory, begun = not getattr(policy, "stateless", True), {0, *drive_starts}
    batch = 1 if has_memory else _BATCH  # with memory one by one, in driving order
    parts, current = [], policy
    with torch.no_grad():
        for start in range(0, len(images), batch):
            if has_memory and start in begun:
                current = Remembering.afresh(policy, 1)
            parts.append(_steer(current, _tensor(images[start : start + batch]), goal).double().numpy())
    predicted_rad = np.concatenate(parts)
    if len(wrong := np.flatnonzero(~np.isfinite(predicted_rad))):
        raise ConfigError(
            f"expected finite steering from the policy, got {predicted_rad[wrong[0]]} for {len(wrong)} of {len(images)} images, "
            f"the first of them number {wrong[0]}; look for a division by zero or a logarithm, and for damaged weights"
        )
    return predicted_rad


def saliency(policy: Any, images: NDArray[np.uint8], goal: tuple[float, ...] = ()) -> NDArray[np.float32]:
    """Compute the saliency ``[N, H, W]`` in 0..1: absolute gradient of the steering, summed over colours, smoothed.

    A policy with memory sees each image as the first of a drive. Without a finite gradient, a `ConfigError` is raised.

    Gradient saliency after Simonyan et al., "Deep Inside Convolutional Networks", 2014, with a blur of 1.5 px.
    """
    maps = []
    for start in range(0, len(images), _BATCH):
        batch = _tensor(images[start : start + _BATCH]).requires_grad_(True)
        for one in _gradient(policy, batch, goal).abs().sum(1).numpy():
            smooth = cv2.GaussianBlur(one, (0, 0), 1.5)
            maps.append(smooth / max(float(smooth.max()), 1e-12))
    return np.stack(maps).astype(np.float32)


def _gradient(policy: Any, images: torch.Tensor, goal: tuple[float, ...]) -> torch.Tensor:
    """Gradient of the steering in the images, ``[B, 3, H, W]``."""
    steering = _steer(policy, images, goal)
    if not steering.requires_grad:
        raise _no_saliency("none: something cuts it off, such as detach, no_grad or rounding")
    gradient = torch.autograd.grad(steering.sum(), images)[0]
    if not bool(gradient.isfinite().all()):
        raise _no_saliency("one that is NaN or infinite")
    return gradient


def _no_saliency(got: str) -> ConfigError:
    return ConfigError(
        f"expected a gradient of the steering in the images, got {got}; correct the policy (see advnerf policy check), "
        "or give --saliency 0 without --video"
    )


def overlay(image: NDArray[np.uint8], share: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Overlay the saliency in red on an image, ``[H, W, 3]`` uint8 RGB."""
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB).astype(np.float32)
    red = np.array([255.0, 40.0, 0.0], np.float32)
    return np.asarray(grey + share[..., None] * (red - grey), dtype=np.float32).round().astype(np.uint8)


def draw(recording: RecordedFrames, predicted_rad: NDArray[np.float64], title: str, out: Path) -> None:
    """Plot predicted, recorded and labelled steering over time as PNG."""
    import io

    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    axes, scatter = figure.subplots(1, 2, width_ratios=[2, 1])
    time_s = (recording.stamps_ns - recording.stamps_ns[0]) / NS_PER_S
    if not recording.has_times:
        time_s = recording.stamps_ns.astype(float)
    labels = np.asarray(recording.frames.steering_rad)
    axes.plot(time_s, recording.recorded_rad, color="0.6", lw=1, label="recorded")
    axes.plot(time_s, labels, color="C0", lw=1, label="label")
    axes.plot(time_s, predicted_rad, color="C3", lw=1, label="predicted")
    axes.set(xlabel="time [s]" if recording.has_times else "frame", ylabel="steering, left positive [rad]")
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=8)
    scatter.plot(labels, predicted_rad, ".", ms=2, color="C3")
    low, high = float(min(labels.min(), predicted_rad.min())), float(max(labels.max(), predicted_rad.max()))
    scatter.plot([low, high], [low, high], color="0.6", lw=1)
    scatter.set(xlabel="label [rad]", ylabel="predicted [rad]")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomically(out, picture.getvalue())


def write_saliency(
    policy: Any, recording: RecordedFrames, out: Path, count: int, video: bool, goal: tuple[float, ...] = ()
) -> list[Path]:
    """Write PNG files of ``count`` frames spread over the recording, image above saliency, and with ``video`` an MP4 of all frames.

    Those of an earlier call are removed from the folder.
    """
    images = recording.frames.images
    chosen = np.unique(np.linspace(0, len(images) - 1, min(count, len(images))).round().astype(int))
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob("saliency_" + 5 * "[0-9]" + ".png"), out / "saliency.mp4"):
        old.unlink(missing_ok=True)
    files = []
    for index, share in (
        zip(chosen, saliency(policy, images[chosen], goal), strict=True) if len(chosen) else ()
    ):
        both = np.concatenate([images[index], overlay(images[index], share)])
        files.append(out / f"saliency_{index:05d}.png")
        write_image(files[-1], both)
    if video:
        files.append(write_video(out / "saliency.mp4", _filmed(policy, images, goal)))
    return files


def _filmed(policy: Any, images: NDArray[np.uint8], goal: tuple[float, ...]) -> Iterator[NDArray[np.uint8]]:
    """Each image above its saliency, enlarged."""
    for start in range(0, len(images), _BATCH):
        batch = images[start : start + _BATCH]
        for image, share in zip(batch, saliency(policy, batch, goal), strict=True):
            both = np.concatenate([image, overlay(image, share)])
            yield both.repeat(_VIDEO_SCALE, axis=0).repeat(_VIDEO_SCALE, axis=1)


def _tensor(images: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(np.array(images)).permute(0, 3, 1, 2).float() / 255.0


def _steer(policy: Any, images: torch.Tensor, goal: tuple[float, ...]) -> torch.Tensor:
    goals = torch.tensor(goal).expand(len(images), -1) if goal else None
    result: torch.Tensor = Remembering.afresh(policy, len(images))(images, goals)
    return result
