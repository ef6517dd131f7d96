"""Groups of options: a dataclass whose fields are options of every command that takes it."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_type_hints

import typer
from typer.models import CommandFunctionType

from nodes.runtime.errors import ConfigError


class CommandGroup(typer.Typer):
    """A group of commands that take dataclasses as parameters and refuse infinite numbers; see `_with_groups`."""

    def command(
        self, name: str | None = None, **settings: Any
    ) -> Callable[[CommandFunctionType], CommandFunctionType]:
        """Register a command as `typer.Typer.command` does; the function itself stays as it is."""
        register = super().command(name, **settings)

        def registered(command: CommandFunctionType) -> CommandFunctionType:
            register(_with_groups(command))
            return command

        return registered


def _with_groups(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command one option or argument for each field of its dataclass parameters.

    A field is declared as a parameter is: ``steps: Annotated[int, typer.Option(...)] = 800``. A group of fields is replaced in the place
    of its parameter, so that ``--help`` lists all in order. Infinite numbers and NaN, which Python reads as numbers, are refused with a
    `ConfigError`.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in groups:
            parameters += _parameters_of(groups[name])
        else:
            parameters.append(parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY))

    declared = {parameter.name: parameter for parameter in parameters}

    @functools.wraps(command)
    def run(**given: Any) -> Any:
        for name, value in given.items():
            _require_finite(declared[name], value)
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        return command(**given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _parameters_of(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]


def _option_of(parameter: inspect.Parameter) -> str:
    """The option as a user writes it."""
    declared = getattr(parameter.annotation, "__metadata__", ())
    # In an Annotated, typer keeps the first of the names as the default.
    names = [name for each in declared for name in (each.default, *(each.param_decls or ()))]
    usual = f"--{parameter.name.replace('_', '-')}"
    return next((name for name in names if isinstance(name, str) and name.startswith("--")), usual)


def _require_finite(parameter: inspect.Parameter, value: Any) -> None:
    values = value if isinstance(value, tuple) else (value,)
    if any(isinstance(each, float) and not math.isfinite(each) for each in values):
        option = _option_of(parameter)
        raise ConfigError(
            f"expected finite numbers for {option}, got {' '.join(map(str, values))}; correct {option}"
        )
