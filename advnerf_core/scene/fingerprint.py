"""Hash of a training's inputs and settings; a checkpoint can only be resumed with the same."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict

import numpy as np

from advnerf_core.data.views import ImageSet
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.train_config import TrainConfig

# Settings that older checkpoints do not have, with their neutral values.
_LATER = {"exposure": False, "decay": "exponential"}


def training_fingerprint(
    images: ImageSet, field: SceneFieldConfig, config: TrainConfig, march: MarchConfig
) -> str:
    """Hash of images and settings; 16 hexadecimal digits.

    Args:
        images: Training images.
        field: Sizes of the field.
        march: The chosen intervals, which also depend on the cameras and on the rule.
    """
    training = {**asdict(config), "march": asdict(march)}
    for name, usual in _LATER.items():
        if training[name] == usual:
            del training[name]
    digest = hashlib.sha256(json.dumps([field.to_dict(), training], sort_keys=True).encode())
    digest.update(str(images.rgb.shape).encode() + images.T_world_from_camera.tobytes())
    digest.update(images.rgb[:, ::16, ::16].tobytes())
    if images.alpha is not None and not field.learned_background:
        digest.update(images.alpha[:, ::16, ::16].tobytes())
    if images.valid is not None:
        digest.update(np.flatnonzero(images.valid).tobytes())
    return digest.hexdigest()[:16]
