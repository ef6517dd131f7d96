"""The commands ``advnerf scene object ...``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import print_table, table

if TYPE_CHECKING:
    from advnerf_core.data.views import PosedImages
    from advnerf_core.objects.voxel.model import ObjectModel
    from nodes.runtime.progress import Report

app = CommandGroup(
    no_args_is_help=True, help="Build objects from meshes, photographs or generators, and inspect them."
)

ObjectPath = Annotated[
    Path, typer.Argument(help="An object file (*.object.safetensors).", exists=True, dir_okay=False)
]
_SIZE = "size_m"  # of the mesh, in what an object file says about its source
_FEW_VOXELS = 4.0
_TURNTABLE_VIEWS, _TURNTABLE_PIXELS = 8, 240
_HELD_OUT_EVERY, _FEWEST_TO_SPLIT = 8, 16
_DEFAULT_STEPS, _NO_STEP_LIMIT = 600, 1_000_000
# What each source of an object takes, beside the options of all.
_OPTIONS_OF = {
    "FILE": ("--height", "--up", "--unit"),
    "--generate": ("--height",),
    "--images": ("--minutes", "--size", "--coarse-to-fine"),
}


@app.command("build")
def object_build(
    file: Annotated[
        Path | None, typer.Argument(help="Mesh file: GLB, OBJ, PLY or STL.", exists=True, dir_okay=False)
    ] = None,
    generate: Annotated[
        str | None, typer.Option(help="Generate an object instead of reading FILE: hydrant or car.")
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Learn from images with an alpha channel instead of reading FILE: their transforms.json.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Object file.", show_default="<name>.object.safetensors"),
    ] = None,
    resolution: Annotated[int, typer.Option(min=8, max=128, help="Voxels along the longest side.")] = 64,
    height_m: Annotated[
        float | None, typer.Option("--height", help="Scale to this height [m]. Not with --images.")
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            help="Axis of the file that points up: z or y.", show_default="y for GLB and glTF, z for others"
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of length of the file: mm, cm, m or in.",
            show_default="m for GLB and glTF; others need it, or --height",
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=0, help="Optimiser steps of the fit.", show_default="400 for a mesh, 600 for images"
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.01, help="With --images: fit for this many minutes instead of --steps."),
    ] = None,
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(
            min=1,
            metavar="WIDTH HEIGHT",
            help="With --images: resize the images to this width and height. For the object itself, see --resolution.",
            show_default="as they are",
        ),
    ] = None,
    coarse_to_fine: Annotated[
        bool,
        typer.Option(
            "--coarse-to-fine",
            help="With --images: fit grids of 32^3, 64^3, ... first. Sharper in the same time for large --resolution.",
        ),
    ] = False,
) -> None:
    """Build an object file from a mesh, a generator or images.

    With --images, the training split of the data set is used. Without a split, 7 of 8 images are used if there are 16 or
    more. The command prints the PSNR on training and held-out images, and advice if it is low.
    """
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.files import refuse_overwriting
    from advnerf_core.objects.voxel.build import build_from_mesh
    from advnerf_core.objects.voxel.model import save_object
    from advnerf_core.places import require_utf8
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.progress import ProgressDisplay

    sources = [
        name for name, given in zip(_OPTIONS_OF, (file, generate, images), strict=True) if given is not None
    ]
    if len(sources) != 1:
        raise ConfigError("expected exactly one of FILE, --generate and --images")
    _refuse_options_of_others(
        sources[0],
        {
            "--height": height_m is not None,
            "--up": up is not None,
            "--unit": unit is not None,
            "--minutes": minutes is not None,
            "--size": size is not None,
            "--coarse-to-fine": coarse_to_fine,
        },
    )
    if minutes is not None and steps is not None:
        raise ConfigError("expected either --steps or --minutes, got both; remove one of them")
    name = generate or _name(file or images or Path())
    path = output or Path(f"{name}.object.safetensors")
    require_utf8(path)
    listed = None if images is None else load_transforms(images)
    refuse_overwriting([file, *(listed.files if listed else ())], [path])
    with ProgressDisplay() as display:
        report = display.start("object")
        if listed is not None:
            model = _from_images(
                str(images), listed, name, resolution, steps, minutes, size, coarse_to_fine, report
            )
        else:
            mesh, source = _mesh(file, generate, up, height_m, unit)
            source |= {_SIZE: [round(float(side), 6) for side in mesh.size_m]}
            model = build_from_mesh(mesh, name, resolution, 400 if steps is None else steps, source, report)
    save_object(path, model)
    _print_quality(path, model)


@app.command("show")
def object_show(
    file: ObjectPath,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="PNG.", show_default="beside FILE")
    ] = None,
) -> None:
    """Say what an object file holds, and render the object from eight sides."""
    import numpy as np

    from advnerf_core.data.image_files import write_image
    from advnerf_core.files import refuse_overwriting
    from advnerf_core.objects.voxel.build import draw_object
    from advnerf_core.objects.voxel.model import load_object
    from advnerf_core.objects.voxel.views import ring, viewing_lens

    path = output or file.with_suffix(".png")
    refuse_overwriting([file], [path])
    model = load_object(file)
    _print_facts(model)
    poses = ring(model.solid_box, _TURNTABLE_VIEWS)
    drawn = draw_object(model, poses, viewing_lens(_TURNTABLE_PIXELS))
    pictures = drawn[..., :3] + 1.0 - drawn[..., 3:]
    half = _TURNTABLE_VIEWS // 2
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in (pictures[:half], pictures[half:])])
    pixels = np.rint(255 * np.clip(sheet, 0.0, 1.0)).astype(np.uint8)
    write_image(path, pixels)
    print(path)


def _print_facts(model: ObjectModel) -> None:
    rows = table("what", "value")
    rows.add_row("name", model.name)
    rows.add_row("size", _size(model, 3))
    rows.add_row(
        "voxels", " x ".join(map(str, model.grids.density.shape)) + f" of {1e3 * model.grids.voxel:.1f} mm"
    )
    rows.add_row("free colours", str(int(model.slots.max())))
    for key, value in model.about.items():
        rows.add_row(key, str(value))
    print_table(rows)


def _mesh(  # type: ignore[no-untyped-def]
    file: Path | None, generate: str | None, up: str | None, height_m: float | None, unit: str | None
):
    from advnerf_core.objects.voxel.generators import GENERATORS
    from advnerf_core.objects.voxel.mesh import stand
    from advnerf_core.objects.voxel.mesh_files import load_mesh
    from nodes.runtime.errors import ConfigError

    if file is not None:
        mesh = load_mesh(file, up, height_m, unit)
        return mesh, {"mesh": file.name, "sha256": mesh.sha256}
    if generate not in GENERATORS:
        raise ConfigError(f"expected --generate to be one of {', '.join(GENERATORS)}; got {generate!r}")
    return stand(GENERATORS[generate](), height_m=height_m), {"generator": generate}


def _refuse_options_of_others(source: str, given: dict[str, bool]) -> None:
    from nodes.runtime.errors import ConfigError

    for name, is_given in given.items():
        if is_given and name not in _OPTIONS_OF[source]:
            takers = " or ".join(each for each, takes in _OPTIONS_OF.items() if name in takes)
            raise ConfigError(f"expected {name} only with {takers}, got it with {source}; leave it out")


def _name(source: Path) -> str:
    """Default name of an object: the stem of the mesh file, or the folder of the images."""
    source = source.resolve()
    return source.parent.name if source.suffix == ".json" else source.stem


def _from_images(
    source: str,
    listed: PosedImages,
    name: str,
    resolution: int,
    steps: int | None,
    minutes: float | None,
    size: tuple[int, int] | None,
    coarse_to_fine: bool,
    report: Report,
) -> ObjectModel:
    from advnerf_core.data.epipolar import require_agreeing_poses
    from advnerf_core.objects.voxel.build import build_from_images
    from advnerf_core.objects.voxel.pictures import load_pictures

    listed.require_places()
    for remark in listed.remarks:
        print(remark)
    training, held_out = _split(listed)
    require_agreeing_poses(training.frames, source)
    rule = "split of the data set" if listed.splits else f"every {_HELD_OUT_EVERY}th is held out"
    counts = (
        f"{len(training.frames)} training, {0 if held_out is None else len(held_out.frames)} held-out images"
    )
    print(f"{counts} ({rule})" if held_out is not None else f"{counts} (with 16 or more images, {rule})")
    return build_from_images(
        load_pictures(training, size),
        name,
        resolution,
        (_DEFAULT_STEPS if minutes is None else _NO_STEP_LIMIT) if steps is None else steps,
        {"images": source},
        report,
        None if held_out is None else load_pictures(_spread(held_out), size),
        None if minutes is None else 60.0 * minutes,
        coarse_to_fine,
    )


def _split(listed: PosedImages) -> tuple[PosedImages, PosedImages | None]:
    """Split the images into a training set and, if there are enough images, a held-out set."""
    from advnerf_core.data.views import HELD_OUT_SPLITS, TRAIN

    split = {TRAIN} < set(listed.splits) and not set(listed.splits).isdisjoint(HELD_OUT_SPLITS)
    if not split and len(listed.frames) < _FEWEST_TO_SPLIT:
        return listed.sorted_by_name(), None
    return listed.training_and_held_out(_HELD_OUT_EVERY)


def _spread(listed: PosedImages) -> PosedImages:
    """Keep only the held-out images that are compared. Blender data sets have hundreds, which would waste memory."""
    from advnerf_core.objects.voxel.build import HELD_OUT_VIEWS

    frames, most = listed.frames, HELD_OUT_VIEWS
    return listed.with_frames(
        frames if len(frames) <= most else [frames[k * len(frames) // most] for k in range(most)]
    )


def _print_quality(path: Path, model: ObjectModel) -> None:
    from advnerf_core.objects.voxel.build import advice

    parts = [f"{path}: {_size(model, 2)}"]
    for key, where in (("train_psnr_db", "training"), ("held_out_psnr_db", "held-out")):
        if key in model.about:
            own = model.about.get(key.replace("psnr", "object_psnr"))
            parts.append(
                f"{model.about[key]:.1f} dB on {where} views"
                + ("" if own is None else f" ({own:.1f} dB on the object)")
            )
    print(", ".join(parts))
    for text in [*model.about.get("notes", ()), *advice(model.about), *_thin(model)]:
        print(f"warning: {text}")


def _size(model: ObjectModel, digits: int) -> str:
    """Text with the sides of the mesh, or of the box of all voxels, which reaches up to a voxel farther on each side."""
    sides = model.about.get("source", {}).get(_SIZE)
    said = " x ".join(f"{side:.{digits}f}" for side in (model.size_m if sides is None else sides))
    return f"{said} m" + (" with the voxels at its rim" if sides is None else "")


def _thin(model: ObjectModel) -> list[str]:
    """A warning about a mesh whose shortest side has few voxels."""
    voxels = min(model.about.get("source", {}).get(_SIZE, [math.inf])) / model.grids.voxel
    if voxels >= _FEW_VOXELS or "notes" in model.about:
        return []
    return [f"its shortest side is {voxels:.1f} voxels: it looks wider than it is; raise --resolution"]
