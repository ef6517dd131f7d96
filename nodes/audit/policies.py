"""The policy of an audit, as experiments take it; a file without a declaration gets one, of what it says itself and what is asked."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from advnerf_core.documents import dump_yaml, parse_yaml
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.declaration import DECLARATION_SUFFIX
from advnerf_core.policies.guess import Question, guess_contract
from advnerf_core.policies.load import is_address, is_code, load_any_policy
from nodes.runtime.errors import ConfigError

FOLDER = "policy"
Say = Callable[[str], None]
# What files that say nothing mean more often than not; said aloud, so that a wrong one is seen.
_USUAL = {"colour_space": "RGB", "value_max": 1.0, "output_unit": "normalised", "positive": "left"}


def policy_at(
    given: str,
    camera: Pinhole | None,
    largest_rad: float | None,
    declared: Sequence[str],
    folder: Path,
    say: Say,
) -> tuple[str, Pinhole | None]:
    """How experiments name the policy, and the camera that it was made for.

    Args:
        given: As the user named it.
        camera: The driving camera of the place, for a policy that names none; None where only the world knows.
        largest_rad: Largest wheel angle of the car, which a normalised output of 1 means [rad].
        declared: ``key=value`` texts of a declaration.
        folder: Of the audit; gets a copy of the file with its declaration, if it has none.
        say: Told what is taken for granted.

    Returns:
        The name, and the camera; None for a driver behind a socket.

    Raises:
        ConfigError: The file is not there.
        AdvnerfError: It cannot be loaded.
    """
    if is_address(given):
        return given, None
    if is_code(given):
        return given, load_any_policy(given).view.camera
    file = Path(given)
    if not file.is_file():
        raise ConfigError(
            f"expected a policy file, package.module:factory or grpc://HOST:PORT, got {given}, which is not there"
        )
    contract, questions = guess_contract(file)
    if not questions and not declared:
        return str(file.resolve()), contract.view.camera
    return _declared(file, contract, questions, camera, largest_rad, declared, folder, say)


def _declared(
    file: Path,
    contract: PolicyContract,
    questions: Sequence[Question],
    camera: Pinhole | None,
    largest_rad: float | None,
    declared: Sequence[str],
    folder: Path,
    say: Say,
) -> tuple[str, Pinhole | None]:
    values, answers = contract.to_dict(), _read(declared)
    if any(question.key == "view" for question in questions):
        values["view"] = _whole_picture(values["view"], camera)
    for question in questions:
        if question.key in answers or question.key == "view":
            continue
        values[question.key] = _answered(question, _USUAL.get(question.key, values.get(question.key)), say)
    values |= answers
    if values.get("output_unit") == "normalised" and values.get("full_steering_rad") is None:
        if largest_rad is None:
            raise ConfigError(
                "expected --declare full_steering_rad=RAD, the wheel angle at an output of 1, as the car is not known yet"
            )
        values["full_steering_rad"] = largest_rad
    checked = PolicyContract.from_dict(values, "--declare")
    target = folder / FOLDER / file.name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)
    text = dump_yaml(checked.to_dict())
    write_atomically(target.with_name(target.name + DECLARATION_SUFFIX), text)
    return str(target.resolve()), checked.view.camera


def _read(declared: Sequence[str]) -> dict[str, Any]:
    found = {}
    for text in declared:
        key, separator, value = text.partition("=")
        if not separator:
            raise ConfigError(f"--declare {text}: expected KEY=VALUE, for example --declare colour_space=BGR")
        found[key.strip()] = parse_yaml(value, f"--declare {text}").data
    return found


def _whole_picture(view: Mapping[str, Any], camera: Pinhole | None) -> dict[str, Any]:
    """The view of a policy that sees the whole picture of the place's camera in its own size."""
    if camera is None:
        return dict(view)
    whole = {"camera": asdict(camera), "crop_top_px": 0, "crop_height_px": camera.height}
    return {**view, **whole}


def _answered(question: Question, usual: Any, say: Say) -> Any:
    """What a person at the terminal says; without one, what is usual, said aloud."""
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
