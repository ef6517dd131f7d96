"""The declaration of a policy file: in a YAML file beside it, or embedded in the file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from advnerf_core.documents import parse_json, read_yaml
from advnerf_core.errors import ConfigError
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.tensors import UINT8, TensorInfo

# Metadata key of the declaration in an ONNX file.
ONNX_METADATA_KEY = "advnerf_policy"
# Suffix of a declaration beside a file.
DECLARATION_SUFFIX = ".policy.yaml"


def declaration_beside(path: Path, embedded: str | None, inputs: Sequence[TensorInfo] = ()) -> PolicyContract:
    """The declaration of a file, which must exist; see `find_declaration`.

    Raises:
        PolicyContractError: The declaration is missing or wrong.
    """
    if (found := find_declaration(path, embedded, inputs)) is not None:
        return found
    raise PolicyContractError(
        f"{path} says nothing about its colours, range and unit; write {path.name}{DECLARATION_SUFFIX} beside it: `advnerf policy check {path}` "
        "prints one"
    )


def find_declaration(
    path: Path, embedded: str | None, inputs: Sequence[TensorInfo] = ()
) -> PolicyContract | None:
    """The declaration of a file: the YAML file ``<path>.policy.yaml`` if it exists, else the embedded one; None without one.

    Args:
        embedded: Embedded JSON; None or empty without.
        inputs: The file's inputs: eight-bit elements determine the range of values.

    Raises:
        PolicyContractError: The declaration is wrong.
    """
    implied: dict[str, Any] = {"value_max": 255.0} if any(each.kind == UINT8 for each in inputs) else {}
    beside = path.with_name(path.name + DECLARATION_SUFFIX)
    try:
        if beside.is_file():
            return PolicyContract.from_dict(read_yaml(beside).data, str(beside), **implied)
        if embedded:
            return PolicyContract.from_dict(parse_json(embedded, str(path)), str(path), **implied)
    except PolicyContractError:
        raise
    except ConfigError as error:
        raise PolicyContractError(f"cannot read the declaration of {path}: {error}") from error
    return None
