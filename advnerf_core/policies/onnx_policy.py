"""ONNX policies: run by ONNX Runtime without torch, written from a torch policy. To an attack they are black boxes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.inputs import InputFileError, InputFiles
from advnerf_core.policies.contract import (
    ONNX_METADATA_KEY,
    PolicyContract,
    PolicyContractError,
    declaration_beside,
)
from advnerf_core.policies.tensors import UINT8, TensorInfo, Tensors, chosen_tensors

_KINDS = {"tensor(float)": "float32", "tensor(double)": "float64"}
_OPSET = 17


class OnnxNetwork:
    """An ONNX file as a function of arrays.

    Attributes:
        contract: Its declaration, with ``differentiable`` False whatever it says.
        sha256: Hash of the file, of files that it keeps weights in, and of the declaration.
        tensors: Its inputs and outputs, and what each is used for.
    """

    training = False

    def __init__(self, path: Path, threads: int = 1) -> None:
        import onnxruntime

        files = read_onnx(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session = _session(files, options)
        except Exception as error:  # its exceptions share no base of their own
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"expected an ONNX model in {path}, got {reason:.200}; export it again"
            ) from error
        inputs, outputs = (
            [_info(each) for each in some]
            for some in (self._session.get_inputs(), self._session.get_outputs())
        )
        embedded = self._session.get_modelmeta().custom_metadata_map.get(ONNX_METADATA_KEY)
        # Elements of eight bits leave one range.
        implied = {"value_max": 255.0} if any(each.kind == UINT8 for each in inputs) else {}
        self.contract = _black_box(declaration_beside(path, embedded, **implied), path)
        self.sha256 = files.sha256(self.contract.to_json())
        self.tensors: Tensors = chosen_tensors(inputs, outputs, self.contract, path)
        self._one_by_one = (self.tensors.image.shape or ())[:1] == (1,)

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
        wanted = [each for each in (self.tensors.image, self.tensors.goal) if each is not None]
        arrays = {each.name: _as_kind(feed, each.kind) for each, feed in zip(wanted, feeds, strict=True)}
        try:
            return np.asarray(self._session.run([self.tensors.steering.name], arrays)[0])
        except Exception as error:
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"expected the ONNX model to take {[list(array.shape) for array in arrays.values()]}, but it wants "
                f"{', '.join(map(str, wanted))}; correct size and layout in the declaration ({reason:.120})"
            ) from error


class TensorNetwork:
    """An `OnnxNetwork` as a function of tensors, without a gradient."""

    training = False

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network
        self.tensors = network.tensors

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


def read_onnx(path: Path) -> InputFiles:
    """An ONNX file and the files that it keeps weights in, which must lie beside it.

    Raises:
        PolicyContractError: One of them is missing, or lies elsewhere.
    """
    try:
        files = InputFiles(path)
        for name in _external_files(files.content):
            files.read(name)
    except OSError as error:
        raise PolicyContractError(f"expected an ONNX policy at {path}, got: {error.strerror}") from error
    except InputFileError as error:
        raise PolicyContractError(str(error)) from error
    return files


def _external_files(content: bytes) -> list[str]:
    """Names of the files in which tensors of an ONNX model lie."""
    if b"location" not in content:  # the key that names them; most models need no second reading
        return []
    import onnx

    try:
        model = onnx.load_model_from_string(content)
    except Exception:  # protobuf's own; ONNX Runtime says what is wrong with the file
        return []
    return sorted(
        {
            entry.value
            for tensor in _tensors(model)
            for entry in tensor.external_data
            if entry.key == "location"
        }
    )


def _tensors(message: Any) -> Iterator[Any]:
    """All tensors in a model: weights, constants of nodes, and those of subgraphs and functions."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for each in value if hasattr(value, "__len__") else [value]:
                yield from _tensors(each)


def _session(files: InputFiles, options: Any) -> Any:
    """An inference session of what was read; the files themselves are not opened again."""
    import onnxruntime

    providers = ["CPUExecutionProvider"]
    if not files.others:
        return onnxruntime.InferenceSession(files.content, options, providers=providers)
    with TemporaryDirectory(prefix="advnerf_onnx_") as folder:
        model = files.path.resolve().name
        for name, content in {**files.others, model: files.content}.items():
            copy = Path(folder, name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)
        return onnxruntime.InferenceSession(Path(folder, model), options, providers=providers)


def _info(tensor: Any) -> TensorInfo:
    kind = tensor.type.removeprefix("tensor(").removesuffix(")")
    return TensorInfo(tensor.name, tuple(tensor.shape), _KINDS.get(tensor.type, kind))


def _as_kind(array: NDArray[Any], kind: str) -> NDArray[Any]:
    if kind == UINT8:
        array = np.clip(np.rint(array), 0, 255)
    return np.ascontiguousarray(array, dtype=kind)
