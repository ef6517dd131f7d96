"""How sharp is a voxel object that is learned from pictures with alpha? ``python -m benchmarks.object_pictures --resolution 64``.

The pictures are drawn from the generated car by its own depth buffer, as a stranger's set would have them: 100 training views from a
dome, 12 held-out views between them, 400 x 400. The fit only sees the pictures and poses: it carves the visual hull and fits density
and colours in 180 s. PSNR is over whole held-out pictures before white.
"""

from __future__ import annotations

import argparse

from advnerf_core.objects.voxel.build import HELD_OUT_VIEWS, build_from_images, mesh_views
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.parallel import thread_count
from benchmarks.results import record_row
from benchmarks.timing import ProcessorUse

TARGETS_DB = {64: 30.0, 128: 32.0}
SECONDS = 180.0
_VIEWS, _PIXELS, _PHASE = 100, 400, 0.37
_NO_LIMIT_STEPS = 1_000_000


def main() -> None:
    """Fit, compare, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--resolution", type=int, default=64, help="voxels along the longest side")
    parser.add_argument("--generate", choices=sorted(GENERATORS), default="car")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="only 180 is written to the ledger")
    parser.add_argument("--one-stage", action="store_true", help="not coarse to fine; not recorded")
    arguments = parser.parse_args()
    use = ProcessorUse()
    mesh = GENERATORS[arguments.generate]()
    model = build_from_images(
        mesh_views(mesh, _VIEWS, _PIXELS),
        arguments.generate,
        arguments.resolution,
        _NO_LIMIT_STEPS,
        held_out=mesh_views(mesh, HELD_OUT_VIEWS, _PIXELS, _PHASE),
        max_seconds=arguments.seconds,
        coarse_to_fine=not arguments.one_stage,
    )
    about = model.about
    psnr_db = float(about["held_out_psnr_db"])
    note = (
        f"{about['steps']} steps on {thread_count()} threads, {use.text()}; {about['held_out_object_psnr_db']:.2f} dB over the object's own "
        f"pixels; {about['train_psnr_db']:.2f} dB on training views"
    )
    print(f"{arguments.generate}, {arguments.resolution}^3: {psnr_db:.2f} dB: {note}")
    target_db = TARGETS_DB.get(arguments.resolution)
    if target_db is not None and arguments.seconds == SECONDS and not arguments.one_stage:
        record_row(
            f"generated {arguments.generate} from pictures, {arguments.resolution}^3, 3 min, held-out views",
            psnr_db,
            "dB",
            f">= {target_db:g} dB",
            psnr_db >= target_db,
            f"python -m benchmarks.object_pictures --generate {arguments.generate} --resolution {arguments.resolution}",
            note,
        )


if __name__ == "__main__":
    main()
