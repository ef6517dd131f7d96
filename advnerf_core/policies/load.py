"""Loads policies of any origin. Imports torch only for policies that need it.

A policy is named by a file (``.safetensors``: a network that was trained here; ``.onnx``; ``.pt2``) or by ``package.module:factory``, a
function without arguments that returns ``adapt(network, contract)``.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from advnerf_core.code_files import module_sha256
from advnerf_core.inputs import InputFiles
from advnerf_core.plugins import FAILURES, in_one_line, torch_left_as_it_is
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.declaration import DECLARATION_SUFFIX
from advnerf_core.policies.driver import Driver
from advnerf_core.run_module import search_working_folder_last

if TYPE_CHECKING:
    from advnerf_core.policies.adapter import AdaptedPolicy
    from advnerf_core.policies.policy_file import LoadedPolicy

_FACTORY = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
POLICY_SUFFIXES = (".safetensors", ".onnx", ".pt2")
_FUNCTION_IN_FILE = re.compile(r"(.*/)?(?P<module>[^/]*)\.py:(?P<name>.*)")
_ADDRESS = re.compile(r"grpcs?://")
_RUNS_CODE = (
    "such files run code when they are opened: write a .pt2 with torch.export.save or a .onnx with torch.onnx.export, "
    "or load it in a factory that you trust"
)
# What makes a policy of files that people have first.
_OTHER_FILES = {
    **dict.fromkeys((".pt", ".pth", ".ckpt", ".bin", ".pkl"), _RUNS_CODE),
    **dict.fromkeys((".h5", ".keras", ".pb", ".tflite"), "convert it with tf2onnx"),
    **dict.fromkeys((".engine", ".trt", ".plan"), "it is for one GPU: give the .onnx that it was built from"),
    ".py": "name a function in it: package.module:factory",
}
# Another processor's last digits are a thousandth of this.
_ANSWER_RAD = 1e-4
_CODE_OF_MODULES: WeakKeyDictionary[ModuleType, str] = WeakKeyDictionary()


def is_factory(spec: str | os.PathLike[str]) -> bool:
    """Whether a policy is named as ``package.module:factory`` and not as a file."""
    return _FACTORY.fullmatch(str(spec)) is not None and _FUNCTION_IN_FILE.fullmatch(str(spec)) is None


def is_code(spec: str | os.PathLike[str]) -> bool:
    """Whether a policy is named as code or a service, and not as a file."""
    return is_factory(spec) or is_address(spec)


def is_address(spec: str | os.PathLike[str]) -> bool:
    """Whether a policy is named as the address of a driver: ``grpc://HOST:PORT``, or ``grpcs://`` by TLS."""
    return _ADDRESS.match(str(spec)) is not None


def wrong_policy(spec: str | os.PathLike[str]) -> str:
    """What to say of a name that is none of a policy, or of a file that is not there."""
    path = Path(spec)
    ending = path.suffix.lower()
    advice = f"; {_OTHER_FILES.get(ending, 'correct the name')}"
    if in_file := _FUNCTION_IN_FILE.fullmatch(str(spec)):
        advice = f"; write {in_file['module']}:{in_file['name']}, and start in the folder that holds the file, or put it beside the experiment file"
    if ending in POLICY_SUFFIXES:
        advice = ", which is not there" if path.suffix == ending else "; write its ending in small letters"
    return f"expected a policy file ({', '.join(POLICY_SUFFIXES)}), package.module:factory or grpc://HOST:PORT, got {spec}{advice}"


def load_any_policy(spec: str | os.PathLike[str], expected_sha256: str | None = None) -> LoadedPolicy:
    """A policy ready for a rollout or an attack: frozen, in eval mode, with its view and hash.

    Raises:
        AdvnerfError: The policy cannot be loaded, is in training mode, or is not the expected one.
    """
    from advnerf_core.policies.policy_file import LoadedPolicy, load_policy

    suffix = "" if is_factory(spec) else Path(spec).suffix
    if suffix == ".safetensors":
        return load_policy(spec, expected_sha256)
    policy, sha256 = load_adapted(spec)
    if policy.training:
        raise PolicyContractError(
            f"{spec} is in training mode; call .eval() on the network before it is adapted"
        )
    if expected_sha256 is not None and sha256 != expected_sha256:
        raise PolicyContractError(
            f"expected the policy {expected_sha256}, got {sha256} from {spec}; correct the hash"
        )
    policy.requires_grad_(False)
    known = {"origin": str(spec), **({"not_fixed": policy.identity} if policy.identity else {})}
    return LoadedPolicy(policy, policy.contract.view, known, sha256)


def load_adapted(spec: str | os.PathLike[str]) -> tuple[AdaptedPolicy, str]:
    """The network with its declaration in its author's mode, and its hash, for the conformance test."""
    from advnerf_core.policies.adapter import AdaptedPolicy

    if is_factory(spec):
        return _from_factory(str(spec))
    if is_address(spec):
        raise PolicyContractError(
            f"expected a policy that is loaded, got the driver {spec}: it must be told its camera and car, which an experiment does (victims)"
        )
    path = Path(spec)
    if path.suffix == ".onnx":
        from advnerf_core.policies.onnx_policy import OnnxNetwork, TensorNetwork

        network = OnnxNetwork(path)
        return AdaptedPolicy(TensorNetwork(network), network.contract), network.sha256
    if path.suffix == ".pt2":
        from advnerf_core.policies.exported_policy import load_program

        program, contract, sha256 = load_program(path)
        return AdaptedPolicy(program, contract), sha256
    if path.suffix == ".safetensors":
        from advnerf_core.policies.policy_file import load_policy

        loaded = load_policy(path)
        return AdaptedPolicy(
            loaded.policy, PolicyContract(loaded.view, goal_size=loaded.policy.goal_size)
        ), loaded.sha256
    raise PolicyContractError(wrong_policy(spec))


def described_policy(spec: str | os.PathLike[str]) -> tuple[AdaptedPolicy, str, dict[str, str]]:
    """Declaration, hash and architecture of a policy, without calling it; no code of a ``.safetensors`` file is run."""
    if is_factory(spec) or Path(spec).suffix != ".safetensors":
        return *load_adapted(spec), {}
    from advnerf_core.policies.adapter import AdaptedPolicy
    from advnerf_core.policies.policy_file import described_file

    settings, view, sha256 = described_file(spec)
    contract = PolicyContract(view, goal_size=settings["goal_size"])
    network: dict[str, str] = {
        name: str(settings[name]) for name in ("architecture", "code") if name in settings
    }
    own = settings.get("configuration", {"hidden": settings.get("hidden")})
    network |= {name: str(value) for name, value in own.items()}
    return AdaptedPolicy(_not_built, contract), sha256, network


def _not_built(*images: Any) -> Any:
    raise PolicyContractError("expected a policy that was loaded, got one that was only described")


def _from_factory(spec: str) -> tuple[AdaptedPolicy, str]:
    from advnerf_core.policies.adapter import AdaptedPolicy

    module_name, _, name = spec.partition(":")
    search_working_folder_last()
    try:
        with torch_left_as_it_is():
            module, code = _imported(module_name)
        factory = getattr(module, name)
    except (ImportError, AttributeError) as error:
        raise PolicyContractError(
            f"cannot find {spec}: {error}; start in the folder that holds it"
        ) from error
    except FAILURES as error:
        raise PolicyContractError(f"{spec}: {module_name} cannot be loaded: {in_one_line(error)}") from error
    try:
        with torch_left_as_it_is():
            policy = factory()
    except FAILURES as error:
        if isinstance(error, PolicyContractError):
            raise
        raise PolicyContractError(f"{spec}() failed: {in_one_line(error)}") from error
    if not isinstance(policy, AdaptedPolicy):
        raise PolicyContractError(
            f"expected {spec}() to return adapt(network, PolicyContract(...)), got {type(policy).__name__}"
        )
    return policy, _factory_sha256(spec, policy, code)


def _imported(name: str) -> tuple[ModuleType, str]:
    """A module, and the hash of its code at its first import: a file that is edited later changes nothing in this process."""
    if (module := sys.modules.get(name)) is None or module not in _CODE_OF_MODULES:
        importlib.invalidate_caches()
        code = module_sha256(name)
        module = importlib.import_module(name)
        _CODE_OF_MODULES[module] = code
    return module, _CODE_OF_MODULES[module]


def _factory_sha256(spec: str, policy: AdaptedPolicy, code: str) -> str:
    """Hash of weights, declaration, code and answers to fixed pictures; for a queried program also of its identity."""
    digest = hashlib.sha256(f"{spec}\0{policy.contract.to_json()}\0{code}".encode())
    for name, tensor in sorted(policy.state_dict().items()):
        array = tensor.detach().cpu().contiguous().numpy()
        digest.update(f"{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        digest.update(array.tobytes())
    if policy.identity:
        digest.update(f"{policy.identity}\0{policy.answers()}".encode())
    else:
        digest.update(_answers(policy).encode())
    return digest.hexdigest()


def _answers(policy: AdaptedPolicy) -> str:
    """What a policy steers at fixed pictures: what it computes with files of its own is in no weights that torch knows.

    Nothing of a policy that draws lots, whose hash would differ each time, or of one that fails at these pictures.
    """
    try:
        first, again = (policy.answers(_ANSWER_RAD) for _ in range(2))
    except FAILURES:
        return ""
    return str(first) if first == again else ""


def source_sha256(spec: str | os.PathLike[str]) -> str:
    """Hash of a policy's source, without loading it: of a file's content, or of a factory's code.

    It changes whenever the hash of `load_any_policy` does, except for what a factory reads: weights, or a program that it queries.

    Raises:
        PolicyContractError: A file is missing, or the module of a factory cannot be found.
    """
    if is_address(spec):
        return hashlib.sha256(str(spec).encode()).hexdigest()
    if not is_code(spec):
        return policy_file_sha256(Path(spec))
    search_working_folder_last()
    try:
        return module_sha256(str(spec).partition(":")[0])
    except ImportError as error:
        raise PolicyContractError(
            f"cannot find {spec}: {error}; start in the folder that holds it"
        ) from error


def policy_file_sha256(path: Path) -> str:
    """Hash of a policy file on disk, with its external weight files and the declaration beside it; nothing is loaded.

    Raises:
        PolicyContractError: One of them is missing, or is in another folder.
    """
    files, declared = _files_of(path)
    return files.sha256(declared.decode())


def policy_files(path: Path) -> dict[str, bytes]:
    """Content of a policy file, of its external weight files and of the declaration beside it, by their names in its folder.

    Raises:
        PolicyContractError: One of them is missing, or is in another folder.
    """
    files, declared = _files_of(path)
    beside = {path.name + DECLARATION_SUFFIX: declared} if declared else {}
    return {path.name: files.content, **files.others, **beside}


def _files_of(path: Path) -> tuple[InputFiles, bytes]:
    from advnerf_core.policies.onnx_policy import read_onnx

    beside = path.with_name(path.name + DECLARATION_SUFFIX)
    declared = beside.read_bytes() if beside.is_file() else b""
    return read_onnx(path) if path.suffix == ".onnx" else InputFiles(path), declared


def load_driver(spec: str | os.PathLike[str], expected_sha256: str | None = None) -> Driver:
    """A policy for the live node, on one thread; an ONNX file needs no torch."""
    if not is_factory(spec) and Path(spec).suffix == ".onnx":
        from advnerf_core.policies.onnx_policy import OnnxNetwork

        network = OnnxNetwork(Path(spec))
        driver = Driver(network, network.contract, network.sha256)
        if expected_sha256 not in (None, driver.sha256):
            raise PolicyContractError(
                f"expected the policy {expected_sha256}, got {driver.sha256} from {spec}"
            )
        return driver
    import torch

    from advnerf_core.policies.torch_driver import TorchDriver

    torch.set_num_threads(1)
    return TorchDriver(load_any_policy(spec, expected_sha256))
