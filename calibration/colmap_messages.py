"""Messages to and from the COLMAP process, as lines of JSON. Floats keep their exact value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.lens import Lens
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole
from calibration.photo_model import (
    FoundCamera,
    LeftOut,
    Model,
    PhotoSource,
    ReconstructionError,
    Registered,
    SfmConfig,
)

Job = tuple[Path, tuple[PhotoSource, ...], Path, SfmConfig]


def pack_job(root: Path, sources: Sequence[PhotoSource], work: Path, config: SfmConfig) -> bytes:
    """Encode a job as one line."""
    return _line(
        {
            "root": str(root),
            "sources": [asdict(s) for s in sources],
            "work": str(work),
            "config": asdict(config),
        }
    )


def unpack_job(line: bytes) -> Job:
    """Decode a job to the arguments of `pack_job`."""
    told = json.loads(line)
    sources = tuple(
        PhotoSource(
            s["camera_id"],
            tuple(s["images"]),
            s["ordered"],
            None if s["pinhole"] is None else Pinhole(**s["pinhole"]),
            _lens(s["lens"]),
        )
        for s in told["sources"]
    )
    return Path(told["root"]), sources, Path(told["work"]), SfmConfig(**told["config"])


def pack_progress(share: float, text: str) -> bytes:
    """Encode progress as one line."""
    return _line({"progress": [share, text]})


def pack_error(error: AdvnerfError | OSError) -> bytes:
    """Encode an error as one line."""
    return _line({"error": str(error), "of_colmap": isinstance(error, ReconstructionError)})


def pack_model(model: Model) -> bytes:
    """Encode a model as one line."""
    images = [{**asdict(i), "T_world_from_camera": i.T_world_from_camera.tolist()} for i in model.images]
    return _line(
        {
            "images": images,
            "left_out": [asdict(i) for i in model.left_out],
            "points": model.points.tolist(),
            "reprojection_error_px": model.reprojection_error_px,
            "parts": model.parts,
            "cameras": [asdict(c) for c in model.cameras],
        }
    )


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
    return Model(
        images=tuple(
            Registered(
                **{**_optics(i), "T_world_from_camera": np.array(i["T_world_from_camera"], dtype=np.float64)}
            )
            for i in told["images"]
        ),
        left_out=tuple(LeftOut(**i) for i in told["left_out"]),
        points=np.array(told["points"], dtype=np.float64).reshape(-1, 3),
        reprojection_error_px=told["reprojection_error_px"],
        parts=told["parts"],
        cameras=tuple(FoundCamera(**_optics(c)) for c in told["cameras"]),
    )


def _optics(told: Mapping[str, Any]) -> dict[str, Any]:
    return {**told, "pinhole": Pinhole(**told["pinhole"]), "lens": _lens(told["lens"])}


def _lens(told: Mapping[str, Any]) -> Lens:
    return Lens(tuple(told["coefficients"]), told["fisheye"])


def _line(told: Mapping[str, Any]) -> bytes:
    return json.dumps(told).encode() + b"\n"
