"""The driving policy: a goal-conditioned PilotNet, and its file.

PilotNet is the network of Bojarski et al., "End to End Learning for Self-Driving Cars" (2016): a 200x66 image, five
convolutions (the first three with stride 2), then linear layers down to one steering value.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor, nn

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import with_sorted_header, write_atomically
from advnerf_core.places import open_tensors
from advnerf_core.policies.view import PolicyView

IMAGE_HEIGHT, IMAGE_WIDTH = 66, 200
FILE_FORMAT = "advnerf-policy-1"

# (channels, kernel, stride) of each convolution, Bojarski et al. figure 4.
CONVOLUTIONS = ((24, 5, 2), (36, 5, 2), (48, 5, 2), (64, 3, 1), (64, 3, 1))
FLAT_FEATURES = 64 * 1 * 18
# A few goal inputs beside a thousand features start with so much larger weights, or a policy learns every view before it learns
# to be told where to go: only the views ahead of a junction need the goal.
GOAL_GAIN = 12.0


class Policy(Protocol):
    """What a rollout and an attack need of a policy."""

    stateless: bool

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad], left positive, for images ``[B, 3, H, W]`` RGB 0..1 and goals ``[B, goal_size]``."""


class PolicyFileError(AdvnerfError, ValueError):
    """A policy file cannot be read or is not what was asked for."""


class PilotNet(nn.Module):
    """PilotNet with smooth activations, an optional goal vector and bounded steering.

    Every layer is smooth (ELU is continuously differentiable), so finite differences confirm its gradients. It has no
    dropout and no batch statistics: train and eval mode compute the same. The colour scaling to [-1, 1] is inside.

    Attributes:
        stateless: True: the output depends on the current image and goal only.
        goal_size: Length of the goal vector, 0 for none. It joins the flattened features.
        max_steering_rad: Bound of the output [rad].
        hidden: Widths of the linear layers; the paper's are 100, 50, 10, goal-conditioned networks profit from wider ones.
    """

    stateless = True

    def __init__(
        self, goal_size: int = 0, max_steering_rad: float = 0.30, hidden: tuple[int, int, int] = (100, 50, 10)
    ) -> None:
        super().__init__()
        if goal_size < 0 or not max_steering_rad > 0.0:
            raise ValueError(
                f"expected goal_size >= 0 and max_steering_rad > 0, got {goal_size}, {max_steering_rad}"
            )
        self.goal_size = goal_size
        self.max_steering_rad = max_steering_rad
        self.hidden = (int(hidden[0]), int(hidden[1]), int(hidden[2]))
        layers: list[nn.Module] = []
        channels = 3
        for width, kernel, stride in CONVOLUTIONS:
            layers += [nn.Conv2d(channels, width, kernel, stride), nn.ELU()]
            channels = width
        self.features = nn.Sequential(*layers, nn.Flatten())
        widths = [FLAT_FEATURES + goal_size, *self.hidden]
        linear: list[nn.Module] = []
        for fan_in, fan_out in pairwise(widths):
            linear += [nn.Linear(fan_in, fan_out), nn.ELU()]
        self.head = nn.Sequential(*linear, nn.Linear(widths[-1], 1))
        if goal_size:
            with torch.no_grad():  # no file and no policy without a goal is touched by this
                next(self.head.parameters())[:, FLAT_FEATURES:] *= GOAL_GAIN

    def forward(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad], left positive, within ``+-max_steering_rad``.

        Args:
            images: ``[B, 3, 66, 200]`` RGB in 0..1, float32 or float64 like the weights.
            goals: ``[B, goal_size]``; must be given exactly if ``goal_size > 0``.
        """
        if images.ndim != 4 or images.shape[1:] != (3, IMAGE_HEIGHT, IMAGE_WIDTH):
            raise ValueError(
                f"expected images [B, 3, {IMAGE_HEIGHT}, {IMAGE_WIDTH}], got {list(images.shape)}"
            )
        features = self.features(images * 2.0 - 1.0)
        if self.goal_size > 0 or goals is not None:
            shape = None if goals is None else list(goals.shape)
            if goals is None or shape != [images.shape[0], self.goal_size]:
                raise ValueError(f"expected goals [{images.shape[0]}, {self.goal_size}], got {shape}")
            features = torch.cat([features, goals.to(features.dtype)], dim=1)
        output: Tensor = self.max_steering_rad * torch.tanh(self.head(features)[:, 0])
        return output

    def settings(self) -> dict[str, Any]:
        """Constructor arguments, as plain data."""
        return {
            "goal_size": self.goal_size,
            "max_steering_rad": self.max_steering_rad,
            "hidden": list(self.hidden),
        }


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy read from a file, or made by a factory.

    Attributes:
        policy: A `PilotNet` or an ``AdaptedPolicy`` with ``stateless`` and ``goal_size``, in eval mode, without gradients to its
            weights.
        view: How camera images become policy images.
        metadata: What the trainer wrote about it.
        sha256: Hash over weights and metadata; identifies the policy in manifests and attack files.
    """

    policy: Any
    view: PolicyView
    metadata: dict[str, Any]
    sha256: str


def images_to_tensor(images: NDArray[np.uint8], dtype: torch.dtype = torch.float32) -> Tensor:
    """Tensor ``[B, 3, H, W]`` RGB 0..1 from uint8 images ``[B, H, W, 3]`` (or one image ``[H, W, 3]``)."""
    batch = np.ascontiguousarray(images if images.ndim == 4 else images[None])
    if not batch.flags.writeable:
        batch = batch.copy()  # torch warns about read-only buffers
    # The memory stays channels-last, which is also the faster layout for the convolutions.
    return torch.from_numpy(batch).permute(0, 3, 1, 2).to(dtype).div(255.0)


def save_policy(
    path: str | os.PathLike[str], policy: PilotNet, view: PolicyView, metadata: Mapping[str, Any]
) -> str:
    """Write a policy file atomically and return its hash.

    Args:
        path: Target, by convention ``*.safetensors``.
        policy: The network.
        view: How camera images become its input.
        metadata: Anything JSON can hold: training settings, data, measured errors.
    """
    weights = {name: value.detach().cpu().contiguous() for name, value in policy.state_dict().items()}
    header = {
        "format": FILE_FORMAT,
        "network": _canonical(policy.settings()),
        "view": _canonical(view.to_dict()),
        "metadata": _canonical(dict(metadata)),
    }
    digest = _digest(weights, header)
    write_atomically(Path(path), with_sorted_header(save(weights, {**header, "sha256": digest})))
    return digest


def load_policy(path: str | os.PathLike[str], expected_sha256: str | None = None) -> LoadedPolicy:
    """Read a policy file and check its hash against its content and, if given, against ``expected_sha256``."""
    header, weights = _read(Path(path))
    stored = header.pop("sha256")
    digest = _digest(weights, header)
    if digest != stored:
        raise PolicyFileError(
            f"expected content with hash {stored} in {path}, got {digest}: the file is damaged"
        )
    if expected_sha256 is not None and digest != expected_sha256:
        raise PolicyFileError(
            f"expected the policy {expected_sha256} in {path}, got {digest}: retrain it or correct the configured hash"
        )
    settings = json.loads(header["network"])
    policy = PilotNet(settings["goal_size"], settings["max_steering_rad"], tuple(settings["hidden"]))
    dtype = next(iter(weights.values())).dtype
    policy = policy.to(dtype)
    policy.load_state_dict(weights)
    policy.eval().requires_grad_(False)
    view = PolicyView.from_dict(json.loads(header["view"]))
    return LoadedPolicy(policy, view, json.loads(header["metadata"]), digest)


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with open_tensors(path, "pt") as file:
            header = dict(file.metadata() or {})
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError as error:
        raise PolicyFileError(
            f"expected a policy file at {path}, found none: train a policy first"
        ) from error
    except (SafetensorError, OSError) as error:
        raise PolicyFileError(
            f"expected a policy file at {path}, got an unreadable one ({error}): train again"
        ) from error
    missing = {"network", "view", "metadata", "sha256"} - header.keys()
    if header.get("format") != FILE_FORMAT or missing:
        raise PolicyFileError(
            f"expected a file of format {FILE_FORMAT} at {path}, got {header.get('format')!r}"
        )
    return header, weights


def _canonical(data: Any) -> str:
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _digest(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 over the sorted header and tensors (not over file bytes: the container may order its header freely)."""
    sha = hashlib.sha256()
    for key in sorted(header):
        sha.update(f"{key}\0{header[key]}\0".encode())
    for name in sorted(weights):
        array = weights[name].numpy()
        sha.update(f"{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()
