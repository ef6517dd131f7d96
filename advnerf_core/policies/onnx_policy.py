"""ONNX policies: run by ONNX Runtime without torch, written from a torch policy. To an attack they are black boxes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.inputs import InputFileError, InputFiles
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.declaration import ONNX_METADATA_KEY, declaration_beside
from advnerf_core.policies.file_network import FileNetwork
from advnerf_core.policies.tensors import UINT8, TensorInfo, chosen_tensors

_KINDS = {"tensor(float)": "float32", "tensor(double)": "float64"}
_OPSET = 17


class OnnxNetwork(FileNetwork):
    """An ONNX file as a function of arrays.

    Attributes:
        contract: Declaration of the network, with ``differentiable`` always False.
        sha256: Hash of the file, of its external weight files, and of the declaration.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._session, files = opened_onnx(path, threads)
        inputs, outputs, embedded = read_tensors(self._session)
        self.contract = _black_box(declaration_beside(path, embedded, inputs), path)
        self.sha256 = files.sha256(self.contract.to_json())
        super().__init__(chosen_tensors(inputs, outputs, self.contract, path))
        self._kinds = {each.name: each.kind for each in inputs}

    def run(self, feeds: Mapping[str, Any], outputs: list[str]) -> list[Any]:
        """Outputs of ONNX Runtime; half precision becomes single."""
        arrays = {name: _as_kind(feed, self._kinds[name]) for name, feed in feeds.items()}
        found = [np.asarray(each) for each in self._session.run(outputs, arrays)]
        return [each.astype(np.float32) if each.dtype == np.float16 else each for each in found]


class TensorNetwork:
    """An `OnnxNetwork` as a function of tensors, without a gradient."""

    training = False

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network
        self.tensors = network.tensors

    def initial_memory(self, batch: int) -> Any:
        """Memory ``[B, K]`` before the first image, of a file with states."""
        import torch

        return torch.from_numpy(self._network.initial_memory(batch))

    def __call__(self, images: Any, *others: Any) -> Any:
        """Raw output of the network for tensors, and the next memory if it has one."""
        given = [
            None if each is None else np.asarray(each.detach().cpu().numpy()) for each in (images, *others)
        ]
        answers = self._network(*given)
        if isinstance(answers, tuple):
            return tuple(_tensor(each, images) for each in answers)
        return _tensor(answers, images)


def _tensor(array: NDArray[Any], images: Any) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(array)).to(images)


def opened_onnx(path: Path, threads: int = 1) -> tuple[Any, InputFiles]:
    """A session of ONNX Runtime, and its source files.

    Raises:
        PolicyContractError: They cannot be read, or are not an ONNX model.
    """
    import onnxruntime

    files = read_onnx(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = threads
    options.log_severity_level = 3
    try:
        return _session(files, options), files
    except Exception as error:  # its exceptions have no common base
        reason = " ".join(str(error).split())
        raise PolicyContractError(
            f"expected an ONNX model in {path}, got {reason:.200}; export it again"
        ) from error


def read_tensors(session: Any) -> tuple[list[TensorInfo], list[TensorInfo], str | None]:
    """Inputs and outputs of a session, and the embedded declaration; None without one."""
    embedded = session.get_modelmeta().custom_metadata_map.get(ONNX_METADATA_KEY)
    return (
        [_info(each) for each in session.get_inputs()],
        [_info(each) for each in session.get_outputs()],
        embedded,
    )


def export_onnx(network: Any, contract: PolicyContract, path: Path) -> None:
    """Write a torch network with its declaration as an ONNX file, whole or not at all.

    Args:
        network: The network behind the declaration, in eval mode.
        contract: Declaration of the network, which is embedded in the file's metadata.
    """
    import onnx
    import torch

    from advnerf_core.policies.exportable import exportable

    given = exportable(network, contract)
    names = [*given.inputs, *given.outputs]
    buffer: Any = BytesIO()  # the exporter's signature allows file names only
    with warnings.catch_warnings(), torch.no_grad():
        # It announces its successor, which needs another package, and logs every check of a shape.
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                given.network,
                given.examples,
                buffer,
                dynamo=False,
                opset_version=_OPSET,
                input_names=given.inputs,
                output_names=given.outputs,
                dynamic_axes={name: {0: "B"} for name in names},
            )
        except Exception as error:  # the exporter and the network may raise anything
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"the network cannot be written as ONNX ({type(error).__name__}: {reason:.160}); keep its gradient in a .pt2 file, "
                "or replace the layer"
            ) from error
    model = onnx.load_from_string(buffer.getvalue())
    declared = given.declared("memory", "next_memory")
    model.metadata_props.add(key=ONNX_METADATA_KEY, value=_black_box(declared, path).to_json())
    onnx.checker.check_model(model)
    write_atomically(path, model.SerializeToString())


def _black_box(contract: PolicyContract, path: Path) -> PolicyContract:
    require_states(contract, path)
    return PolicyContract(**{**vars(contract), "differentiable": False})


def require_states(contract: PolicyContract, path: Path) -> None:
    """Raise for a file that is declared to have a memory without naming its inputs and outputs."""
    if not contract.stateless and not contract.states:
        raise PolicyContractError(
            f"{path}: stateless: expected true, or states: the inputs and outputs that carry the memory; got false without states"
        )


def read_onnx(path: Path) -> InputFiles:
    """An ONNX file and its external weight files, which must lie beside it.

    Raises:
        PolicyContractError: One of them is missing, or is in another folder.
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
    """Names of the files with external tensors of an ONNX model."""
    if b"location" not in content:  # the key of their names; most models need no second reading
        return []
    import onnx

    try:
        model = onnx.load_model_from_string(content)
    except Exception:  # protobuf's own; ONNX Runtime reports the file's problem
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
    """All tensors in a model: weights, constants of nodes, and tensors of subgraphs and functions."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for each in value if hasattr(value, "__len__") else [value]:
                yield from _tensors(each)


def _session(files: InputFiles, options: Any) -> Any:
    """An inference session from the read content; the files themselves are not opened again."""
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
