"""How fast is a splat rendered, directly and baked, and does it equal the reference? ``python -m benchmarks.splats``.

The splat is a room whose walls are 500,000 flat Gaussians with harmonics of degree 3. ``--attack RUN_FOLDER`` (of ``make demo``) makes
Gaussians of the surfaces of that run's learned scene, without optimisation, searches in both from the same starts, and deploys what is
found in the world.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import mean

import numpy as np
import torch

from advnerf_core.fields.spherical_harmonics import MAX_BANDS
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.surrogate import BackgroundRenderer
from advnerf_core.splats.bake import bake_splats
from advnerf_core.splats.gaussians import COLOUR_OFFSET, CONSTANT_BASIS, GaussianSplats
from advnerf_core.splats.renderer import NEAR_M, SplatRenderer
from benchmarks.baked_scene import searched_pairs
from benchmarks.results import record_row
from benchmarks.timing import ProcessorUse, seconds_in_turns
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.steps import bake as bake_stage
from tests.support.splat_reference import render_reference

COMMAND = "python -m benchmarks.splats"
_COUNT, _FEWER, _LENS = 500_000, 20_000, Pinhole(200, 66, 104.0, 104.0, 100.0, 33.0)
_SIZE_M, _EYE_M = np.array([8.0, 6.0, 3.0]), -0.9
_VIEWS, _COMPARED, _REPEATS = 8, 2, 9
_VOXEL_M, _LEAST_SHARE = 0.02, 0.9


def room(count: int, seed: int = 0) -> GaussianSplats:
    """Flat Gaussians of many colours on the inner walls of a box around the origin."""
    rng = np.random.default_rng(seed)
    areas = np.repeat(np.prod(_SIZE_M) / _SIZE_M, 2)
    face = rng.choice(6, count, p=areas / areas.sum())
    axis, rows = face // 2, np.arange(count)
    means = rng.uniform(-0.5, 0.5, (count, 3)) * _SIZE_M
    means[rows, axis] = (face % 2 - 0.5) * _SIZE_M[axis]
    wide = np.sqrt(areas.sum() / count)
    scales = wide * np.exp(rng.normal(0.2, 0.4, (count, 3)))
    scales[rows, axis] = 0.1 * wide
    harmonics = rng.normal(0.0, 0.03, (count, MAX_BANDS**2, 3))
    harmonics[:, 0] = 1.2 * np.sin(2.0 * means + face[:, None]) + rng.normal(0.0, 0.1, (count, 3))
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    parts = (means, scales, turns, rng.uniform(0.3, 1.0, count), harmonics)
    return GaussianSplats(*(np.ascontiguousarray(part, np.float32) for part in parts)).ordered()


def views(count: int, seed: int) -> Array:
    """Poses ``[count, 4, 4]`` at the height of a small car."""
    rng = np.random.default_rng(seed)
    places = np.concatenate(
        [rng.uniform(-0.3, 0.3, (count, 2)) * _SIZE_M[:2], np.full((count, 1), _EYE_M)], axis=1
    )
    turns = rng.uniform(0.0, 2.0 * np.pi, count)
    ahead = np.stack([np.cos(turns), np.sin(turns), np.full(count, -0.1)], axis=1)
    return np.stack([look_at(place, place + each) for place, each in zip(places, ahead, strict=True)])


def speed() -> None:
    """Frames per second, direct and baked, and how alike they are."""
    splat, poses = SplatRenderer(room(_COUNT)), views(_VIEWS, 1)
    baked = bake_splats(splat, views(100, 2), _LENS)
    use = ProcessorUse()
    ways = {"direct": lambda: splat.render(poses, _LENS), "baked": lambda: baked.render(poses, _LENS)}
    seconds = seconds_in_turns(ways, _REPEATS)
    alike_db = psnr(baked.render(poses, _LENS)[0].numpy(), splat.render(poses, _LENS)[0].numpy())
    for name, least in (("direct", 15.0), ("baked", 100.0)):
        rate = _VIEWS / seconds[name]
        note = f"{_COUNT:,} Gaussians of degree 3 in a room, with depth; {use.text()}"
        if name == "baked":
            note += f"; PSNR to the splat {alike_db:.1f} dB, {baked.voxels.nbytes / 2**20:.0f} MiB"
        _record(
            f"splat at {_LENS.width}x{_LENS.height}, {name}",
            rate,
            "frames/s",
            f">= {least:g}",
            rate >= least,
            note,
        )


def exactness() -> None:
    """The largest difference of colours, opacities and depths to plain torch."""
    torch.set_num_threads(1)  # of arrays this small, more are slower
    splat = SplatRenderer(room(_FEWER))
    worst = 0.0
    for pose in views(_COMPARED, 3):
        expected = render_reference(splat.splats, pose, _LENS, NEAR_M)
        rgb, depth_m, alpha = splat.render(pose[None], _LENS)
        for found, right in ((rgb, "rgb"), (depth_m, "expected_m"), (alpha, "alpha")):
            seen = torch.isfinite(expected[right])
            worst = max(worst, float((found[0] - expected[right])[seen].abs().max()))
    note = f"{_COMPARED} views of {_FEWER:,} Gaussians; colours and opacity in 0..1, depth in metres"
    _record("splat: worst difference to plain torch", worst, "", "<= 1e-4", worst <= 1e-4, note)


def splat_of(background: BackgroundRenderer, poses: Array, pinhole: Pinhole) -> GaussianSplats:
    """A ball for each voxel that the surfaces in some views pass, with their mean colour."""
    directions = pinhole.directions().reshape(-1, 3)
    sums: dict[bytes, Array] = {}
    for pose in poses:
        rgb, depth_m = (torch.as_tensor(part).numpy()[0] for part in background(pose[None], pinhole)[:2])
        seen = np.isfinite(depth_m.reshape(-1))
        points = (directions * depth_m.reshape(-1, 1))[seen] @ pose[:3, :3].T + pose[:3, 3]
        voxels, place = np.unique(np.floor(points / _VOXEL_M).astype(np.int64), axis=0, return_inverse=True)
        found = np.zeros((len(voxels), 7))
        np.add.at(
            found, place.reshape(-1), np.hstack([points, rgb.reshape(-1, 3)[seen], np.ones((len(points), 1))])
        )
        for voxel, row in zip((each.tobytes() for each in voxels), found, strict=True):
            sums[voxel] = sums[voxel] + row if voxel in sums else row
    table = np.stack(list(sums.values()))
    means, colours = np.split(table[:, :6] / table[:, 6:], 2, axis=1)
    count = len(table)
    parts = (
        means,
        np.full((count, 3), 0.5 * _VOXEL_M),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full(count, 0.95),
        (colours[:, None] - COLOUR_OFFSET) / CONSTANT_BASIS,
    )
    return GaussianSplats(*(np.ascontiguousarray(part, np.float32) for part in parts)).ordered()


def attack(run: Path) -> None:
    """What searches in a splat of the room and in its field find, deployed."""
    experiment = Experiment.resolved_in(run.resolve())
    field, poses, pinhole = (
        load_background(experiment),
        bake_stage.views_of(experiment),
        experiment.view.pinhole,
    )
    splat = SplatRenderer(splat_of(field, poses, pinhole))
    splat_baked = bake_splats(splat, poses, pinhole)
    alike_db = psnr(
        splat_baked.render(poses[::40], pinhole)[0].numpy(), field(poses[::40], pinhole)[0].numpy()
    )
    rows = searched_pairs(experiment, {"field": field, "splat": splat_baked}, [HARDENED])
    field_m, splat_m = (mean(row[name] for row in rows) for name in ("field", "splat"))
    share = splat_m / field_m
    note = (
        f"{splat_m:.4f} m a tick against {field_m:.4f} m, {len(rows)} pairs of searches, victim {HARDENED}; {len(splat.splats):,} Gaussians, "
        f"one for each voxel of {100 * _VOXEL_M:g} cm, {alike_db:.1f} dB to the field"
    )
    options = f" --attack runs/{run.resolve().name}"
    target = f">= {100 * _LEAST_SHARE:g} % of the field's"
    record_row(
        "attacks searched in a splat of the room, deployed: excess against those searched in the field",
        100.0 * share, "%", target, share >= _LEAST_SHARE, COMMAND + options, note,
    )  # fmt: skip
    print(f"{100 * share:.1f} % ({target}); {note}", flush=True)


def _record(line: str, value: float, unit: str, target: str, met: bool, note: str) -> None:
    print(f"{line}: {value:.4g} {unit} ({target}); {note}", flush=True)
    record_row(line, value, unit, target, met, COMMAND, note)


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--attack", type=Path, metavar="RUN_FOLDER", help="compare attacks, instead (a quarter of an hour)"
    )
    options = parser.parse_args()
    if options.attack is not None:
        attack(options.attack)
        return
    exactness()
    speed()


if __name__ == "__main__":
    main()
