"""The parts that `benchmarks.floors` times, each with what it must do at least."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.attack.image_gradients import agrees_in_bfloat16
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.path import Line, Path
from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig, encode, scatter
from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.geometry import Array, Pinhole, make_transform, planar_poses
from advnerf_core.parallel import SLOTS, run_slots, slot_bounds
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.view import PolicyView
from advnerf_core.render.cast_object import cast_work
from advnerf_core.render.march import Marcher, Samples
from advnerf_core.render.rays import intrinsics_row, pixel_rays, poses_in_box
from advnerf_core.scene.bake import bake
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.field import SceneField
from advnerf_core.scene.field_kernels import density_network, two_layers_backward
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from advnerf_core.scene.train_step import CpuStep, log_density
from benchmarks import least_work
from benchmarks.gradient_pass import dense_object
from benchmarks.least_work import Work
from benchmarks.training_step import Batch
from hardware.worlds.lab.config import LabConfig

WHOLE, WHOLE_TICKS = "tick with gradient", 8


@dataclass(frozen=True)
class Part:
    """One part of the work.

    Attributes:
        name: Of the row.
        run: Does it once.
        work: What it must do at least.
    """

    name: str
    run: Callable[[], object]
    work: Work


def encoding_parts(log2_entries: int, points: int) -> list[Part]:
    """Hash encoding of uniform points with 16 levels of 2 features, forward and backward."""
    grid = HashGrid(HashGridConfig(levels=16, features=2, log2_entries=log2_entries))
    at = torch.rand(points, 3, generator=torch.Generator().manual_seed(0)).numpy()
    table, gradient = grid.table.detach().numpy(), np.zeros(grid.table.shape, np.float32)
    encoded = np.zeros((-(-points // TILE), grid.config.width, TILE), np.float32)
    work = least_work.encoding(at, grid.config)
    name = f"hash encoding, 2^{log2_entries} entries"
    return [
        Part(f"{name}, forward", lambda: encode(at, points, table, grid.levels, encoded), work),
        Part(f"{name}, backward", lambda: scatter(at, points, encoded, grid.levels, gradient), work),
    ]


def training_parts(batch: Batch, stepper: CpuStep) -> list[Part]:
    """Encoding of all samples of a batch; density network and scatter of those that show."""
    samples, _ = batch.marcher(batch.rays, batch.jitter, batch.skipping)
    config, v, levels = stepper.scene.config, stepper.values, stepper.scene.grid.levels
    count, table = len(samples.points), v["grid.table"]
    everything = np.zeros((-(-count // TILE), config.grid.width, TILE), np.float32)
    shown, encoded = stepper.visible(samples)
    encoded, visible = encoded.copy(), len(shown.points)
    field = np.zeros((len(encoded), 1 + config.features, TILE), np.float32)
    slope, small = (
        np.zeros_like(field),
        {name: np.zeros_like(value) for name, value in v.items() if name.startswith("density")},
    )
    widths = (config.grid.width, config.hidden, 1 + config.features)
    bounds = slot_bounds(len(encoded), SLOTS)
    w1, b1, w2, b2 = (v[f"density_{layer}.{kind}"] for layer in (1, 2) for kind in ("weight", "bias"))
    g = [small[f"density_{layer}.{kind}"] for layer in (1, 2) for kind in ("weight", "bias")]
    slots = [[each.copy() for each in g] for _ in range(SLOTS)]
    gradient, of_table = np.zeros_like(encoded), np.zeros_like(table)

    def backward(slot: int) -> None:
        # A gradient of zero takes as long, and leaves zeros for the next run.
        two_layers_backward(w1, b1, w2, gradient, slope, *bounds[slot], *slots[slot])

    return [
        Part(
            "training step, encoding of all samples",
            lambda: encode(samples.points, count, table, levels, everything),
            least_work.encoding(samples.points, config.grid),
        ),
        Part(
            "training step, network of visible samples, forward",
            lambda: run_slots(lambda s: density_network(w1, b1, w2, b2, encoded, field, *bounds[s]), SLOTS),
            least_work.two_layers(visible, widths, False),
        ),
        Part(
            "training step, network of visible samples, backward",
            lambda: run_slots(backward, SLOTS),
            least_work.two_layers(visible, widths, True),
        ),
        Part(
            "training step, scatter of visible samples",
            lambda: scatter(shown.points, visible, gradient, levels, of_table),
            least_work.encoding(shown.points, config.grid),
        ),
    ]


def tick_parts(batch: Batch, resolution: int) -> list[Part]:
    """One tick of the surrogate: background, casting of one object, composing, and the policy, for one frame; and a drive of `WHOLE_TICKS` with its gradient."""
    trained, config = batch.trainer.run(), LabConfig()
    view, mount = PolicyView(config.camera.pinhole).pinhole, config.camera.T_car_from_camera
    states = np.stack(
        [np.linspace(-1.0, 1.0, WHOLE_TICKS), np.zeros(WHOLE_TICKS), np.linspace(-0.3, 0.3, WHOLE_TICKS)],
        axis=1,
    )
    field = FieldRenderer(trained.scene, trained.occupied, trained.march)
    baked = bake(field, planar_poses(states) @ mount, view)
    thing = dense_object(make_transform(np.eye(3), [2.0, 0.0, 0.5]), resolution)
    surrogate, pose = Surrogate(baked, view, mount, [thing]), planar_poses(states[4:5]) @ mount
    theta, policy = surrogate.plain_theta(), PilotNet(0, 0.4).eval().requires_grad_(False)
    problem = AttackProblem(
        policy,
        surrogate,
        Dubins(0.8, 0.1),
        Path((-1.0, 0.0, 0.0), [Line(6.0)], closed=False),
        torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64),
        WHOLE_TICKS,
        reduced=agrees_in_bfloat16(policy, view),
    )
    rgb, depth_m = surrogate.scene_frames(pose)
    image = surrogate.render(pose, theta).images
    casts = cast_work([thing], pose, view).run()
    weights = casts[0].weights
    background = least_work.baked_frame(
        *frame_samples(baked, trained.scene, pose, view),
        baked.least_transmittance,
        baked.voxels,
        baked.leaps.cells,
    )
    density_bytes = 8 * resolution**3
    return [
        Part("tick, background", lambda: surrogate.scene_frames(pose), background),
        Part(
            "tick, casting one object",
            lambda: cast_work([thing], pose, view).run(),
            least_work.casting(weights, density_bytes),
        ),
        Part(
            "tick, composing",
            lambda: surrogate.composed(casts, rgb, depth_m).render(theta),
            least_work.composing(weights, view.width * view.height),
        ),
        Part("tick, policy", lambda: policy(image), least_work.network(policy, image)),
        Part(WHOLE, lambda: adjoint_gradient(problem, theta), Work(0.0, {}, 0.0)),
    ]


def frame_samples(
    baked: BakedScene, scene: SceneField, pose: Array, view: Pinhole
) -> tuple[Samples, NDArray[np.float32]]:
    """Samples of every pixel of a frame as the baked scene takes them, and the transmittance up to each."""
    pixels = np.arange(view.width * view.height)
    rays, unused = np.empty((len(pixels), 6), np.float32), np.empty((len(pixels), 3), np.uint8)
    in_box = poses_in_box(pose, baked.config.origin_m, baked.config.extent_m)
    blank = np.zeros((1, view.height, view.width, 3), np.uint8)
    pixel_rays(pixels, blank, in_box, intrinsics_row(view)[None], rays, unused)
    marcher = Marcher(len(pixels) * 256, baked.march, baked.config.box_high)
    samples, kept = marcher(rays, np.full(len(rays), 0.5, np.float32), baked.leaps)
    if len(kept) != len(rays):
        raise RuntimeError(f"expected the samples of all {len(rays)} rays, {len(kept)} fit the buffers")
    depth = np.exp(log_density(scene, samples.points).astype(np.float64)) * samples.widths
    running = np.concatenate([[0.0], np.cumsum(depth)])
    of_ray = np.repeat(running[samples.begins[:-1]], np.diff(samples.begins))
    return samples, np.exp(of_ray - running[:-1]).astype(np.float32)
