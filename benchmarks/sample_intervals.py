"""Does the rule of sample intervals pay? Held-out PSNR and rendering time of two rules, in one run.

- ``pixels``: `pixel_intervals`, the same in training and rendering (ours).
- ``box``: 1/2048 to 1/160 of the box with a growth of 0.016, and twice as long in rendering: the rule before it. In the room that is
  8 to 80 mm, as its default was.

Three sets: ``fox``, photographs; ``standing_back``, pictures with alpha of the generated car by a long lens that stands back; ``room``,
a small capture of the simulated lab, with held-out pictures as coarse as the policy's view. Both rules take the same number of steps
with the same number of samples. Views are timed in turns, by median.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.objects.voxel.generators import small_car
from advnerf_core.objects.voxel.rasterise import draw_mesh
from advnerf_core.objects.voxel.views import dome
from advnerf_core.policies.view import PolicyView
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainingReport, train_scene
from benchmarks.results import record_row
from benchmarks.timing import seconds_in_turns
from benchmarks.training_step import photograph_lab
from hardware.worlds.lab.config import LabConfig

COMMAND = "python -m benchmarks.sample_intervals"
_HELD_OUT_EVERY = 8
_FOX_SIZE = (270, 480)
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Case:
    """A data set with its field, and both rules.

    Attributes:
        training: Images to learn from.
        held_out: Images to compare with.
        field: Sizes of the field.
        rules: Intervals of training and of rendering, by the rule's name.
        viewed: Intrinsics of the views that are timed.
        is_open: Whether rays leave the box.
    """

    training: ImageSet
    held_out: ImageSet
    field: SceneFieldConfig
    rules: dict[str, tuple[MarchConfig, MarchConfig]]
    viewed: Pinhole
    is_open: bool = True


def fox(data: Path) -> Case:
    """Instant-NGP's photographs, as in `benchmarks.fox`."""
    listed = load_transforms(data).sorted_by_name()
    training, held_out = (part.load(_FOX_SIZE) for part in listed.split(_HELD_OUT_EVERY))
    field = _field(*listed.box(), bands=3)
    return Case(training, held_out, field, _rules(training, field, 0.3), held_out.pinholes[0])


def standing_back(data: Path) -> Case:
    """Pictures of a car by a camera that stands four and a half lengths back."""
    del data  # generated
    mesh, side_px = small_car(), 320
    low, high = mesh.box
    centre, extent_m = (low + high) / 2, float((high - low).max())
    focal_px = 3.6 * side_px
    lens = Pinhole(side_px, side_px, focal_px, focal_px, side_px / 2, side_px / 2)

    def pictures(count: int, phase: float) -> ImageSet:
        poses = dome(mesh.box, count, phase=phase)
        away = poses[:, :3, 3] - centre
        poses[:, :3, 3] = centre + 4.5 * extent_m * away / np.linalg.norm(away, axis=1, keepdims=True)
        drawn = draw_mesh(mesh, poses, lens)
        rgb = drawn[..., :3] / np.maximum(drawn[..., 3:], 1e-6)
        pixels = [np.rint(255 * np.clip(plane, 0.0, 1.0)).astype(np.uint8) for plane in (rgb, drawn[..., 3])]
        return ImageSet(pixels[0], (lens,) * count, poses, pixels[1])

    field = _field(centre - 0.55 * extent_m, centre + 0.55 * extent_m, bands=3, learned_background=False)
    training = pictures(60, 0.0)
    return Case(training, pictures(8, 0.37), field, _rules(training, field, 0.05), lens)


def room(data: Path) -> Case:
    """A small capture of the lab, learned for the policy's view, as experiments do."""
    del data  # simulated
    images, field = photograph_lab(160)
    held = np.arange(len(images.rgb)) % _HELD_OUT_EVERY == 0
    view = PolicyView(LabConfig().camera.pinhole).pinhole
    before = MarchConfig()
    rules = {
        "pixels": (pixel_intervals([view], images.T_world_from_camera, field),) * 2,
        "box": (before, before.coarser(2.0)),
    }
    return Case(
        _some(images, ~held), _of_focal(_some(images, held), view.fx), field, rules, view, is_open=False
    )


CASES: dict[str, Callable[[Path], Case]] = {"fox": fox, "standing_back": standing_back, "room": room}


def main() -> None:
    """Train by both rules, compare, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data/fox"), help="folder of the fox")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--count", type=int, default=1000, help="training steps; fewer are not recorded")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each, in turns; medians count")
    arguments = parser.parse_args()
    for name in arguments.cases:
        case = CASES[name](arguments.data)
        db, seconds = compare(case, arguments.count, arguments.repeats)
        gain_db, slower = db["pixels"] - db["box"], seconds["pixels"] / seconds["box"]
        note = (
            f"held-out PSNR {db['pixels']:.2f} against {db['box']:.2f} dB; rendering {1e3 * seconds['pixels']:.0f} against "
            f"{1e3 * seconds['box']:.0f} ms a view, {slower:.2f} x; {arguments.count} steps each"
        )
        print(f"{name}: {gain_db:+.2f} dB; {note}", flush=True)
        if arguments.count == parser.get_default("count"):
            line, command = f"sample intervals, {name.replace('_', ' ')}", f"{COMMAND} --cases {name}"
            record_row(f"{line}: PSNR gained", gain_db, "dB", ">= 0 dB", gain_db >= 0.0, command, note)
            target = slower <= 1.0 if name == "room" else None
            record_row(
                f"{line}: rendering time",
                slower,
                "x",
                "<= 1 x" if name == "room" else "printed",
                target,
                command,
                note,
            )


def compare(case: Case, steps: int, repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Held-out PSNR [dB] and seconds of a view by each rule."""
    renderers = {}
    for name, (march, march_of_views) in case.rules.items():
        config = TrainConfig(
            steps=steps,
            march=march,
            opacity=0.0 if case.is_open else TrainConfig.opacity,
            distortion=2e-3 if case.is_open else TrainConfig.distortion,
            refine_depth=0.005 if case.is_open else TrainConfig.refine_depth,
            # In the warm-up intervals are longer: a run that ends in it would compare nothing.
            warmup_steps=min(TrainConfig.warmup_steps, steps // 4),
        )
        trained = train_scene(case.training, case.field, config, progress=_report(name))
        renderers[name] = FieldRenderer(trained.scene, trained.occupied, march_of_views)
    pose = case.held_out.T_world_from_camera[:1]
    ways = {
        name: (lambda renderer=each: renderer.render(pose, case.viewed)) for name, each in renderers.items()
    }
    return {name: _held_out_db(each, case.held_out) for name, each in renderers.items()}, seconds_in_turns(
        ways, repeats
    )


def _held_out_db(renderer: FieldRenderer, views: ImageSet) -> float:
    scores = []
    for index, real in enumerate(views.on_background(_WHITE)):
        rgb = renderer.render(views.T_world_from_camera[index][None], views.pinholes[index])[0][0].numpy()
        usable = np.ones(real.shape[:2], np.bool_) if views.valid is None else views.valid[index]
        scores.append(psnr(rgb[usable], real[usable] / 255.0))
    return float(np.mean(scores))


def _rules(
    images: ImageSet, field: SceneFieldConfig, near_m: float
) -> dict[str, tuple[MarchConfig, MarchConfig]]:
    before = MarchConfig(near_m, field.extent_m / 2048, field.extent_m / 160, 0.016)
    return {
        "pixels": (pixel_intervals(images.pinholes, images.T_world_from_camera, field, near_m),) * 2,
        "box": (before, before.coarser(2.0)),
    }


def _field(low: Array, high: Array, bands: int, learned_background: bool = True) -> SceneFieldConfig:
    low_m, high_m = ((float(x), float(y), float(z)) for x, y, z in (low, high))
    grid = HashGridConfig(levels=8, features=4, finest=2048)
    return SceneFieldConfig(low_m, high_m, grid, direction_bands=bands, learned_background=learned_background)


def _some(images: ImageSet, chosen: Array) -> ImageSet:
    pinholes = tuple(lens for lens, keep in zip(images.pinholes, chosen, strict=True) if keep)
    return ImageSet(images.rgb[chosen], pinholes, images.T_world_from_camera[chosen])


def _of_focal(images: ImageSet, focal_px: float) -> ImageSet:
    """Images made smaller by area averaging, to a focal length: as coarse as another camera's."""
    lens = images.pinholes[0]
    size = (round(lens.width * focal_px / lens.fx), round(lens.height * focal_px / lens.fx))
    small = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images.rgb])
    return ImageSet(small, (lens.resized(*size),) * len(small), images.T_world_from_camera)


def _report(name: str) -> Callable[[TrainingReport], None]:
    def told(at: TrainingReport) -> None:
        if at.step % 250 == 0:
            print(
                f"{name}, step {at.step}: {at.psnr_db:.2f} dB on training rays, {at.eta_s:.0f} s left",
                flush=True,
            )

    return told


if __name__ == "__main__":
    main()
