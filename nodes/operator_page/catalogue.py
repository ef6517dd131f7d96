"""The attacks that the operator may choose from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from advnerf_core.attack.artifact import AttackFile, AttackFileError, load_attack
from advnerf_core.data.image_files import encoded

_PICTURE_PX = 160
_SUFFIX = ".safetensors"


@dataclass(frozen=True)
class CatalogueEntry:
    """An attack that can be shown.

    Attributes:
        facts: Content for the page: name, method, seed, predicted total CTE with and without it [m].
        png: Texture of the attack, as a small picture.
    """

    attack_id: str
    file: Path
    facts: dict[str, Any]
    png: bytes


def read_catalogue(places: Iterable[Path]) -> tuple[dict[str, CatalogueEntry], list[str]]:
    """Read the attack files among files and folders.

    Args:
        places: Attack files, and folders whose attack files are read, without their subfolders.

    Returns:
        The attacks with a face, by id, and a line for each file that is left out and each folder without any.
    """
    entries: dict[str, CatalogueEntry] = {}
    left_out = list[str]()
    for place in places:
        files, told = sorted(place.glob(f"*{_SUFFIX}")) if place.is_dir() else [place], list[str]()
        for file in files:
            try:
                entry = _entry(load_attack(file), file)
            except AttackFileError as error:
                told.append(f"{file.name}: {error}")
                continue
            entries[entry.attack_id] = entry
        if place.is_dir() and len(told) == len(files):
            left_out.append(
                f"{place}: expected attack files (*{_SUFFIX}), found none; correct the folder, or name the files"
            )
        left_out += told
    return entries, left_out


def _entry(attack: AttackFile, file: Path) -> CatalogueEntry:
    texture = attack.required_face().texture
    small = cv2.resize(texture, (_PICTURE_PX, _PICTURE_PX), interpolation=cv2.INTER_AREA)
    png = encoded(np.asarray(small, np.uint8), ".png")
    clean = attack.clean_drive
    stem = file.name.removesuffix(_SUFFIX).removesuffix(".attack")
    facts = {
        "id": attack.attack_id,
        "name": file.resolve().parent.name if stem == "attack" else stem,
        "method": attack.method,
        "seed": attack.seed,
        "predicted_m": attack.predicted_total_cte_m,
        "clean_m": None if clean is None else clean.mean_total_cte_m,
    }
    return CatalogueEntry(attack.attack_id, file, facts, png)
