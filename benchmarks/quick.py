"""Did something get slower? ``make bench-quick`` compares the main rates with the recorded ones and fails where one is a fifth slower.

A rate is the time of a calibration, which reads memory at random and multiplies matrices, over the time of the work: on a machine that
is twice as fast both halve. Kinds of processors differ in what is fast, so each has rates of its own. All run in one process, in turns,
equally often; medians count. ``--record`` writes what is measured now.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from llvmlite.binding import get_host_cpu_name

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.documents import read_json
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.path import Line
from advnerf_core.driving.path import Path as ReferencePath
from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig
from advnerf_core.files import write_json
from advnerf_core.geometry import Pinhole, camera_mount, make_transform, planar_poses
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.scene.bake import bake
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.gradient_pass import dense_object
from benchmarks.hash_encoding import one_pass
from benchmarks.results import machine_description
from benchmarks.timing import seconds_in_turns

RECORDED = Path(__file__).with_name("rates.json")
LEAST_SHARE = 0.8  # of a recorded rate
_CELLS, _ROOM_M, _POINTS = 128, 4.0, 1 << 16
_LENS = Pinhole(200, 66, 104.0, 104.0, 100.0, 33.0)


def calibration() -> Callable[[], object]:
    """Random reads beyond the cache, and products of matrices."""
    rng = np.random.default_rng(0)
    table, rows = rng.random(1 << 24, dtype=np.float32), rng.integers(0, 1 << 24, 1 << 20)
    matrix = rng.random((512, 512), dtype=np.float32)

    def work() -> None:
        table[rows].sum()
        for _ in range(8):
            np.dot(matrix, matrix)

    return work


def room() -> FieldRenderer:
    """An untrained field that is dense in the walls and the floor of a room, and empty inside."""
    grid = HashGridConfig(levels=8, features=4, log2_entries=17, finest=2048)
    config = SceneFieldConfig((-_ROOM_M, -_ROOM_M, -_ROOM_M), (_ROOM_M, _ROOM_M, _ROOM_M), grid)
    field = SceneField(config)
    with torch.no_grad():
        field.grid.table.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(0))
        field.density_2.bias[0] = 4.0
    occupied = np.ones((_CELLS,) * 3, np.bool_)
    inside = slice(_CELLS // 8, -_CELLS // 8)
    occupied[inside, inside, _CELLS // 2 - 2 : -_CELLS // 8] = False
    march = pixel_intervals([_LENS], np.eye(4)[None], config)
    return FieldRenderer(field, occupied, march)


def ways() -> Mapping[str, Callable[[], object]]:
    """What is measured, by name."""
    encoding = HashGrid(HashGridConfig(levels=16, features=2, log2_entries=19))
    points = torch.rand(_POINTS, 3, generator=torch.Generator().manual_seed(0))
    slopes = torch.randn(_POINTS, encoding.config.width, generator=torch.Generator().manual_seed(1))
    mount, field = camera_mount(0.3, 0.0, 0.2, 0.17), room()
    poses = (
        planar_poses(np.stack([np.linspace(-1.0, 1.0, 8), np.zeros(8), np.linspace(-0.3, 0.3, 8)], axis=1))
        @ mount
    )
    baked = bake(field, poses, _LENS)
    thing = dense_object(make_transform(np.eye(3), [2.0, 0.3, 0.3]))
    surrogate = Surrogate(baked, _LENS, mount, [thing])
    theta = surrogate.plain_theta()
    torch.manual_seed(0)
    starts = torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64)
    path = ReferencePath((-1.0, 0.0, 0.0), [Line(6.0)], False)
    problem = AttackProblem(PilotNet(0, 0.4).eval(), surrogate, Dubins(0.8, 0.1), path, starts, 16)
    return {
        "calibration": calibration(),
        "hash encoding, forward and backward": lambda: one_pass(lambda: encoding(points), slopes, encoding),
        "frame through the field": partial(field.render, poses, _LENS),
        "frame through the baked scene": partial(baked.render, poses, _LENS),
        "frame with an object": partial(surrogate.render, poses, theta),
        "gradient over 16 ticks": partial(adjoint_gradient, problem, theta),
    }


def rates(repeats: int) -> dict[str, float]:
    """Times of the calibration over those of the work."""
    taken = seconds_in_turns(ways(), repeats)
    return {name: taken["calibration"] / seconds for name, seconds in taken.items() if name != "calibration"}


def main() -> int:
    """Measure and compare; the exit code is 1 if something is slower than it may be, 2 if nothing is recorded to compare with."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--record", action="store_true", help="write what is measured now")
    options = parser.parse_args()
    kind, kept = get_host_cpu_name(), read_json(RECORDED)
    if kind not in kept and not options.record:
        print(
            f"expected a processor whose rates are recorded ({', '.join(kept)}), got {kind}; "
            "record them with the code of before your change: python -m benchmarks.quick --record"
        )
        return 2
    found = rates(options.repeats)
    if options.record:
        kept[kind] = {
            "machine": machine_description(),
            "rates": {name: round(rate, 4) for name, rate in found.items()},
        }
        write_json(RECORDED, kept)
        print(f"wrote the rates of {kind} to {RECORDED.name}")
        return 0
    recorded = kept[kind]["rates"]
    slower = [name for name, rate in found.items() if rate < LEAST_SHARE * recorded[name]]
    for name, rate in found.items():
        print(
            f"{name:40} {rate / recorded[name]:5.2f} of the recorded rate{'  TOO SLOW' if name in slower else ''}"
        )
    return 1 if slower else 0


if __name__ == "__main__":
    raise SystemExit(main())
