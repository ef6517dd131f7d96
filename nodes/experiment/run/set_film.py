"""The film of a published set: drives past the plain object, the strongest baseline and the attack, side by side."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.clips import read_clip
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.page import film_of, filmed_of, maps_of
from advnerf_core.report.evidence.results import read_evidence
from advnerf_core.report.evidence.verifying.layout import SET
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.show.context import Experiment

MOST_BYTES = 180_000
_WIDTH_PX, _FRAME_MS, _QUALITIES = 760, 200, (70, 50, 35, 20, 10, 5)
_EVERY = 2  # frames, at ten frames a second


def write_film(experiment: Experiment, published: Path) -> Path | None:
    """Write the film of `filmed_of` beside the page; None without a test, claim or contrast, or if a clip is not on this machine."""
    data = read_json(published / SET)
    if not maps_of(data):
        return None
    filmed, evidence, files = filmed_of(data), read_evidence(published), []
    which = filmed["test"]
    for method in filter(None, (NONE, filmed["baseline"], which["method"])):
        cell = evidence.searches((which["scenario"], which["victim"], method))[0]
        files.append(experiment.folder / CELLS / str(cell.extra.get("clip", "")))
    if not all(file.exists() for file in files):
        return None
    # A finished clip holds its last frame.
    clips = [read_clip(file)[::_EVERY] for file in files]
    count = max(len(clip) for clip in clips)
    rows = [np.concatenate([clip[min(at, len(clip) - 1)] for clip in clips], axis=1) for at in range(count)]
    size = _WIDTH_PX, round(rows[0].shape[0] * _WIDTH_PX / rows[0].shape[1])
    first, *others = (Image.fromarray(row).resize(size, Image.Resampling.LANCZOS) for row in rows)
    animated: dict[str, Any] = {"save_all": True, "append_images": others, "duration": _FRAME_MS, "loop": 0}
    for quality in _QUALITIES:
        film = io.BytesIO()
        first.save(film, "WEBP", quality=quality, method=6, **animated)
        if film.tell() <= MOST_BYTES:
            break
    target = published.parent / film_of(published.name)
    write_atomically(target, film.getvalue())
    return target
