"""Implementation of ``advnerf scene train|eval|render``: trains a scene on a data set, evaluates and renders it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.data.epipolar import require_agreeing_poses
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import ImageSet, PosedImages
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.files import finite_or_none, write_atomically, write_json
from advnerf_core.geometry import Array
from advnerf_core.render.march import MarchConfig
from advnerf_core.report.clips import write_video
from advnerf_core.scene.auto_box import box_around_cameras, box_of_silhouettes
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.learning_check import LearningCheck, held_out_problem
from advnerf_core.scene.metrics import gain_fitted, psnr, ssim
from advnerf_core.scene.presets import FAST, PHOTOGRAPH_BANDS
from advnerf_core.scene.presets import PRESETS as SCENE_PRESETS
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainingReport, train_scene
from advnerf_core.splats.renderer import SplatRenderer
from nodes.lab.training_request import TrainingRequest
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

SCENE, CHECKPOINT, FIGURES, EXPOSURE = (
    "scene.safetensors",
    "checkpoint.safetensors",
    "held_out.json",
    "exposure.json",
)
MM_PER_M = 1000.0
_NO_TIME_LIMIT_STEPS = 1_000_000
_WHITE = (1.0, 1.0, 1.0)
_SURFACE = 0.5  # opacity of a pixel that shows one
_NAMED = 3  # cameras in a warning
_BLACK = 4  # of 255: noise of sensors and JPEG in a picture without light
_MEASURES = ("psnr_db", "gain_fitted_psnr_db", "ssim")


def train(request: TrainingRequest, report: Report) -> dict[str, Any]:
    """Train, and write the scene file and the metrics on held-out images. Returns the metrics."""
    listed = load_transforms(request.transforms)
    listed.require_places()
    training, held_out = listed.training_and_held_out(request.every)
    require_agreeing_poses(training.frames, str(request.transforms))
    for remark in listed.remarks:
        print(remark)
    images = training.load(request.size)
    # Now, so that an image that cannot be compared is an error at once.
    compared = held_out.load(request.size)
    field = scene_field(request, training, images)
    march = sample_intervals(request, field, images)
    print(_described(request, field, march))

    check = LearningCheck(images)

    def progress(at: TrainingReport) -> None:
        if (told := check(at)) is not None:
            print(f"warning: {told}", flush=True)
        report(0.95 * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

    trained = train_scene(
        images, field, _train_config(request, field, march), request.output / CHECKPOINT, progress
    )
    metadata = {
        "march": vars(trained.march),
        "steps": trained.history[-1][0],
        "seed": request.seed,
        "photographs": len(images.rgb),
        "dataset": str(request.transforms),
    }
    save_scene(request.output / SCENE, trained.scene, trained.occupied, metadata)
    if trained.gains is not None:
        names = [training.name_of(frame) for frame in training.frames]
        rows = [
            {"image": name, "gain": gain.tolist()} for name, gain in zip(names, trained.gains, strict=True)
        ]
        write_json(request.output / EXPOSURE, rows)
    figures = evaluate(FieldRenderer.from_file(request.output / SCENE), held_out, compared)
    write_json(request.output / FIGURES, figures)
    warn_of(figures, compared)
    return figures


def evaluate(renderer: FieldRenderer | SplatRenderer, listed: PosedImages, views: ImageSet) -> dict[str, Any]:
    """Compare with held-out images: PSNR [dB], PSNR after a gain fitted to each image [dB], and SSIM.

    Args:
        renderer: The scene.
        listed: The images' list, for their names.
        views: The same images, loaded.

    Masked pixels are excluded from both PSNR. None where there is no number, as of a gain for a black picture; means are of the others.
    """
    # Images with alpha are compared over white, which the renderer uses too.
    rows: list[dict[str, Any]] = [
        {"image": listed.name_of(listed.frames[index]), **_compared(renderer, views, index, real)}
        for index, real in enumerate(views.on_background(_WHITE))
    ]
    return {"mean": {key: _mean_of([row[key] for row in rows]) for key in _MEASURES}, "images": rows}


def _mean_of(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None


def warn_of(figures: dict[str, Any], views: ImageSet) -> None:
    """Print why the figures of `evaluate` say little of the scene, if they do: its pictures are black, or it is no copy of the place."""
    if black := [row["image"] for row in figures["images"] if row["gain_fitted_psnr_db"] is None]:
        print(
            f"warning: no gain can be fitted to black or empty pictures: {', '.join(black)}; take them out",
            flush=True,
        )
    mean_db = figures["mean"]["psnr_db"]
    if mean_db is not None and (told := held_out_problem(mean_db, views)) is not None:
        print(f"warning: {told}", flush=True)


def _compared(
    renderer: FieldRenderer | SplatRenderer, views: ImageSet, index: int, real: NDArray[np.uint8]
) -> dict[str, float | None]:
    rgb, _, alpha = (
        each[0].numpy()
        for each in renderer.render(views.T_world_from_camera[index][None], views.pinholes[index])
    )
    usable = np.ones(real.shape[:2], dtype=bool) if views.valid is None else views.valid[index]
    white = 0.0 if renderer.config.learned_background else 1.0 - alpha[usable][:, None]
    ours, theirs = rgb[usable], real[usable] / 255.0
    # A gain of nearly 0 makes any picture black.
    black = not (real[usable] > _BLACK).any()
    fitted_db = math.inf if black else psnr(gain_fitted(ours, theirs, white), theirs)
    found = psnr(ours, theirs), fitted_db, ssim(rgb, real / 255.0)
    return {key: finite_or_none(value) for key, value in zip(_MEASURES, found, strict=True)}


def render(
    renderer: FieldRenderer | SplatRenderer,
    listed: PosedImages,
    size: tuple[int, int] | None,
    output: Path,
    video: Path | None,
    report: Report,
) -> int:
    """Render a field from every camera of a data set: colour, depth (`depth_in_mm`), and a video.

    Images of a scene that was learned with alpha have alpha. The video shows it over white.

    Returns:
        The number of views.

    Raises:
        ConfigError: The video would have pictures of several sizes.
    """
    pinholes, views = listed.pinholes(size), rendered_files(listed, output)
    sizes = sorted({(pinhole.width, pinhole.height) for pinhole in pinholes})
    if video is not None and len(sizes) > 1:
        raise ConfigError(
            f"expected cameras of one size for a video, got {sizes}; give --size WIDTH HEIGHT, or leave --video out"
        )
    _warn_of_cameras_outside(renderer, listed)
    frames: list[NDArray[np.uint8]] = []
    surfaces = lost = 0
    for index, (camera, pinhole) in enumerate(zip(listed.frames, pinholes, strict=True)):
        rgb, depth_m, alpha = renderer.render(camera.T_world_from_camera[None], pinhole)
        picture = np.rint(255 * rgb[0].numpy()).astype(np.uint8)
        file = views[index]
        if renderer.config.learned_background:
            _write_png(file, picture[..., ::-1])
        else:
            _write_png(file, _with_alpha(rgb[0].numpy(), alpha[0].numpy()))
        depth_mm = depth_in_mm(depth_m[0].numpy())
        _write_png(file.with_name(f"{file.stem}_depth_mm.png"), depth_mm)
        surface = alpha[0].numpy() >= _SURFACE
        surfaces += int(surface.sum())
        lost += int((surface & (depth_mm == 0)).sum())
        frames.append(picture)
        report((index + 1) / len(pinholes), file.stem)
    if video is not None:
        write_video(video, frames)
    if lost:
        print(
            f"warning: {max(1, round(100 * lost / surfaces))} % of the pixels of surfaces are 0 in the depth pictures, which hold millimetres up to 65.5 m; "
            "are the poses of the photographs in metres?",
            flush=True,
        )
    return len(frames)


def _warn_of_cameras_outside(renderer: FieldRenderer | SplatRenderer, listed: PosedImages) -> None:
    """Print which cameras are not in the box of a scene that is a place; objects, which have alpha, are looked at from outside."""
    config = renderer.config
    low, high = np.array(config.box_low_m), np.array(config.box_high_m)
    places = np.stack([frame.T_world_from_camera[:3, 3] for frame in listed.frames])
    outside = np.flatnonzero(((places < low) | (places > high)).any(axis=1))
    if not config.learned_background or not outside.size:
        return
    names = ", ".join(listed.name_of(listed.frames[index]) for index in outside[:_NAMED])
    print(
        f"warning: {outside.size} of {len(places)} cameras are outside the box of the scene, {_short(low)} .. {_short(high)}: {names}"
        f"{', ...' if outside.size > _NAMED else ''}; if they should be inside, check the unit and the axes of their poses",
        flush=True,
    )


def depth_in_mm(depth_m: Array) -> NDArray[np.uint16]:
    """A depth image ``[H, W]`` in millimetres, as depth cameras write it: 0 where nothing is, or nothing that 16 bits can hold (65.5 m)."""
    depth_mm = np.rint(MM_PER_M * depth_m)
    return np.where(depth_mm <= np.iinfo(np.uint16).max, depth_mm, 0).astype(np.uint16)


def rendered_files(listed: PosedImages, output: Path) -> list[Path]:
    """Files of the colour images that `render` writes, in the order of the images."""
    return [output / f"{index:04d}_{frame.path.stem}.png" for index, frame in enumerate(listed.frames)]


def scene_field(
    request: TrainingRequest, listed: PosedImages, images: ImageSet | None = None
) -> SceneFieldConfig:
    """Make the field configuration of a request.

    Args:
        images: The loaded images; their alpha may be learned, and gives a box.

    Raises:
        ConfigError: The scene should be bounded, and no box contains its cameras.
    """
    aabb_scale = listed.aabb_scale or 1.0
    transparent = images is not None and images.transparent
    low, high, unbounded = _box(request, listed, images if transparent else None)
    if request.preset == "instant-ngp":
        # Müller et al. 2022, table 1 and section 5.4, and the sizes of its configs/nerf/base.json.
        finest = round(2048 * aabb_scale)
        grid = HashGridConfig(levels=16, features=2, log2_entries=19, coarsest=16, finest=finest)
        bands = 4
    elif request.preset in SCENE_PRESETS:
        grid, bands = SCENE_PRESETS[request.preset].grid_for(unbounded), PHOTOGRAPH_BANDS
    else:
        # The contracted cube is twice as wide as its inner region, so twice the cells keep the detail.
        grid = HashGridConfig(levels=8, features=4, finest=4096 if unbounded else 2048)
        bands = 3 if request.open_scene or unbounded else 1
    box = _corner(low), _corner(high)
    return SceneFieldConfig(
        *box, grid, direction_bands=bands, contraction=unbounded, learned_background=not transparent
    )


def _box(
    request: TrainingRequest, listed: PosedImages, silhouettes: ImageSet | None
) -> tuple[Array, Array, bool]:
    """Corners ``[3]`` of the box, and whether the scene goes on beyond it."""
    of_file = (listed.aabb_scale or 1.0) > 1.0
    unbounded = of_file if request.unbounded is None else request.unbounded
    if request.box_m is not None:
        return np.array(request.box_m[0]), np.array(request.box_m[1]), unbounded
    if unbounded:
        return *listed.inner_box(), True
    low, high = listed.box()
    poses = np.stack([frame.T_world_from_camera for frame in listed.frames])
    inside = np.all((low <= poses[:, :3, 3]) & (poses[:, :3, 3] <= high), axis=1)
    if listed.aabb_scale is not None or inside.all():
        return low, high, False
    if silhouettes is not None and (found := box_of_silhouettes(silhouettes)) is not None:
        return *found, False
    if request.unbounded is None:
        return *box_around_cameras(poses), True
    raise ConfigError(
        f"expected a box: {request.transforms} has no aabb_scale, and {int((~inside).sum())} of {len(inside)} cameras "
        f"are outside its unit cube; give --box-low and --box-high (cameras are at {_span(listed)}), or leave out --bounded"
    )


def sample_intervals(request: TrainingRequest, field: SceneFieldConfig, images: ImageSet) -> MarchConfig:
    """Sample placement for training and rendering: by the default rule, with the pixels of the request."""
    try:
        return pixel_intervals(
            images.pinholes, images.T_world_from_camera, field, request.near, request.interval_px
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _train_config(request: TrainingRequest, field: SceneFieldConfig, march: MarchConfig) -> TrainConfig:
    is_open = request.open_scene or field.contraction
    steps, minutes = request.length
    if request.preset in SCENE_PRESETS:
        config = SCENE_PRESETS[request.preset].train_config(minutes, steps)
    else:
        config = replace(
            FAST,
            steps=steps or _NO_TIME_LIMIT_STEPS,
            max_seconds=None if minutes is None else 60.0 * minutes,
            distortion=2e-3 if is_open else TrainConfig.distortion,
        )
    return replace(
        config,
        seed=request.seed,
        checkpoint_every_s=request.checkpoint_every_s,
        march=march,
        opacity=0.0 if is_open else TrainConfig.opacity,
        exposure=request.exposure,
    )


def _described(request: TrainingRequest, field: SceneFieldConfig, march: MarchConfig) -> str:
    """Describe the chosen settings and how to override them."""
    inside = "inner region" if field.contraction else "box"
    low, high = (_short(corner) for corner in (field.box_low_m, field.box_high_m))
    text = f"{inside} {low} .. {high}"
    if field.contraction:
        why = "the file's aabb_scale is more than 1, or it has no box (--bounded and --box-low override)"
        why = "" if request.unbounded is not None else f" because {why}"
        text += f", unbounded{why}"
    if not field.learned_background:
        text += "; images have alpha: trained over random colours, transparent areas stay transparent"
    intervals = f"{march.smallest_step_m:.3g} .. {march.largest_step_m:.3g}, {march.step_growth:.3g} of the distance between"
    return f"{text}; preset {request.preset}; nearest {march.near_m:.3g}; sample intervals {intervals}"


def _span(listed: PosedImages) -> str:
    places = np.stack([frame.T_world_from_camera[:3, 3] for frame in listed.frames])
    return f"{_short(places.min(axis=0))} .. {_short(places.max(axis=0))}"


def _short(corner: ArrayLike) -> list[float]:
    """Coordinates with three digits of the largest, in any unit."""
    values = np.asarray(corner, np.float64)
    digits = 2 - int(np.floor(np.log10(max(float(np.abs(values).max()), 1e-30))))
    return [float(value) for value in np.round(values, digits)]


def _corner(corner: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in corner)
    return x, y, z


def _with_alpha(over_white: NDArray[np.float32], alpha: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Convert colours over white to BGRA pixels ``[H, W, 4]``, not premultiplied."""
    opacity = alpha[..., None]
    own = np.clip((over_white - (1.0 - opacity)) / np.maximum(opacity, 1e-3), 0.0, 1.0)
    return np.rint(255 * np.concatenate([own[..., ::-1], opacity], axis=-1)).astype(np.uint8)


def _write_png(path: Path, pixels: NDArray[Any]) -> None:
    write_atomically(path, cv2.imencode(".png", pixels)[1].tobytes())
