"""Packed attack files: the published form of an attack, a fortieth of its size, from which the attack file is restored to the bit.

It leaves out derived data, the displayed texture of a face. Theta that is exact in half precision is kept in half precision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKED_FORMAT = "advnerf-attack-2-packed"
_TEXTURE = "face.texture"
Tensors = dict[str, NDArray[Any]]
Texture = Callable[[NDArray[Any]], NDArray[np.uint8]]


def packed(tensors: Mapping[str, NDArray[Any]], carried_by: int | None, texture: Texture) -> Tensors:
    """The tensors of an attack file without the derived ones.

    Args:
        tensors: Tensors of the attack file.
        carried_by: Number of the object with the face; None without a face.
        texture: Computes the displayed texture ``[H, W, 3]`` from theta ``[N, N, 3]``.
    """
    found = {name: _narrowed(each) if name.endswith(".theta") else each for name, each in tensors.items()}
    if carried_by is not None and np.array_equal(tensors[_TEXTURE], texture(tensors[_theta(carried_by)])):
        del found[_TEXTURE]
    return found


def unpacked(tensors: Mapping[str, NDArray[Any]], carried_by: int | None, texture: Texture) -> Tensors:
    """Restore the tensors of the attack file; see `packed`.

    Raises:
        KeyError: The theta of the face is missing.
    """
    found = {
        name: each.astype(np.float32) if name.endswith(".theta") else each for name, each in tensors.items()
    }
    if carried_by is not None and _TEXTURE not in found:
        found[_TEXTURE] = texture(found[_theta(carried_by)])
    return found


def _theta(number: int) -> str:
    return f"objects.{number}.theta"


def _narrowed(theta: NDArray[Any]) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        half = theta.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), theta) else theta
