"""How fast are worlds of other people? ``python -m benchmarks.foreign_worlds [metadrive|duckietown|filament]``; they must be installed.

A step of a tenth of a second, and the driving camera's picture of 336 x 188 pixels with depth, through the other process; in MetaDrive also without
what could be switched off. The processor's time of the server is told beside the wall time, as the machine may have other work.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import psutil

from advnerf_core.documents import Document
from benchmarks.results import record_row
from hardware.worlds.remote_world import RemoteWorld
from nodes.lab.worlds.named import read_world
from nodes.runtime.config import apply_overrides

STEPS, WARM_UP, LIMIT_MS = 60, 8, 100.0
VARIANTS: dict[str, dict[str, tuple[str, ...]]] = {
    "metadrive": {
        "as it is": (),
        "without its sky": ("sky=false",),
        "without its grass": ("terrain=false",),
        "one sample per pixel": ("supersampling=1",),
        "one sample per pixel, anisotropic filtering": ("supersampling=1", "anisotropic=true"),
    },
    "duckietown": {"as it is": (), "one sample per pixel": ("supersampling=1",)},
    "filament": {
        "as it is": (),
        "one sample per pixel": ("lab.supersampling=1",),
        "with ambient occlusion": ("ambient_occlusion=true",),
    },
}


def measure(kind: str, changes: tuple[str, ...]) -> tuple[float, float]:
    """Median wall time, and the server's mean processor time, of a step with picture and depth [ms]."""
    document = Document({"kind": kind}, "benchmark")
    apply_overrides(document, changes)
    with read_world(document, Path.cwd()).make() as world:
        assert isinstance(world, RemoteWorld)
        description = world.describe()
        path = next(iter(description.paths.values()))
        world.reset(*path.start_pose)
        wall_ms = []
        for step in range(WARM_UP + STEPS):
            if step == WARM_UP:
                assert world.server is not None
                server = psutil.Process(world.server.process.pid)
                before = sum(server.cpu_times()[:2])
            began = time.perf_counter()
            world.step(0.0, description.car.speed_mps, 0.1)
            world.observe()
            wall_ms.append(1e3 * (time.perf_counter() - began))
            if step % 10 == 9:
                world.reset(*path.start_pose)
        spent = sum(server.cpu_times()[:2]) - before
    return float(np.median(wall_ms[WARM_UP:])), 1e3 * spent / STEPS


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("kinds", nargs="*", help="which worlds; all of them if none is named")
    parser.add_argument("--trial", action="store_true", help="nothing is recorded")
    options = parser.parse_args()
    for kind in options.kinds or VARIANTS:
        for variant, changes in VARIANTS[kind].items():
            wall_ms, processor_ms = measure(kind, changes)
            print(
                f"{kind}, {variant}: {wall_ms:.0f} ms, {processor_ms:.0f} ms of the server's processor time",
                flush=True,
            )
            if options.trial:
                continue
            met = wall_ms <= LIMIT_MS if not changes else None
            target = f"<= {LIMIT_MS:g} ms" if not changes else "-"
            note = f"336 x 188 with depth; {processor_ms:.0f} ms of the server's processor time"
            line = f"{kind}: step and picture, {variant}"
            record_row(line, round(wall_ms), "ms", target, met, "python -m benchmarks.foreign_worlds", note)


if __name__ == "__main__":
    main()
