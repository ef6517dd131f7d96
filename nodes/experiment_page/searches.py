"""Current results of the searches of a run folder, read from their state files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import COLOURS, MESH_TEXTURE, AttackFileError, face_texture, load_attack
from advnerf_core.data.image_files import encoded
from advnerf_core.documents import read_json
from advnerf_core.files import read_tensors

ATTACK, SEARCHED, STATE = "attack.safetensors", "surrogate.json", "state.safetensors"
# Spaces whose theta are colours. The others, places and shapes, have no texture to show.
_COLOURED = (COLOURS, MESH_TEXTURE)
_PICTURE_PX, _MOST_OBJECTS = 192, 6

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Search:
    """A running or finished search.

    Attributes:
        values: The objective's value of each evaluation, in its unit; for ``cte`` the total CTE [m].
        version: Changes whenever the result changes.
        finished: Whether it has ended.
    """

    values: tuple[float, ...]
    version: str
    finished: bool

    @property
    def best(self) -> int:
        """Index of the best evaluation, the first of equals."""
        return max(range(len(self.values)), key=lambda index: (self.values[index], -index))


def read_search(folder: Path, state: str = STATE) -> Search | None:
    """The search of a cell's folder, while it runs from the state file of this name; None before it has results."""
    for name, read in ((SEARCHED, _finished), (state, _running)):
        try:
            changed_ns = (folder / name).stat().st_mtime_ns
            found = read(folder / name, changed_ns)
        except (OSError, ValueError, KeyError, TypeError):
            continue  # missing, or replaced while it was read
        if found:
            return Search(found, f"{changed_ns:x}", name == SEARCHED)
    return None


@lru_cache(maxsize=512)
def _finished(file: Path, changed_ns: int) -> tuple[float, ...]:
    del changed_ns  # a changed file is another entry of the cache
    found = read_json(file)
    return tuple(map(_rounded, found.get("curve_value", found["curve_total_cte_m"])))


@lru_cache(maxsize=64)
def _running(file: Path, changed_ns: int) -> tuple[float, ...]:
    del changed_ns
    history = json.loads(read_tensors(file, "numpy", ())[0]["history"])
    # State files from before there were other objectives have no values.
    each = [row.get("values", row["protocol_cte_m"]) for row in history]
    return tuple(_rounded(sum(values) / len(values)) for values in each)


def _rounded(value: float) -> float:
    return float(f"{float(value):.5g}")


def has_texture(space: str) -> bool:
    """Whether a search of this space, by its name in an experiment file, finds colours."""
    return space in _COLOURED


def texture_png(folder: Path) -> bytes | None:
    """Texture of a cell's best evaluation, as a PNG file; None before the first one."""
    try:
        pictures = (
            _attack_pictures(folder / ATTACK)
            if (folder / ATTACK).exists()
            else [_picture(read_tensors(folder / STATE, "numpy", ["best_theta"])[1]["best_theta"])]
        )
    except (OSError, ValueError, KeyError, AttackFileError):
        return None
    small = [_square(each) for each in pictures[:_MOST_OBJECTS]]
    return encoded(np.concatenate(small, axis=1), ".png") if small else None


def _attack_pictures(file: Path) -> list[Pixels]:
    attack = load_attack(file)
    if attack.face is not None:
        return [np.asarray(attack.face.texture, np.uint8)]
    return [_picture(each.theta) for each in attack.objects]


def _picture(theta: NDArray[np.float32]) -> Pixels:
    """Colours before squashing as a picture: a grid unchanged, free voxels or texels ``[K, 3]`` in rows of a square."""
    if theta.ndim != 3:
        flat = theta.reshape(-1, 3)
        side = int(np.ceil(np.sqrt(len(flat))))
        grid = np.zeros((side * side, 3), np.float32)
        grid[: len(flat)] = flat
        theta = grid.reshape(side, side, 3)
    return face_texture(theta)


def _square(picture: Pixels) -> Pixels:
    return np.asarray(cv2.resize(picture, (_PICTURE_PX, _PICTURE_PX), interpolation=cv2.INTER_AREA), np.uint8)
