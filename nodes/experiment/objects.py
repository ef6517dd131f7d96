"""Stage object: the attacked face as a voxel-grid object in the learned scene, and what it looks like plain."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.data.image_files import write_image
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array, Pinhole, make_transform, planar_pose
from advnerf_core.scene.surrogate import BackgroundRenderer, Surrogate
from nodes.experiment.context import Experiment
from nodes.experiment.images import as_uint8
from nodes.experiment.learned_scene import load_background
from nodes.runtime.progress import Report

# The deployed face lies this far in front of the board or monitor that carries it, so that it is never inside it.
FACE_OFFSET_M = 0.01


def attacked_object(experiment: Experiment) -> VoxelGridObject:
    """The cube's deployed face on the lab's board or monitor, plain."""
    wanted = experiment.config.object
    T_world_from_object = experiment.panel.T_world_from_face @ make_transform(
        np.eye(3), [FACE_OFFSET_M, 0.0, 0.0]
    )
    return cube_face_object(experiment.face_m, wanted.resolution, wanted.plain_rgb, T_world_from_object)


def surrogate_of(
    experiment: Experiment, objects: Sequence[VoxelGridObject], background: BackgroundRenderer | None = None
) -> Surrogate:
    """The learned scene as the policy's camera sees it, with objects; ``background`` if it is loaded already."""
    render = background or load_background(experiment)
    return Surrogate(render, experiment.view.pinhole, experiment.camera.mount, objects)


def last_result_kept(render: BackgroundRenderer) -> BackgroundRenderer:
    """The same renderer, which does not render twice in a row for the same poses (plain and textured views of one state)."""
    last: list[tuple[Array, Pinhole, Any]] = []

    def remembered(poses: Array, pinhole: Pinhole) -> Any:
        if not (last and last[0][1] == pinhole and np.array_equal(last[0][0], poses)):
            last[:] = [(poses.copy(), pinhole, render(poses, pinhole))]
        return last[0][2]

    return remembered


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write the object's geometry, and a preview of the start view without and with its plain face."""
    report(0.0, "placing the object")
    field = attacked_object(experiment)
    description = {
        "resolution": experiment.config.object.resolution,
        "plain_rgb": list(experiment.config.object.plain_rgb),
        "size_m": experiment.face_m,
        "T_world_from_object": np.asarray(field.T_world_from_object).tolist(),
        "subject": experiment.target.subject,
        "corners_in_subject_m": [list(corner) for corner in experiment.target.corners_in_subject_m],
        "free_parameters": 3 * field.free_count,
    }
    write_atomically(folder / "object.json", json.dumps(description, indent=1) + "\n")
    for name, image in _previews(experiment, field).items():
        write_image(folder / f"{name}.png", image)


def _previews(experiment: Experiment, field: VoxelGridObject) -> dict[str, Any]:
    pose = planar_pose(*experiment.room.start_pose) @ experiment.camera.mount
    surrogate = surrogate_of(experiment, [field])
    theta = surrogate.initial_theta(torch.Generator().manual_seed(0))
    plain = surrogate.render(pose[None], theta).images[0]
    bare = surrogate_of(experiment, []).render(pose[None], None).images[0]
    return {"start_view": as_uint8(bare), "start_view_with_plain_face": as_uint8(plain)}
