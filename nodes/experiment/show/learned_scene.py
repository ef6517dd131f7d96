"""The learned scene of an experiment of any kind: its file, and its fidelity on held-out views of the driving camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import write_image
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.data.views import PosedImages
from advnerf_core.files import write_json
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.metrics import psnr, ssim
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import load_hash, load_renderer
from nodes.experiment.show.context import Experiment
from nodes.runtime.progress import Report

HELD_OUT = "held_out"  # the captured set that is held out from learning
FIDELITY = "fidelity.json"  # comparison of the learned scene with it
VIEWS = "views"  # folder of both, side by side


def scene_file(experiment: Experiment) -> Path:
    """File of the trained scene."""
    return experiment.given_scene or experiment.stage_folder("scene") / "scene.safetensors"


def baked_file(experiment: Experiment) -> Path:
    """File of the baked scene, if any."""
    return experiment.stage_folder("bake") / "baked.safetensors"


def load_field(experiment: Experiment) -> FieldRenderer | SplatRenderer:
    """The trained scene itself in the colours of the driving camera, or the splat."""
    return load_renderer(scene_file(experiment))


def load_background(experiment: Experiment) -> FieldRenderer | SplatRenderer | BakedScene:
    """The trained scene in the colours of the driving camera, fast if it was baked."""
    file = baked_file(experiment)
    return BakedScene.load(file) if file.exists() else load_field(experiment)


def scene_sha256(experiment: Experiment) -> str:
    """Content hash of the trained scene."""
    return load_hash(scene_file(experiment))


def compare_views(experiment: Experiment, begin: float, report: Report) -> None:
    """Write ``fidelity.json`` and pictures of true and learned views into the scene's folder; ``begin`` is the share of the stage before.

    PSNR and SSIM are taken at the camera's size and at the policy's: there the field's own render against the resized image.
    """
    folder, view, renderer = experiment.stage_folder("scene"), experiment.view, load_field(experiment)
    listed = captured(experiment, HELD_OUT)
    views, rows = listed.load(), []
    for index, (real, pose) in enumerate(zip(views.rgb, views.T_world_from_camera, strict=True)):
        report(begin + (1 - begin) * index / len(views.rgb), f"held-out view {index + 1}")
        full = renderer.render(pose[None], views.pinholes[index])[0][0].numpy()
        small = renderer.render(pose[None], view.pinhole)[0][0].numpy()
        seen = view.image(real)
        row: dict[str, Any] = {
            "label": listed.frames[index].path.name,
            "psnr_full_db": psnr(full, real / 255.0),
            "psnr_policy_db": psnr(small, seen / 255.0),
            "ssim_full": ssim(full, real / 255.0),
            "ssim_policy": ssim(small, seen / 255.0),
        }
        for name, image in (("real", real), ("surrogate", _pixels(full))):
            write_image(folder / VIEWS / f"{index:03d}_{name}.png", image)
        rows.append(row)
    means = {key: float(np.mean([row[key] for row in rows])) for key in ("psnr_full_db", "psnr_policy_db")}
    write_json(folder / FIDELITY, {"mean": means, "views": rows})


def view_pictures(experiment: Experiment, index: int) -> dict[str, NDArray[np.uint8]]:
    """A held-out view at the camera's size, ``real`` and ``surrogate``, drawn again: a reference build stores no pictures of it."""
    frame = captured(experiment, HELD_OUT).frames[index]
    real, pinhole = load_image(frame)
    full = load_field(experiment).render(frame.T_world_from_camera[None], pinhole)[0][0].numpy()
    return {"real": real, "surrogate": _pixels(full)}


def captured(experiment: Experiment, name: str) -> PosedImages:
    """A set of the capture stage by its name, such as `HELD_OUT`."""
    return load_transforms(experiment.stage_folder("capture") / name, require_all=True)


def _pixels(image: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.round(255 * image).astype(np.uint8)
