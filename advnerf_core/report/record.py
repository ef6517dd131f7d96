"""The base of the report's records: what an array field is, and how a record checks itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import PlainSerializer, PlainValidator


def as_floats(value: ArrayLike) -> NDArray[np.float64]:
    """Numbers as a float64 array."""
    return np.asarray(value, dtype=np.float64)


# The annotations tell pydantic how `results.py` writes and reads an array; images stay out of the JSON.
Floats = Annotated[NDArray[np.float64], PlainValidator(as_floats), PlainSerializer(lambda a: a.tolist())]
Image = Annotated[NDArray[np.uint8], PlainValidator(np.asarray), PlainSerializer(lambda _: None)]


class Record:
    """Base of the records: numpy scalars become Python numbers, so that JSON and equality behave."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if isinstance(value, np.generic):
                object.__setattr__(self, f.name, value.item())

    def set_floats(self, name: str, *shape: int | None) -> None:
        """Store field ``name`` as finite float64 of ``shape`` (None: any length)."""
        a = as_floats(getattr(self, name))
        fits = a.ndim == len(shape) and all(
            want in (None, got) for want, got in zip(shape, a.shape, strict=True)
        )
        if not fits or not np.isfinite(a).all():
            wanted = ", ".join("n" if n is None else str(n) for n in shape)
            raise ValueError(
                f"expected {type(self).__name__}.{name} as finite numbers [{wanted}], got shape {a.shape}"
            )
        object.__setattr__(self, name, a)

    def check_choice(self, name: str, choices: Sequence[str]) -> None:
        """Raise unless field ``name`` is one of ``choices``."""
        if getattr(self, name) not in choices:
            raise ValueError(
                f"expected {type(self).__name__}.{name} to be one of {', '.join(choices)}, got {getattr(self, name)!r}"
            )

    def check_named(self, name: str) -> None:
        """Raise unless field ``name`` is a name."""
        if not getattr(self, name):
            raise ValueError(
                f"expected {type(self).__name__}.{name} to be a name, got {getattr(self, name)!r}"
            )

    def check_image(self, name: str) -> None:
        """Raise unless field ``name`` is None or an RGB image."""
        image = getattr(self, name)
        if image is not None and (image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3):
            raise ValueError(
                f"expected {type(self).__name__}.{name} as uint8 [height, width, 3], got {image.dtype} {image.shape}"
            )
