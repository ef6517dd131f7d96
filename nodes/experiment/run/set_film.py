"""The film of a published set: drives past the plain object, the strongest baseline and the attack, side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.clips import read_clip
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.page import film_of, filmed_of, maps_of
from advnerf_core.report.evidence.results import read_evidence
from advnerf_core.report.evidence.verifying.layout import SET
from nodes.experiment.show.context import Experiment

MOST_BYTES = 180_000
_WIDTH_PX, _FRAME_MS, _QUALITIES = 760, 200, (70, 50, 35, 20, 10, 5)
_EVERY = 2  # frames, at ten frames a second


def write_film(experiment: Experiment, published: Path) -> Path | None:
    """Write the film of `filmed_of` beside the page; None without a test, claim or contrast, or if a clip is not on this machine."""
    data = read_json(published / SET)
    clips = _clips(experiment, published, filmed_of(data)) if maps_of(data) else []
    if not clips or not all(clip.exists() for clip in clips):
        return None
    first, *others = _side_by_side([read_clip(clip)[::_EVERY] for clip in clips])
    animated: dict[str, Any] = {"save_all": True, "append_images": others, "duration": _FRAME_MS, "loop": 0}
    for quality in _QUALITIES:
        film = io.BytesIO()
        first.save(film, "WEBP", quality=quality, method=6, **animated)
        if film.tell() <= MOST_BYTES:
            break
    target = published.parent / film_of(published.name)
    write_atomically(target, film.getvalue())
    return target


def _clips(experiment: Experiment, published: Path, test: Mapping[str, Any]) -> list[Path]:
    which, evidence = test["test"], read_evidence(published)
    searched = [
        evidence.searches((which["scenario"], which["victim"], method))[0]
        for method in (NONE, test["baseline"], which["method"])
        if method
    ]
    return [experiment.folder / "cells" / str(cell.extra.get("clip", "")) for cell in searched]


def _side_by_side(clips: Sequence[NDArray[np.uint8]]) -> list[Image.Image]:
    """Frames with all clips; a finished one holds its last frame."""
    count = max(len(clip) for clip in clips)
    rows = [np.concatenate([clip[min(at, len(clip) - 1)] for clip in clips], axis=1) for at in range(count)]
    height = round(rows[0].shape[0] * _WIDTH_PX / rows[0].shape[1])
    return [Image.fromarray(row).resize((_WIDTH_PX, height), Image.Resampling.LANCZOS) for row in rows]
