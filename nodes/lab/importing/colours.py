"""Fits the map from the colours of a learned scene to the driving camera's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.video import thinned
from advnerf_core.data.view_loading import load_image
from advnerf_core.files import refuse_overwriting
from advnerf_core.scene.colour import IDENTITY, ColourMap, fit_colour_map
from advnerf_core.scene.field import load_scene, save_scene
from advnerf_core.scene.learning_check import beats_one_colour, one_colour_db
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
        ImportRecordingError: The frames do not show the scene. Nothing is written.
        PlaceError: The output is a file of the images.
    """
    listed = load_transforms(images)
    refuse_overwriting(listed.files, [output])
    if is_splat_scene(scene):
        raise ImportRecordingError(
            f"expected a scene that was learned, got the splat {scene}, which has no colour map; train one with advnerf scene train"
        )
    frames = thinned(list(listed.frames), most)
    field, occupied, metadata = load_scene(scene)
    # Do not apply the map of an earlier fit.
    learned, rgb = seen_colours(FieldRenderer.from_file(scene, IDENTITY), frames)
    inside = np.isfinite(learned).all(axis=-1)
    if inside.mean() < _LEAST_SEEN:
        raise ImportRecordingError(
            f"expected frames that look into the scene of {scene}, got {100 * inside.mean():.1f} % of their pixels inside it; "
            "make both in one world with advnerf scene from-phone-and-car"
        )
    learned, rgb = learned[inside], rgb[inside]
    found = fit_colour_map(learned, rgb)
    match = ColourMatch(found, len(frames), psnr(learned, rgb), psnr(found.apply(learned), rgb))
    if not beats_one_colour(match.after_db, rgb):
        raise ImportRecordingError(
            f"expected frames of what {scene} shows, from the same places, got a PSNR of {match.after_db:.1f} dB with the best colour map, where "
            f"one colour for all gives {one_colour_db(rgb):.1f} dB; make both in one world with advnerf scene from-phone-and-car"
        )
    kept = {key: value for key, value in metadata.items() if key != "scene_hash"}
    save_scene(output, field, occupied, {**kept, "colour_map": found.to_dict()})
    return match


def seen_colours(
    renderer: FieldRenderer, frames: Sequence[PosedImage]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """The colours of all pixels of frames, of any sizes: rendered ``[N, 3]`` in 0..1, NaN where the scene is transparent, and taken ``[N, 3]``."""
    rendered, taken = [], []
    for frame in frames:
        real, pinhole = load_image(frame)
        rgb, _, alpha = renderer.render(frame.T_world_from_camera[None], pinhole)
        image = rgb[0].numpy().copy()
        image[alpha[0].numpy() < _LEAST_ALPHA] = np.nan
        rendered.append(image.reshape(-1, 3))
        taken.append(real.reshape(-1, 3))
    return np.concatenate(rendered), np.concatenate(taken)
