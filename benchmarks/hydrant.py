"""How well does a voxel object look like the mesh it was made from? ``python -m benchmarks.hydrant [FILE.glb]``.

The held-out views lie between those of the fit; both are drawn from the mesh by its own depth buffer. PSNR is over whole pictures
before white. The generated hydrant is used unless a file is given.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from advnerf_core.objects.voxel.build import HELD_OUT_VIEWS, build_from_mesh
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.mesh_files import load_mesh
from benchmarks.results import record_row

TARGET_DB = 30.0


def main() -> None:
    """Build the object and compare."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("mesh", type=Path, nargs="?", help="a mesh file; default: the generated hydrant")
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--trial", action="store_true", help="print, but do not write the ledger")
    options = parser.parse_args()
    mesh = hydrant() if options.mesh is None else load_mesh(options.mesh, "z")
    name = "generated hydrant" if options.mesh is None else options.mesh.stem
    began = time.monotonic()
    model = build_from_mesh(mesh, name, options.resolution, options.steps)
    seconds = time.monotonic() - began
    psnr_db = model.about["held_out_psnr_db"]
    shape = " x ".join(map(str, model.grids.density.shape))
    note = f"{shape} voxels, {int(model.slots.max())} free colours, {options.steps} steps in {seconds:.0f} s, {HELD_OUT_VIEWS} views"
    print(f"{name}: {psnr_db:.2f} dB; {note}")
    if not options.trial:
        argument = "" if options.mesh is None else f" {options.mesh}"
        command = f"python -m benchmarks.hydrant{argument}"
        record_row(
            f"{name} from its mesh, held-out views",
            psnr_db,
            "dB",
            ">= 30 dB",
            psnr_db >= TARGET_DB,
            command,
            note,
        )


if __name__ == "__main__":
    main()
