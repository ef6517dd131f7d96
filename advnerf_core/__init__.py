"""The science of advnerf: fields, rendering, driving, attacks and reports. No sockets, no devices, no torch on import."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

# Read when torch is loaded. Threads of torch that wait by spinning keep a core from our kernels.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__all__ = [
    "Ackermann",
    "AdjointResult",
    "AdvnerfError",
    "Arc",
    "AttackFile",
    "AttackProblem",
    "Dubins",
    "Dynamics",
    "FieldRenderer",
    "Line",
    "Motion",
    "Path",
    "Pinhole",
    "PolicyContract",
    "PolicyView",
    "PosedImages",
    "Rendered",
    "Rollout",
    "SceneFieldConfig",
    "SearchResult",
    "Sensor",
    "Surrogate",
    "TrainConfig",
    "VoxelGridObject",
    "adapt",
    "adjoint_gradient",
    "camera_mount",
    "cube_face_object",
    "draw_start_states",
    "drive",
    "evaluate",
    "face_texture",
    "gradient_attack",
    "load_any_policy",
    "load_attack",
    "load_object",
    "load_transforms",
    "make_transform",
    "random_search",
    "save_attack",
    "save_scene",
    "train_scene",
]

if TYPE_CHECKING:
    from advnerf_core.attack.adjoint import AdjointResult, adjoint_gradient, evaluate
    from advnerf_core.attack.artifact import AttackFile, face_texture, load_attack, save_attack
    from advnerf_core.attack.problem import AttackProblem, Sensor
    from advnerf_core.attack.search.gradient import gradient_attack
    from advnerf_core.attack.search.random_search import random_search
    from advnerf_core.attack.search.record import SearchResult
    from advnerf_core.attack.search.search import draw_start_states
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.data.views import PosedImages
    from advnerf_core.driving.dynamics import Ackermann, Dubins, Dynamics, Motion
    from advnerf_core.driving.path import Arc, Line, Path
    from advnerf_core.driving.rollout import Rollout, drive
    from advnerf_core.errors import AdvnerfError
    from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
    from advnerf_core.geometry import Pinhole, camera_mount, make_transform
    from advnerf_core.objects.voxel.model import load_object
    from advnerf_core.policies.adapter import adapt
    from advnerf_core.policies.contract import PolicyContract
    from advnerf_core.policies.load import load_any_policy
    from advnerf_core.policies.view import PolicyView
    from advnerf_core.scene.field import SceneFieldConfig, save_scene
    from advnerf_core.scene.render_field import FieldRenderer
    from advnerf_core.scene.surrogate import Rendered, Surrogate
    from advnerf_core.scene.train import train_scene
    from advnerf_core.scene.train_config import TrainConfig
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "advnerf_core.attack.adjoint": "AdjointResult adjoint_gradient evaluate",
            "advnerf_core.attack.artifact": "AttackFile face_texture load_attack save_attack",
            "advnerf_core.attack.problem": "AttackProblem Sensor",
            "advnerf_core.attack.search.random_search": "random_search",
            "advnerf_core.attack.search.gradient": "gradient_attack",
            "advnerf_core.attack.search.record": "SearchResult",
            "advnerf_core.attack.search.search": "draw_start_states",
            "advnerf_core.data.transforms": "load_transforms",
            "advnerf_core.data.views": "PosedImages",
            "advnerf_core.driving.dynamics": "Ackermann Dubins Dynamics Motion",
            "advnerf_core.driving.path": "Arc Line Path",
            "advnerf_core.driving.rollout": "Rollout drive",
            "advnerf_core.errors": "AdvnerfError",
            "advnerf_core.fields.voxel_grid": "VoxelGridObject cube_face_object",
            "advnerf_core.geometry": "Pinhole camera_mount make_transform",
            "advnerf_core.objects.voxel.model": "load_object",
            "advnerf_core.policies.adapter": "adapt",
            "advnerf_core.policies.contract": "PolicyContract",
            "advnerf_core.policies.load": "load_any_policy",
            "advnerf_core.policies.view": "PolicyView",
            "advnerf_core.scene.field": "SceneFieldConfig save_scene",
            "advnerf_core.scene.render_field": "FieldRenderer",
            "advnerf_core.scene.surrogate": "Rendered Surrogate",
            "advnerf_core.scene.train": "train_scene",
            "advnerf_core.scene.train_config": "TrainConfig",
        },
    )
