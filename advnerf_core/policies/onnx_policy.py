"""ONNX policies: run by ONNX Runtime without torch, written from a torch policy. To an attack they are black boxes."""

from __future__ import annotations

import hashlib
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.policies.contract import (
    ONNX_METADATA_KEY,
    PolicyContract,
    PolicyContractError,
    declaration_beside,
)

_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}
_OPSET = 17


class OnnxNetwork:
    """An ONNX file as a function of arrays.

    Args:
        path: The file.
        threads: Of one inference.

    Attributes:
        contract: Its declaration, with ``differentiable`` False whatever it says.
        sha256: Hash of file and declaration.
    """

    training = False

    def __init__(self, path: Path, threads: int = 1) -> None:
        import onnxruntime

        content = _read(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its exceptions share no base of their own
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"expected an ONNX model in {path}, got {reason:.200}; export it again"
            ) from error
        declared = declaration_beside(
            path, self._session.get_modelmeta().custom_metadata_map.get(ONNX_METADATA_KEY)
        )
        self.contract = _black_box(declared, path)
        self.sha256 = hashlib.sha256(content + self.contract.to_json().encode()).hexdigest()
        self._inputs = self._session.get_inputs()
        wanted = 1 + (self.contract.goal_size > 0)
        if len(self._inputs) != wanted:
            raise PolicyContractError(
                f"expected {wanted} inputs (images, goals) in {path}, got {self._inputs_text()}"
            )
        self._one_by_one = self._inputs[0].shape[:1] == [1]

    def __call__(self, images: NDArray[Any], goals: NDArray[Any] | None = None) -> NDArray[Any]:
        """Raw output of the network for its own kind of images ``[B, ...]``."""
        feeds = [images] if goals is None else [images, goals]
        if self._one_by_one and len(images) != 1:
            return np.concatenate(
                [self._run([feed[k : k + 1] for feed in feeds]) for k in range(len(images))]
            )
        return self._run(feeds)

    def steering_rad(self, images: NDArray[Any], goals: NDArray[Any] | None = None) -> NDArray[Any]:
        """Steering ``[B]`` [rad] of images ``[B, 3, H, W]`` RGB 0..1: the whole contract, without torch."""
        raw = self(self.contract.to_network(images), goals)
        return np.asarray(self.contract.to_steering_rad(raw, len(images)))

    def _run(self, feeds: list[NDArray[Any]]) -> NDArray[Any]:
        arrays = {
            each.name: _as_type(feed, each.type) for each, feed in zip(self._inputs, feeds, strict=True)
        }
        try:
            return np.asarray(self._session.run(None, arrays)[0])
        except Exception as error:
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"expected the ONNX model to take {[list(array.shape) for array in arrays.values()]}, but it wants "
                f"{self._inputs_text()}; correct size and layout in the declaration ({reason:.120})"
            ) from error

    def _inputs_text(self) -> str:
        return ", ".join(f"{each.name} {each.shape} {each.type}" for each in self._inputs)


class TensorNetwork:
    """An `OnnxNetwork` as a function of tensors, without a gradient."""

    training = False

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network

    def __call__(self, images: Any, goals: Any = None) -> Any:
        """Raw output of the network for tensors."""
        import torch

        raw = self._network(_array(images), None if goals is None else _array(goals))
        return torch.from_numpy(np.ascontiguousarray(raw)).to(images)


def _array(tensor: Any) -> NDArray[Any]:
    return np.asarray(tensor.detach().cpu().numpy())


def export_onnx(network: Any, contract: PolicyContract, path: Path) -> None:
    """Write a stateless torch network with its declaration as an ONNX file, whole or not at all.

    Args:
        network: The network behind the declaration, in eval mode.
        contract: Its declaration; it travels in the file's metadata.
        path: Target.
    """
    import onnx
    import torch

    if not contract.stateless:
        raise PolicyContractError("expected a stateless policy, got one with memory: an ONNX policy has none")
    examples, names = example_inputs(contract)
    buffer: Any = BytesIO()  # the exporter's signature knows names of files only
    with warnings.catch_warnings(), torch.no_grad():
        # It announces its successor, which needs another package, and remarks on every check of a shape.
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                network,
                examples,
                buffer,
                dynamo=False,
                opset_version=_OPSET,
                input_names=names,
                output_names=["steering"],
                dynamic_axes={name: {0: "B"} for name in [*names, "steering"]},
            )
        except Exception as error:  # the exporter and the network raise what they like
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"the network cannot be written as ONNX ({type(error).__name__}: {reason:.160}); keep its gradient in a .pt2 file, "
                "or replace the layer"
            ) from error
    model = onnx.load_from_string(buffer.getvalue())
    model.metadata_props.add(key=ONNX_METADATA_KEY, value=_black_box(contract, path).to_json())
    onnx.checker.check_model(model)
    write_atomically(path, model.SerializeToString())


def example_inputs(contract: PolicyContract) -> tuple[tuple[Any, ...], list[str]]:
    """Inputs of the network behind a declaration, a batch of two, and their names."""
    import torch

    images = contract.to_network(torch.rand(2, 3, *contract.size, generator=torch.Generator().manual_seed(0)))
    if contract.goal_size == 0:
        return (images,), ["images"]
    return (images, torch.zeros(2, contract.goal_size)), ["images", "goals"]


def _black_box(contract: PolicyContract, path: Path) -> PolicyContract:
    if not contract.stateless:
        raise PolicyContractError(f"expected a stateless policy in {path}, got one declared otherwise")
    return PolicyContract(**{**vars(contract), "differentiable": False})


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PolicyContractError(f"expected an ONNX policy at {path}, got: {error.strerror}") from error


def _as_type(array: NDArray[Any], kind: str) -> NDArray[Any]:
    if kind == "tensor(uint8)":
        return np.clip(np.rint(array), 0, 255).astype(np.uint8)
    if kind not in _TYPES:
        raise PolicyContractError(f"expected an input of {', '.join(_TYPES)} or tensor(uint8), got {kind}")
    return np.ascontiguousarray(array, dtype=_TYPES[kind])
