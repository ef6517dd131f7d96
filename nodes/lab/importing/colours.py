"""Fits the map from the colours of a learned scene to the driving camera's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.video import thinned
from advnerf_core.data.views import ImageSet
from advnerf_core.files import refuse_overwriting
from advnerf_core.scene.colour import IDENTITY, ColourMap, fit_colour_map
from advnerf_core.scene.field import load_scene, save_scene
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.splats.scene_file import is_splat_scene
from nodes.lab.importing.errors import ImportRecordingError

# Rays with a higher transmittance have no scene colour to compare.
_LEAST_ALPHA = 0.9
_LEAST_SEEN = 0.05


@dataclass(frozen=True)
class ColourMatch:
    """A fitted colour map.

    Attributes:
        map: Map from learned colours to the driving camera's.
        before_db: PSNR against the frames without the map [dB].
        after_db: PSNR against the frames with the map [dB].
    """

    map: ColourMap
    frames: int
    before_db: float
    after_db: float


def match_colours(scene: Path, images: Path, output: Path, most: int) -> ColourMatch:
    """Fit the map to frames of the driving camera and store it in the scene file.

    Args:
        images: ``transforms.json`` of the driving camera, in the scene's world.
        output: Scene file to write, which may be the same.
        most: Largest number of frames, evenly spread.

    Raises:
        ImportRecordingError: The frames do not show the scene.
        PlaceError: The output is a file of the images.
    """
    listed = load_transforms(images)
    refuse_overwriting(listed.files, [output])
    if is_splat_scene(scene):
        raise ImportRecordingError(
            f"expected a scene that was learned, got the splat {scene}, which has no colour map; train one with advnerf scene train"
        )
    frames = listed.with_frames(thinned(list(listed.frames), most)).load()
    field, occupied, metadata = load_scene(scene)
    # Do not apply the map of an earlier fit.
    learned = seen_colours(FieldRenderer.from_file(scene, IDENTITY), frames)
    inside = np.isfinite(learned).all(axis=-1)
    if inside.mean() < _LEAST_SEEN:
        raise ImportRecordingError(
            f"expected frames that look into the scene of {scene}, got {100 * inside.mean():.1f} % of their pixels inside it; "
            "make both in one world with advnerf scene from-phone-and-car"
        )
    found = fit_colour_map(learned[inside], frames.rgb[inside])
    real = frames.rgb[inside] / np.float32(255.0)
    match = ColourMatch(
        found, len(frames.rgb), psnr(learned[inside], real), psnr(found.apply(learned[inside]), real)
    )
    kept = {key: value for key, value in metadata.items() if key != "scene_hash"}
    save_scene(output, field, occupied, {**kept, "colour_map": found.to_dict()})
    return match


def seen_colours(renderer: FieldRenderer, views: ImageSet) -> NDArray[np.float32]:
    """Render the colours of every view ``[N, H, W, 3]`` in 0..1; NaN where the scene is transparent."""
    images = []
    for pose, pinhole in zip(views.T_world_from_camera, views.pinholes, strict=True):
        rgb, _, alpha = renderer.render(pose[None], pinhole)
        image = rgb[0].numpy().copy()
        image[alpha[0].numpy() < _LEAST_ALPHA] = np.nan
        images.append(image)
    return np.stack(images)
