"""Messages to and from the COLMAP process, as lines of JSON. Floats keep their exact value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.plain import PlainData
from calibration.photo_model import Model, PhotoSource, ReconstructionError, SfmConfig


@dataclass(frozen=True)
class Job(PlainData):
    """Job of the process; arguments as in `calibration.structure_from_motion.reconstruct`."""

    root: str
    sources: tuple[PhotoSource, ...]
    work: str
    config: SfmConfig


def pack_job(root: Path, sources: Sequence[PhotoSource], work: Path, config: SfmConfig) -> bytes:
    """Encode a job as one line."""
    return _line(Job(str(root), tuple(sources), str(work), config).to_dict())


def unpack_job(line: bytes) -> tuple[Path, tuple[PhotoSource, ...], Path, SfmConfig]:
    """Decode a job to the arguments of `pack_job`."""
    job = Job.from_dict(json.loads(line))
    return Path(job.root), job.sources, Path(job.work), job.config


def pack_progress(share: float, text: str) -> bytes:
    """Encode progress as one line."""
    return _line({"progress": [share, text]})


def pack_error(error: AdvnerfError | OSError) -> bytes:
    """Encode an error as one line."""
    return _line({"error": str(error), "of_colmap": isinstance(error, ReconstructionError)})


def pack_model(model: Model) -> bytes:
    """Encode a model as one line."""
    return _line(model.to_dict())


def unpack_answer(line: bytes) -> tuple[float, str] | Model:
    """Decode progress or the model.

    Raises:
        AdvnerfError: The process could not do its job, for this reason.
    """
    told = json.loads(line)
    if "error" in told:
        raise (ReconstructionError if told["of_colmap"] else AdvnerfError)(told["error"])
    if "progress" in told:
        share, text = told["progress"]
        return float(share), str(text)
    model = Model.from_dict(told)
    return replace(model, points=model.points.reshape(-1, 3))


def _line(told: Mapping[str, Any]) -> bytes:
    return json.dumps(told).encode() + b"\n"
