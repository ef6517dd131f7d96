"""What a frame costs whose objects may move: ``python -m benchmarks.placed_frames RUN_FOLDER``.

In the scene of an experiment's run folder, at the policy's 200x66, with 1 and 5 hydrants of 64^3 in view: processor time of one thread for
the scene alone, for a frame with movable objects, and for its vector-Jacobian product with respect to poses alone and to poses and
colours; memory that a frame keeps; and how near the soft edges are to the true ones.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import torch

from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import PoseBounds, PoseSpace
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.parallel import set_thread_count
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.attack_lab import lab_problem
from benchmarks.objects import crowd


def cpu_ms(function: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call after a first one [ms]; other load on the machine does not count."""
    taken = []
    for _ in range(repeats + 1):
        began = time.process_time()
        function()
        taken.append(1e3 * (time.process_time() - began))
    return median(taken[1:])


def measured(
    bare: Surrogate, objects: Sequence[VoxelGridObject], state: torch.Tensor, repeats: int
) -> dict[str, float]:
    """Processor times [ms], kept memory [KiB], PSNR of soft against true edges [dB]."""
    surrogate = bare.with_objects(objects)
    space = PoseSpace(objects, [PoseBounds(x_m=(0.0, 3.0), y_m=(-3.0, 0.0))] * len(objects))
    unit = space.unit(space.nominal)
    poses = surrogate.camera_poses(state)
    found = {"scene alone": cpu_ms(lambda: surrogate.scene_frames(poses), repeats)}
    for name, free in (("poses", False), ("poses and colours", True)):
        sensor = PlacedSensor(surrogate, space, free)
        theta = sensor.join(unit, surrogate.plain_theta(torch.float64))
        rendered = sensor.render(poses, theta)
        slope = torch.ones_like(rendered.images)
        found[f"frame, {name}"] = cpu_ms(partial(sensor.render, poses, theta), repeats)
        found[f"vjp, {name}"] = cpu_ms(partial(rendered.vjp, slope), repeats)
    found["kept [KiB]"] = rendered.nbytes / 1024
    error = ((rendered.images - surrogate.render(poses, surrogate.plain_theta()).images) ** 2).mean()
    found["soft edges [dB]"] = float(-10.0 * torch.log10(error))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    set_thread_count(1)
    torch.set_num_threads(1)
    problem = lab_problem(arguments.run, (), 1)
    assert isinstance(problem.sensor, Surrogate)
    model = build_from_mesh(GENERATORS["hydrant"](), "hydrant", 64, steps=0)
    for count in (1, 5):
        found = measured(problem.sensor, crowd(model, count), problem.start_states[:1], arguments.repeats)
        print(f"{count} object(s): " + ", ".join(f"{name} {value:.1f}" for name, value in found.items()))


if __name__ == "__main__":
    main()
