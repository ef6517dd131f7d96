"""Dataclasses as plain data (JSON types), and back from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import ConfigDict, PlainValidator, TypeAdapter, ValidationError

from advnerf_core.geometry import Array


def _numbers(value: Any) -> Array:
    return np.array(value, dtype=np.float64)


Numbers = Annotated[Array, PlainValidator(_numbers)]
"""An array of a dataclass that plain data hold as lists."""


_Data = TypeVar("_Data", bound="PlainData")


class PlainData:
    """A dataclass with plain data in its fields: numbers, texts, `Numbers`, tuples, mappings, and other such dataclasses."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    _refusal: ClassVar[type[Exception]] = ValueError

    def to_dict(self) -> dict[str, Any]:
        """Plain data (JSON types) from which :meth:`from_dict` rebuilds it."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_dict(cls: type[_Data], data: Mapping[str, Any]) -> _Data:
        """Rebuild it from :meth:`to_dict`.

        Raises:
            ValueError: The data does not fit; the class may name its own error.
        """
        try:
            found: _Data = _adapter(cls).validate_python(data)  # type: ignore[arg-type]
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            what = ".".join(map(str, problem["loc"])) or "the whole"
            names = ", ".join(field.name for field in fields(cls))  # type: ignore[arg-type]
            raise cls._refusal(
                f"expected {names}, as {cls.__name__}.to_dict writes them; got something else: {what}: {problem['msg']}"
            ) from error
        return found


@lru_cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    return TypeAdapter(model)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return np.asarray(value, dtype=np.float64).tolist()
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value
