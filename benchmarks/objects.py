"""How many objects a scene bears, and what they cost: ``python -m benchmarks.objects RUN_FOLDER [MESH]``.

In the scene and against the policy of an experiment's run folder. Four measurements:

- frames a second of the surrogate at 200x66 with five objects of 64^3, and how far they are from exhaustive sampling: half the step,
  no leaping over empty space, four times the rays, the scene's light followed to the end; and how much nearer to pictures drawn
  from the mesh an object is when sampled like that;
- time of an attack's iteration with 1, 5 and 20 objects in view;
- what leaping over empty space gains, in turns with the same cast without;
- dense colours against sixteen summed levels, fitted to pictures of the object by the same number of steps: dB on held-out views,
  seconds, parameters.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import make_transform, rotation_z
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import SurfaceMesh, stand
from advnerf_core.objects.voxel.mesh_files import load_mesh
from advnerf_core.objects.voxel.model import ObjectModel
from advnerf_core.objects.voxel.pictures import PosedRgba
from advnerf_core.objects.voxel.rasterise import draw_mesh
from advnerf_core.objects.voxel.views import dome, viewing_lens
from advnerf_core.objects.voxel.voxelise import voxelise
from advnerf_core.render.cast_object import ObjectCast, cast_object
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.attack_lab import lab_problem
from benchmarks.results import record_row
from benchmarks.timing import seconds_in_turns

LINE = "objects"
COUNTS = (1, 5, 20)
_HEIGHT_M = 0.7


def crowd(model: ObjectModel, count: int) -> list[VoxelGridObject]:
    """So many copies before the start of the path, all in view at first, in rows of five."""
    places = [(0.6 + 0.5 * (k // 5), -2.9 + 0.45 * (k % 5)) for k in range(count)]
    return [model.placed(make_transform(rotation_z(0.7 * k), [x, y, 0.0])) for k, (x, y) in enumerate(places)]


def without_leaps(field: VoxelGridObject) -> VoxelGridObject:
    """The same object with every voxel so slightly dense that none is empty, and half the step."""
    assert field.density is not None
    return dataclasses.replace(field, density=field.density + 1e-30, step_units=field.step_units / 2)


def frame_rate(folder: Path, model: ObjectModel, frames: int, repeats: int) -> tuple[float, float, float]:
    """Frames a second with five objects, dB of their difference from exhaustive sampling, frames a second of that."""
    five = crowd(model, 5)
    problem = lab_problem(folder, five, frames)
    scene = problem.sensor
    assert isinstance(scene, Surrogate)
    scene_file = folder / "scene" / "scene.safetensors"
    renderer = FieldRenderer.from_file(scene_file)
    renderer.least_transmittance = 1e-6
    thorough = Surrogate(
        renderer,
        scene.camera,
        scene.T_car_from_camera,
        [without_leaps(field) for field in five],
        supersample=4,
    )
    x_m = np.linspace(-1.1, -0.4, frames)
    states = torch.tensor(np.stack([x_m, np.full(frames, -2.0), np.zeros(frames)], axis=-1))
    theta = scene.plain_theta()

    def drive(sensor: Surrogate) -> torch.Tensor:
        # One by one, as in a closed loop: the next pose is not known before.
        return torch.cat([sensor.sense(state[None], theta).images for state in states])

    difference = float((drive(scene) - drive(thorough)).square().mean())
    seconds = seconds_in_turns({"ours": lambda: drive(scene), "exhaustive": lambda: drive(thorough)}, repeats)
    return frames / seconds["ours"], -10.0 * np.log10(max(difference, 1e-12)), frames / seconds["exhaustive"]


def loss_db(model: ObjectModel, mesh: SurfaceMesh) -> float:
    """How much nearer to pictures drawn from the mesh the object is when sampled exhaustively [dB]."""
    field, views = model.placed(np.eye(4)), _pictures(mesh, 8, 0.37)
    assert field.plain_colours is not None
    colours = np.concatenate([field.plain_colours, field.fixed_colours])

    def psnr_db(sampled: VoxelGridObject, supersample: int) -> float:
        errors = []
        for image, pose, lens in zip(views.images, views.T_object_from_camera, views.pinholes, strict=True):
            cast = cast_object(sampled, pose[None], lens, supersample)
            drawn = np.zeros((lens.height * lens.width, 3))
            drawn[cast.pixels] = cast.weights @ colours
            errors.append(np.square(drawn - image[..., :3].reshape(-1, 3)).mean())
        return float(-10.0 * np.log10(np.mean(errors)))

    return psnr_db(without_leaps(field), 4) - psnr_db(field, 2)


def iteration_seconds(folder: Path, model: ObjectModel, steps: int, repeats: int) -> dict[int, float]:
    """Seconds of one rollout with its gradient, for each number of objects."""
    ways = {}
    for count in COUNTS:
        problem = lab_problem(folder, crowd(model, count), steps, cache_bytes=2**40)
        theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
        ways[str(count)] = partial(adjoint_gradient, problem, theta)
    return {int(name): taken for name, taken in seconds_in_turns(ways, repeats).items()}


def leap_gain(model: ObjectModel, repeats: int) -> float:
    """How many times quicker a cast is that leaps over empty space, at the same step."""
    field = model.placed(np.eye(4))
    assert field.density is not None
    plodding = dataclasses.replace(field, density=field.density + 1e-30)
    poses, lens = dome(model.solid_box, 4), viewing_lens(128)
    seconds = seconds_in_turns(
        {
            "leaps": lambda: cast_object(field, poses, lens),
            "plods": lambda: cast_object(plodding, poses, lens),
        },
        repeats,
    )
    return seconds["plods"] / seconds["leaps"]


def fitted(
    field: VoxelGridObject, training: PosedRgba, held_out: PosedRgba, steps: int
) -> tuple[float, float]:
    """dB on held-out views and seconds of fitting the colours by Adam, from grey."""
    casts = [(view, cast) for view, cast in _casts(field, training)]
    theta = torch.zeros(field.theta_shape, requires_grad=True)
    optimiser = torch.optim.Adam([theta], lr=0.1)
    began = time.perf_counter()
    for step in range(steps):
        wanted, cast = casts[step % len(casts)]
        colours = field.colours(theta)
        got = cast.weights @ colours.detach().numpy()
        slopes = torch.from_numpy(cast.weights.T @ (2.0 * (got - wanted) / wanted.size))
        optimiser.zero_grad(set_to_none=True)
        colours.backward(slopes)
        optimiser.step()
    seconds = time.perf_counter() - began
    found = field.colours(theta.detach()).numpy()
    errors = [np.square(cast.weights @ found - wanted).mean() for wanted, cast in _casts(field, held_out)]
    return float(-10.0 * np.log10(np.mean(errors))), seconds


def _casts(field: VoxelGridObject, views: PosedRgba) -> Iterator[tuple[Any, ObjectCast]]:
    """Pixels that the object covers, as wanted and as cast, view by view."""
    for image, pose, lens in zip(views.images, views.T_object_from_camera, views.pinholes, strict=True):
        cast = cast_object(field, pose[None], lens)
        yield image[..., :3].reshape(-1, 3)[cast.pixels], cast


def _pictures(mesh: SurfaceMesh, count: int, phase: float) -> PosedRgba:
    poses, lens = dome(mesh.box, count, phase=phase), viewing_lens(128)
    return PosedRgba(draw_mesh(mesh, poses, lens), poses, (lens,) * count)


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "folder", type=Path, help="run folder of an experiment with scene, policy and calibration"
    )
    parser.add_argument("mesh", type=Path, nargs="?", help="a mesh; the hydrant that ships if none is given")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument(
        "--resolution", type=int, default=64, help="voxels along the longest side of an object"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--steps", type=int, default=240, help="of the fits that are compared")
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()
    mesh = (
        stand(GENERATORS["hydrant"](), height_m=_HEIGHT_M)
        if arguments.mesh is None
        else load_mesh(arguments.mesh, "z", _HEIGHT_M)
    )
    model = ObjectModel("object", voxelise(mesh, arguments.resolution))
    rate, difference_db, exhaustive = frame_rate(arguments.folder, model, arguments.frames, arguments.repeats)
    print(
        f"5 objects: {rate:.1f} frames/s, {difference_db:.1f} dB from exhaustive sampling at {exhaustive:.1f} frames/s"
    )
    below_db = loss_db(model, mesh)
    print(f"{below_db:.2f} dB below exhaustive sampling, against pictures of the mesh")
    taken = iteration_seconds(arguments.folder, model, arguments.frames, arguments.repeats)
    growth = {count: 100 * (taken[count] / taken[1] - 1) / (count - 1) for count in COUNTS[1:]}
    print(f"iteration: {taken} s; growth per object {growth} %")
    gain = leap_gain(model, arguments.repeats)
    print(f"leaping over empty space: {gain:.1f} x")
    compared = compare_levels(model, mesh, arguments.steps)
    if arguments.trial:
        return
    command = f"python -m benchmarks.objects {arguments.folder}"
    note = f"lab scene, {arguments.resolution}^3 each, {torch.get_num_threads()} threads"
    note_db = f"{note}; {below_db:.2f} dB below, and {difference_db:.1f} dB from exhaustive sampling, which makes {exhaustive:.1f} frames/s"
    record_row(
        f"{LINE}: surrogate frame 200x66 with 5",
        rate,
        "frames/s",
        ">= 12 at <= 0.3 dB below exhaustive sampling",
        rate >= 12.0 and below_db <= 0.3,
        command,
        note_db,
    )
    for count, percent in growth.items():
        record_row(
            f"{LINE}: iteration with {count} against 1, growth per object",
            percent,
            "%",
            "<= 15 %",
            percent <= 15.0,
            command,
            f"{note}; {taken[count]:.2f} s against {taken[1]:.2f} s for {arguments.frames} ticks",
        )
    record_row(f"{LINE}: leaping over empty space", gain, "x", "printed", None, command, note)
    record_row(
        f"{LINE}: dense colours against summed levels",
        compared,
        "",
        "printed",
        None,
        command,
        f"{arguments.steps} steps of Adam from grey, pictures drawn from the mesh",
    )


def compare_levels(model: ObjectModel, mesh: SurfaceMesh, steps: int) -> str:
    """Fit both kinds of colours to pictures of the mesh; print and return how they do."""
    training, held_out = _pictures(mesh, 24, 0.0), _pictures(mesh, 8, 0.37)
    dense = model.placed(np.eye(4))
    parts = []
    for name, field in (("dense", dense), ("16 levels", with_summed_levels(dense))):
        psnr_db, seconds = fitted(field, training, held_out, steps)
        parts.append(f"{name}: {psnr_db:.1f} dB, {seconds:.1f} s, {3 * field.parameter_count} parameters")
    print("; ".join(parts))
    return "; ".join(parts)


if __name__ == "__main__":
    main()
