"""Policies as exported programs (``torch.export``, ``*.pt2``): network without its source, differentiable."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advnerf_core.policies.contract import PolicyContract, PolicyContractError, declaration_beside
from advnerf_core.policies.onnx_policy import example_inputs

METADATA_FILE = "advnerf_policy.json"
_LARGEST_BATCH = 65536


def load_program(path: Path) -> tuple[Callable[..., Tensor], PolicyContract, str]:
    """Network, declaration and hash of an exported program.

    Raises:
        PolicyContractError: It is missing, no exported program, carries pickled objects, or has no declaration.
    """
    content = _checked_content(path)
    extra = {METADATA_FILE: ""}
    try:
        program = torch.export.load(path, extra_files=extra)
        module = program.module()
    except Exception as error:  # a damaged archive ends in any of a dozen exceptions
        reason = " ".join(str(error).split())
        raise PolicyContractError(
            f"expected an exported program in {path}, got {reason:.200}; export it again"
        ) from error
    contract = declaration_beside(path, _text(extra[METADATA_FILE]))
    if not contract.stateless:
        raise PolicyContractError(f"expected a stateless policy in {path}, got one declared otherwise")
    for parameter in module.parameters():
        parameter.requires_grad_(False)

    def network(images: Tensor, goals: Tensor | None = None) -> Tensor:
        output: Tensor = module(images) if goals is None else module(images, goals)
        return output

    return network, contract, hashlib.sha256(content + contract.to_json().encode()).hexdigest()


def export_program(network: Any, contract: PolicyContract, path: Path) -> None:
    """Write a stateless network with its declaration as an exported program, whole or not at all."""
    if not contract.stateless:
        raise PolicyContractError(
            "expected a stateless policy, got one with memory: write a factory for it instead"
        )
    examples, _ = example_inputs(contract)
    batch = torch.export.Dim("batch", min=1, max=_LARGEST_BATCH)
    try:
        program = torch.export.export(network, examples, dynamic_shapes=tuple({0: batch} for _ in examples))
    except Exception as error:  # the exporter and the network raise what they like
        reason = " ".join(str(error).split())
        raise PolicyContractError(
            f"the network cannot be exported ({type(error).__name__}: {reason:.160}); name its factory instead of a file"
        ) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.tmp.pt2")
    try:
        torch.export.save(program, partial, extra_files={METADATA_FILE: contract.to_json()})
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _checked_content(path: Path) -> bytes:
    """The file's bytes, after a look for pickled objects: torch would unpickle them, which runs what a stranger wrote."""
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                if problem := _unsafe(name, archive.read(name)):
                    raise PolicyContractError(f"{path} carries {problem}, which can run code: refused")
        return path.read_bytes()
    except (OSError, zipfile.BadZipFile, ValueError, AttributeError) as error:
        if isinstance(error, PolicyContractError):
            raise
        raise PolicyContractError(f"expected an exported program (.pt2) at {path}, got: {error}") from error


def _unsafe(name: str, content: bytes) -> str:
    """What in a member of the archive could run code; empty if nothing."""
    if name.endswith(("weights_config.json", "constants_config.json")):
        entries = json.loads(content).get("config", {})
        return next(
            (f"the pickled value {key}" for key, entry in entries.items() if entry.get("use_pickle")), ""
        )
    if "custom_obj" in name or "opaque_obj" in name:
        return f"the object {name}"
    if name.endswith(".pt"):
        try:
            # What this accepts, torch.export.load reads the same way; what it refuses would be unpickled there.
            torch.load(BytesIO(content), weights_only=True)
        except Exception as error:
            return f"{name}, which is more than tensors ({type(error).__name__})"
    return ""


def _text(content: Any) -> str:
    return content.decode() if isinstance(content, bytes) else str(content)
