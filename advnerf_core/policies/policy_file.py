"""The file of a policy: the weights of a network, its architecture, its view, and its trainer's metadata."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advnerf_core.code_files import file_sha256
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import read_tensors, write_atomically, write_tensors
from advnerf_core.plugins import code_sha256, is_file_reference
from advnerf_core.policies.architecture import (
    ARCHITECTURES,
    GROUP,
    PILOTNET,
    Architecture,
    plain_values,
    short_name,
)
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.view import PolicyView

FILE_FORMAT = "advnerf-policy-1"
# Folder beside the policy file with the code of a user's architecture; the first characters of its hash follow.
_CODE_FOLDER = "architecture_"


class PolicyFileError(AdvnerfError, ValueError):
    """A policy file cannot be read or is not the expected one."""


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy read from a file, or made by a factory.

    Attributes:
        policy: A `SteeringNetwork` or an ``AdaptedPolicy`` with ``stateless`` and ``goal_size``, in eval mode, without gradients to its
            weights.
        view: Conversion of camera images to policy images.
        sha256: Hash over weights and metadata; identifies the policy in manifests and attack files.
    """

    policy: Any
    view: PolicyView
    metadata: dict[str, Any]
    sha256: str


def save_policy(
    path: str | os.PathLike[str], policy: SteeringNetwork, view: PolicyView, metadata: Mapping[str, Any]
) -> str:
    """Write a policy file atomically and return its hash. The code of a user's ``file.py:Class`` is copied into a folder beside it.

    Args:
        path: Target, by convention ``*.safetensors``.
        view: Conversion of camera images to the network's input.
        metadata: JSON values: training settings, data, measured errors.

    Raises:
        PolicyFileError: The network does not come from `Architecture.build`.
    """
    settings = _network_settings(policy)
    # Copies, because the file stores each tensor of tied weights.
    weights = {name: value.detach().cpu().contiguous().clone() for name, value in policy.state_dict().items()}
    header = {
        "format": FILE_FORMAT,
        "network": _canonical(settings),
        "view": _canonical(view.to_dict()),
        "metadata": _canonical(dict(metadata)),
    }
    digest = _digest(weights, header)
    for name, content in policy.code_files.items():
        write_atomically(_code_folder(Path(path), policy.code_sha256) / name, content)
    write_tensors(path, "torch", weights, {**header, "sha256": digest})
    return digest


def copy_policy(source: Path, target: Path) -> None:
    """Copy a policy file, and the code of its architecture if it has some."""
    code = _settings(_checked(source, None)[0]).get("code", "")
    if code and (folder := _code_folder(source, code)).is_dir():
        for file in folder.rglob("*.py"):
            write_atomically(_code_folder(target, code) / file.relative_to(folder), file.read_bytes())
    write_atomically(target, source.read_bytes())


def architecture_of(policy: Any) -> Architecture:
    """Architecture and settings of a network that is trained here.

    Raises:
        PolicyFileError: The network is not trained here, or its user's class was constructed directly.
    """
    made_by = type(policy)
    if isinstance(policy, SteeringNetwork):
        built_in = [name for name, row in ARCHITECTURES.items() if row.is_class(made_by)]
        if reference := next(iter(built_in), policy.reference):
            return Architecture(reference, plain_values(policy.configuration))
    raise PolicyFileError(
        f"expected a network of a known architecture, got a {made_by.__name__}; make it with "
        "Architecture('file.py:Class').build(goal_size, max_steering_rad) of advnerf_core.policies.architecture"
    )


def load_policy(path: str | os.PathLike[str], expected_sha256: str | None = None) -> LoadedPolicy:
    """Read a policy file and check its hash against its content and, if given, against ``expected_sha256``.

    A file of a user's architecture names its code, which lies beside it. The code runs only if its hash matches the policy file.

    Raises:
        PolicyFileError: The file is missing, damaged or another policy, or its architecture's code is missing or has changed.
    """
    header, weights, digest = _checked(Path(path), expected_sha256)
    policy = _built(_settings(header), Path(path))
    dtype = next((each.dtype for each in weights.values() if each.is_floating_point()), torch.float32)
    policy = policy.to(dtype)
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        raise PolicyFileError(
            f"expected weights of a {type(policy).__name__} in {path}, got others ({' '.join(str(error).split()):.200}); train again"
        ) from error
    policy.eval().requires_grad_(False)
    return LoadedPolicy(policy, _view(header), json.loads(header["metadata"]), digest)


def policy_sha256(path: str | os.PathLike[str]) -> str:
    """Hash of a policy file, checked against its content. The network is not built, so no user's code is run."""
    return _checked(Path(path), None)[2]


def described_file(path: str | os.PathLike[str]) -> tuple[dict[str, Any], PolicyView, str]:
    """Settings of the network, view and hash of a policy file. The network is not built, so no user's code is run."""
    header, _, digest = _checked(Path(path), None)
    return {"architecture": PILOTNET, **_settings(header)}, _view(header), digest


def _checked(path: Path, expected_sha256: str | None) -> tuple[dict[str, str], dict[str, Tensor], str]:
    header, weights = _read(path)
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
    return header, weights, digest


def _network_settings(policy: SteeringNetwork) -> dict[str, Any]:
    """Settings of the network for the file. PilotNet's keep the layout of existing files."""
    architecture = architecture_of(policy)
    common = {"goal_size": policy.goal_size, "max_steering_rad": policy.max_steering_rad}
    if architecture.name == PILOTNET:
        return {**common, **architecture.configuration}
    named = {
        "architecture": short_name(architecture.name),
        "configuration": dict(architecture.configuration),
    }
    return {**common, **named, **({"code": policy.code_sha256} if policy.code_sha256 else {})}


def _built(settings: dict[str, Any], path: Path) -> SteeringNetwork:
    goal_size, bound_rad = settings.pop("goal_size"), settings.pop("max_steering_rad")
    name, code = settings.pop("architecture", PILOTNET), settings.pop("code", "")
    configuration = settings.pop("configuration", settings)
    if code:
        name = _verified(name, code, path)
    return Architecture(name, configuration).build(goal_size, bound_rad)


def _verified(name: str, code: str, path: Path) -> str:
    """The reference of a user's architecture, whose code has a given hash."""
    if is_file_reference(name):
        file_name, _, attribute = name.rpartition(":")
        file = _code_folder(path.absolute(), code) / file_name
        where, found = f"{file}:{attribute}", file_sha256(file) if file.is_file() else ""
        cure = f"copy {file.parent.name}/ along with the policy file, unchanged"
    else:
        where, found = name, code_sha256(name, ARCHITECTURES, GROUP)
        cure = f"install the package that brings the architecture {name}, in the version of the training"
    if found != code:
        got = f"hash {found[:12]}" if found else "none"
        raise PolicyFileError(
            f"expected the code of the policy {path} at {where} with hash {code[:12]}, got {got}; {cure}"
        )
    print(f"{path}: runs {where} (sha256 {code[:12]})", file=sys.stderr)
    return where


def _code_folder(policy_file: Path, code: str) -> Path:
    return policy_file.parent / f"{_CODE_FOLDER}{code[:12]}"


def _settings(header: Mapping[str, str]) -> dict[str, Any]:
    """Settings of the network."""
    settings: dict[str, Any] = json.loads(header["network"])
    return settings


def _view(header: Mapping[str, str]) -> PolicyView:
    return PolicyView.from_dict(json.loads(header["view"]))


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        header, weights = read_tensors(path, "torch")
    except FileNotFoundError as error:
        raise PolicyFileError(
            f"expected a policy file at {path}, found none: train a policy first"
        ) from error
    except (OSError, ValueError) as error:
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
