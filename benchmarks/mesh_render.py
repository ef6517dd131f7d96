"""What attacks on meshes cost, and how right their gradients are: ``python -m benchmarks.mesh_render [--lab RUN_FOLDER]``.

Frames are 200x66 with four rays a pixel, the background is given, so times are those of the mesh alone:

- a picture with the gradient of the texture; a gradient of the vertices; both as medians over moving cameras;
- kernels that had to be compiled after the first frame;
- the texture's gradient against finite differences in float64, the vertices' (random, averaged over seeds) against those of ray-cast
  pictures;
- a GLB, written and read again, against the mesh it was written from.

With ``--lab`` also a short attack on a hydrant's texture and on a ball's shape beside the corner of an experiment's own learned scene.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.geometry import Array, Pinhole, camera_mount, make_transform, planar_pose, rotation_z
from advnerf_core.objects.mesh.engine import engine
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.glb import glb_bytes
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.attack_lab import lab_problem
from benchmarks.results import record_row
from tests.support.glb import mesh_from_glb

LINE, COMMAND = "mesh render", "python -m benchmarks.mesh_render"
PINHOLE = Pinhole(200, 66, 103.6, 103.4, 100.0, 41.6)
MOUNT = camera_mount(0.2, 0.0, 0.25, 0.17)
STEP_M = 4e-3
# A road that passes the object at arm's length.
POSE = make_transform(rotation_z(0.3), [2.0, 0.45, 0.0])


def poses(frames: int) -> Array:
    """Cameras of a car that drives past."""
    return np.stack(
        [planar_pose(0.6 * k / frames, 0.02 * np.sin(k), 0.02 * np.cos(2 * k)) @ MOUNT for k in range(frames)]
    )


def before_noise(field: MeshField, dtype: torch.dtype = torch.float32, supersample: int = 2) -> Surrogate:
    """The object before a fixed picture of smooth colours."""
    x, y = np.meshgrid(np.linspace(0, 1, PINHOLE.width), np.linspace(0, 1, PINHOLE.height))
    rgb = torch.tensor(np.stack([x, y, 0.5 + 0.5 * np.sin(9 * x)], axis=-1)[None])
    depth = torch.full(rgb.shape[:3], 8.0, dtype=rgb.dtype)

    def background(T: Array, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
        return rgb.expand(len(T), -1, -1, -1), depth.expand(len(T), -1, -1)

    return Surrogate(background, PINHOLE, MOUNT, field, 0.0, supersample, dtype=dtype)


def median_ms(work: Callable[[Array], object], frames: int) -> tuple[float, float, int]:
    """Milliseconds of the first frame, of the median later one, and kernels compiled after the first two."""
    dr = engine().dr
    taken, compiled = [], 0
    for k, pose in enumerate(poses(frames)):
        if k == 2:
            dr.set_flag(dr.JitFlag.KernelHistory, True)
            dr.kernel_history()
        began = time.perf_counter()
        work(pose[None])
        taken.append(1e3 * (time.perf_counter() - began))
    compiled = sum(entry.get("cache_hit") == 0 for entry in dr.kernel_history())
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    return taken[0], float(np.median(taken[2:])), compiled


def smooth_slopes(dtype: torch.dtype = torch.float32) -> Tensor:
    """The gradient of some scalar with respect to a picture ``[1, 3, H, W]``."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(0, 1, PINHOLE.width), np.linspace(0, 1, PINHOLE.height))
    return torch.tensor(
        np.stack([np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in rng.uniform(-3, 3, (3, 3))])[None]
    ).to(dtype)


def texture_error(field: MeshField) -> float:
    """Relative error of the texture's gradient along random directions, float64."""
    scene, slopes = before_noise(field, torch.float64), smooth_slopes(torch.float64)
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(field.theta_shape, generator=generator, dtype=torch.float64)
    frames = scene.prepare(poses(1))
    gradient, worst = frames.render(theta).vjp(slopes), 0.0
    for _ in range(5):
        along = torch.randn(field.theta_shape, generator=generator, dtype=torch.float64)
        up, down = (frames.render(theta + s * 1e-5 * along).images for s in (1, -1))
        expected = float(((up - down) * slopes).sum() / 2e-5)
        worst = max(worst, abs(float((gradient * along).sum()) / expected - 1.0))
    return worst


def vertex_error(field: MeshField, seeds: int) -> tuple[float, float]:
    """Relative error of the mean gradient of the vertices along smooth directions, and the relative noise of a single one."""
    slopes, pose = smooth_slopes(), poses(1)
    free = ShapeLimits(1e6, 0.0, 16, 16)
    fine = ShapeSensor(before_noise(field, supersample=16), free)
    base = torch.full(fine.theta_shape, 0.0)
    found = [fine.render(pose, base + 1e-7 * k).vjp(slopes).double() for k in range(seeds)]
    mean = torch.stack(found).mean(0)
    cheap = ShapeSensor(before_noise(field), ShapeLimits(1e6, 0.0))
    single = [cheap.render(pose, base + 1e-7 * k).vjp(slopes).double() for k in range(seeds)]
    noise = float(np.mean([float((one - mean).norm()) for one in single])) / float(mean.norm())
    vertices = torch.tensor(field.mesh.vertices)
    rng, got, expected = np.random.default_rng(0), [], []
    for _ in range(6):
        along = torch.sin(
            vertices @ torch.tensor(rng.uniform(-6, 6, (3, 3))) + torch.tensor(rng.uniform(0, 6, 3))
        )
        up, down = (fine.render(pose, (s * STEP_M * along).float()).images for s in (1, -1))
        expected.append(float(((up - down).double() * slopes).sum() / (2 * STEP_M)))
        got.append(float((mean * along).sum()))
    return float(np.linalg.norm(np.subtract(got, expected)) / np.linalg.norm(expected)), noise


def glb_difference(field: MeshField) -> float:
    """Largest difference of a pixel between a mesh and what its GLB is read as, in 8-bit steps."""
    again = MeshField(mesh_from_glb(glb_bytes(field.mesh)), field.T_world_from_object, field.scale)
    pictures = []
    for each in (field, again):
        scene = before_noise(each)
        pictures.append(scene.render(poses(3), scene.plain_theta()).images)
    return 255.0 * float((pictures[0] - pictures[1]).abs().max())


def lab_trial(folder: Path, evaluations: int, ticks: int) -> list[tuple[str, float, float, float]]:
    """Short attacks in a learned scene: name, total CTE [m] at the start and at best, seconds an evaluation."""
    found = []
    beside = make_transform(rotation_z(0.3), [2.2, -1.3, 0.0])
    for name, surface in (
        ("texture of a hydrant", stand(hydrant(), height_m=0.75)),
        ("shape of a ball", sphere(0.3, (0.75, 0.1, 0.08))),
    ):
        problem = lab_problem(folder, [MeshField(unwrapped(surface, 32), beside)], ticks, time_batch=16)
        rate = 0.1
        if name.startswith("shape"):
            assert isinstance(problem.sensor, Surrogate)
            problem = replace(problem, sensor=ShapeSensor(problem.sensor, ShapeLimits(bound_m=0.2)))
            rate = 0.01
        history = gradient_attack(problem, evaluations, rate).history
        totals = [each.predicted_total_cte_m for each in history]
        found.append((name, totals[0], max(totals), float(np.median([each.seconds for each in history]))))
        print(
            f"{name}: total CTE {totals[0]:.2f} m at the start, {max(totals):.2f} m at best, {found[-1][3]:.1f} s an evaluation"
        )
    return found


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "--lab", type=Path, help="run folder of an experiment with scene, policy and calibration"
    )
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--evaluations", type=int, default=15)
    parser.add_argument("--ticks", type=int, default=40)
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    options = parser.parse_args()
    textured = MeshField(unwrapped(stand(hydrant(), height_m=0.75), 32), POSE)
    ball = MeshField(unwrapped(sphere(0.35, (0.75, 0.1, 0.08), 3), 16), POSE)
    scene, slopes = before_noise(textured), smooth_slopes()
    sensor = ShapeSensor(before_noise(ball))
    theta, latent = scene.plain_theta(), torch.zeros(sensor.theta_shape)
    first, texture_ms, compiled = median_ms(
        lambda pose: scene.render(pose, theta).vjp(slopes), options.frames
    )
    first_shape, shape_ms, compiled_shape = median_ms(
        lambda pose: sensor.render(pose, latent).vjp(slopes), options.frames
    )
    exact, (wrong, noise), steps = (
        texture_error(textured),
        vertex_error(ball, options.seeds),
        glb_difference(textured),
    )
    threads = f"{engine().dr.thread_count()} thread(s)"
    print(
        f"texture {texture_ms:.1f} ms a frame (first {first:.0f}), vertices {shape_ms:.1f} ms (first {first_shape:.0f}), {threads}"
    )
    print(
        f"compiled after the first two frames: {compiled} and {compiled_shape}; GLB within {steps:.2f} of 255"
    )
    print(f"texture gradient {exact:.1e}, vertex gradient {wrong:.1e}, noise of one estimate {noise:.2f}")
    trial = lab_trial(options.lab, options.evaluations, options.ticks) if options.lab else []
    if options.trial:
        return
    size = f"hydrant of {len(textured.mesh.faces)} triangles, {threads}, first frame {first:.0f} ms"
    record_row(
        f"{LINE}: picture and texture gradient, 200x66, 4 rays",
        texture_ms,
        "ms",
        "<= 15 ms",
        texture_ms <= 15.0,
        COMMAND,
        size,
    )
    size = f"ball of {len(ball.mesh.faces)} triangles, {threads}, first frame {first_shape:.0f} ms, picture included"
    record_row(
        f"{LINE}: vertex gradient, 200x66, 4 rays",
        shape_ms,
        "ms",
        "<= 50 ms",
        shape_ms <= 50.0,
        COMMAND,
        size,
    )
    record_row(
        f"{LINE}: kernels compiled after the first two frames",
        compiled + compiled_shape,
        "",
        "0",
        compiled + compiled_shape == 0,
        COMMAND,
    )
    record_row(
        f"{LINE}: texture gradient against finite differences",
        exact,
        "",
        "<= 1e-6",
        exact <= 1e-6,
        COMMAND,
        "float64",
    )
    record_row(
        f"{LINE}: vertex gradient against finite differences",
        wrong,
        "",
        "<= 0.05",
        wrong <= 0.05,
        COMMAND,
        f"mean of {options.seeds} estimates of 16 + 16 samples; one of 4 + 1 has a noise of {noise:.2f}",
    )
    record_row(
        f"{LINE}: GLB read again",
        steps,
        "of 255",
        "<= 1",
        steps <= 1.0,
        COMMAND,
        "largest difference of a pixel",
    )
    for name, start, best, seconds in trial:
        record_row(
            f"{LINE}: {name} in the learned room",
            best / start,
            "x",
            "printed",
            None,
            f"{COMMAND} --lab {options.lab}",
            f"{start:.2f} to {best:.2f} m, {options.evaluations} evaluations of {options.ticks} ticks, {seconds:.1f} s each",
        )


if __name__ == "__main__":
    main()
