"""The policy of an audit in the form of experiments; a file without a declaration gets one, from its content and the user's answers."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from advnerf_core.documents import dump_yaml, parse_yaml
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from advnerf_core.inputs import InputFiles
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.declaration import DECLARATION_SUFFIX
from advnerf_core.policies.guess import Question, guess_contract
from advnerf_core.policies.load import is_address, is_code, load_any_policy, wrong_policy
from advnerf_core.policies.onnx_policy import read_onnx
from nodes.runtime.config import typed_values
from nodes.runtime.errors import ConfigError

FOLDER = "policy"
Say = Callable[[str], None]
Driven = Callable[[], tuple[Pinhole, float]]
# Most common meanings of files without a declaration; printed, so that a wrong one is noticed.
_USUAL = {"colour_space": "RGB", "value_max": 1.0, "output_unit": "normalised", "positive": "left"}


def resolve_policy(
    given: str, driven: Driven, declared: Sequence[str], folder: Path, say: Say
) -> tuple[str, Pinhole | None]:
    """The name for experiments of the policy by the user's name, and the policy's camera; None for a driver behind a socket.

    Args:
        given: File, ``package.module:factory`` or address.
        driven: Asked only about a file without a declaration: gives the place's driving camera, which the file is taken to see, and the largest
            wheel angle of the car, which a normalised output of 1 stands for [rad].
        declared: ``key=value`` texts of a declaration.
        folder: Folder of the audit, for a copy of the file with its declaration, if it has none.
        say: Called with each assumption.

    Raises:
        ConfigError: The file does not exist.
        AdvnerfError: The policy cannot be loaded.
    """
    if is_address(given):
        return given, None
    if is_code(given):
        return given, load_any_policy(given).view.camera
    file = Path(given)
    if not file.is_file():
        raise ConfigError(wrong_policy(given))
    contract, questions = guess_contract(file)
    if questions or declared:
        answers = typed_values("--declare", declared, "colour_space=BGR")
        contract = _completed(contract, questions, answers, driven, say)
        target = folder / FOLDER / file.name
        _copy(file, target)
        write_atomically(target.with_name(target.name + DECLARATION_SUFFIX), dump_yaml(contract.to_dict()))
        file = target
    return str(file.resolve()), contract.view.camera


def _copy(file: Path, target: Path) -> None:
    """Copy a policy file, an ONNX file together with the files of its weights."""
    files = read_onnx(file) if file.suffix == ".onnx" else InputFiles(file)
    for name, content in {target.name: files.content, **files.others}.items():
        write_atomically(target.parent / name, content)


def _completed(
    guessed: PolicyContract, questions: Sequence[Question], answers: dict[str, Any], driven: Driven, say: Say
) -> PolicyContract:
    """The contract with declared, answered and usual values."""
    values = guessed.to_dict()
    for question in questions:
        if question.key == "view":
            values["view"] = _whole_picture(values["view"], driven()[0])
        elif question.key not in answers:
            usual = _USUAL.get(question.key, values.get(question.key))
            values[question.key] = _answered(question, usual, say)
    values |= answers
    if values.get("output_unit") == "normalised" and values.get("full_steering_rad") is None:
        values["full_steering_rad"] = driven()[1]
    return PolicyContract.from_dict(values, "--declare")


def _whole_picture(view: Mapping[str, Any], camera: Pinhole) -> dict[str, Any]:
    """The view of a policy that sees the whole picture of the place's camera in the policy's image size."""
    whole = {"camera": asdict(camera), "crop_top_px": 0, "crop_height_px": camera.height}
    return {**view, **whole}


def _answered(question: Question, usual: Any, say: Say) -> Any:
    """The answer of a user at the terminal; without one, the usual value, which is printed."""
    if sys.stdin.isatty():
        text = typer.prompt(
            f"{question.text} ({' or '.join(question.choices)})" if question.choices else question.text,
            default=usual,
        )
        return parse_yaml(str(text), question.key).data
    say(
        f"the policy file does not say: {question.text} Taken: {question.key}={usual} (--declare {question.key}=... for another)"
    )
    return usual
