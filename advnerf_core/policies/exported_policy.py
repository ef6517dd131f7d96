"""Policies as exported programs (``torch.export``, ``*.pt2``): network without its source, differentiable."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from advnerf_core.inputs import InputFiles
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.declaration import declaration_beside
from advnerf_core.policies.exportable import exportable
from advnerf_core.policies.file_network import FileNetwork
from advnerf_core.policies.onnx_policy import require_states
from advnerf_core.policies.tensors import UINT8, TensorInfo, Tensors, chosen_tensors

METADATA_FILE = "advnerf_policy.json"
_LARGEST_BATCH = 65536


class ProgramNetwork(FileNetwork):
    """An exported program as a function of tensors.

    Args:
        program: Program from ``torch.export.load``.
        tensors: Inputs and outputs of the program with their uses.
    """

    def __init__(self, program: Any, tensors: Tensors) -> None:
        super().__init__(tensors)
        self._module = program.module()
        self._dtypes = {each.name: getattr(torch, each.kind) for each in tensors.inputs}
        self._outputs = [each.name for each in tensors.outputs]
        for parameter in self._module.parameters():
            parameter.requires_grad_(False)

    def initial_memory(self, batch: int) -> Tensor:
        """Memory ``[B, K]`` before the first image, of a program with states."""
        return torch.from_numpy(super().initial_memory(batch))

    def run(self, feeds: Mapping[str, Tensor], outputs: list[str]) -> list[Tensor]:
        """Outputs of the program, in the type of the images."""
        found = tree_leaves(
            self._module(*(_as_dtype(feeds[name], kind) for name, kind in self._dtypes.items()))
        )
        dtype = feeds[self.tensors.image.name].dtype
        return [found[self._outputs.index(name)].to(dtype) for name in outputs]


def load_program(path: Path) -> tuple[ProgramNetwork, PolicyContract, str]:
    """Network, declaration and hash of an exported program.

    Raises:
        PolicyContractError: The file is missing, not an exported program, has pickled objects, or lacks a fitting declaration.
    """
    program, files, embedded = opened_program(path)
    inputs, outputs = program_tensors(program)
    contract = declaration_beside(path, embedded, inputs)
    require_states(contract, path)
    tensors = chosen_tensors(inputs, outputs, contract, path)
    if tensors.image.kind == UINT8:
        contract = replace(contract, differentiable=False)  # no gradient passes through whole numbers
    network = ProgramNetwork(program, tensors)
    return network, contract, files.sha256(contract.to_json())


def opened_program(path: Path) -> tuple[Any, InputFiles, str]:
    """An exported program, its source file, and the embedded declaration; empty without one.

    Raises:
        PolicyContractError: The file is missing, not an exported program, or has pickled objects.
    """
    files = _checked_file(path)
    extra = {METADATA_FILE: ""}
    try:
        program = torch.export.load(BytesIO(files.content), extra_files=extra)
        program_tensors(program)
    except Exception as error:  # a damaged archive raises any of a dozen exceptions
        reason = " ".join(str(error).split())
        raise PolicyContractError(
            f"expected an exported program in {path}, got {reason:.200}; export it again"
        ) from error
    return program, files, _text(extra[METADATA_FILE])


def _as_dtype(given: Tensor, dtype: torch.dtype) -> Tensor:
    return (given.round().clamp(0, 255) if dtype == torch.uint8 else given).to(dtype)


def program_tensors(program: Any) -> tuple[list[TensorInfo], list[TensorInfo]]:
    """Inputs and outputs of a program."""
    nodes, signature = {node.name: node for node in program.graph.nodes}, program.graph_signature

    def info(name: Any) -> TensorInfo:
        value = nodes[name].meta["val"] if name in nodes else None
        if not isinstance(value, Tensor):
            return TensorInfo(str(name), None, type(value).__name__)
        shape = tuple(int(size) if isinstance(size, int) else str(size) for size in value.shape)
        return TensorInfo(name, shape, str(value.dtype).removeprefix("torch."))

    return [info(name) for name in signature.user_inputs], [info(name) for name in signature.user_outputs]


def export_program(network: Any, contract: PolicyContract, path: Path) -> None:
    """Write a network with its declaration as an exported program, whole or not at all."""
    given = exportable(network, contract)
    batch = torch.export.Dim("batch", min=1, max=_LARGEST_BATCH)
    try:
        shapes = tuple({0: batch} for _ in given.examples)
        program = torch.export.export(given.network, given.examples, dynamic_shapes=shapes)
    except Exception as error:  # the exporter and the network may raise anything
        reason = " ".join(str(error).split())
        raise PolicyContractError(
            f"the network cannot be exported ({type(error).__name__}: {reason:.160}); name its factory instead of a file"
        ) from error
    signature = program.graph_signature
    declared = given.declared(
        signature.user_inputs[-1], signature.user_outputs[-1], signature.user_outputs[0]
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.tmp.pt2")
    try:
        torch.export.save(program, partial, extra_files={METADATA_FILE: declared.to_json()})
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _checked_file(path: Path) -> InputFiles:
    """The file's content, checked for pickled objects: torch would unpickle them, which runs the code of strangers."""
    try:
        files = InputFiles(path)
        with zipfile.ZipFile(BytesIO(files.content)) as archive:
            for name in archive.namelist():
                if problem := _unsafe(name, archive.read(name)):
                    raise PolicyContractError(f"{path} carries {problem}, which can run code: refused")
        return files
    except (OSError, zipfile.BadZipFile, ValueError, AttributeError) as error:
        if isinstance(error, PolicyContractError):
            raise
        raise PolicyContractError(f"expected an exported program (.pt2) at {path}, got: {error}") from error


def _unsafe(name: str, content: bytes) -> str:
    """The part of a member of the archive that could run code; empty if none."""
    if name.endswith(("weights_config.json", "constants_config.json")):
        entries = json.loads(content).get("config", {})
        return next(
            (f"the pickled value {key}" for key, entry in entries.items() if entry.get("use_pickle")), ""
        )
    if "custom_obj" in name or "opaque_obj" in name:
        return f"the object {name}"
    if name.endswith(".pt"):
        try:
            # Members accepted here are read by torch.export.load in the same way; rejected ones would be unpickled there.
            torch.load(BytesIO(content), weights_only=True)
        except Exception as error:
            return f"{name}, which is more than tensors ({type(error).__name__})"
    return ""


def _text(content: Any) -> str:
    return content.decode() if isinstance(content, bytes) else str(content)
