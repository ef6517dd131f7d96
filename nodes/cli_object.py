"""The commands ``advnerf object ...``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import print_table, table

if TYPE_CHECKING:
    from advnerf_core.objects.fit import PosedRgba

app = typer.Typer(no_args_is_help=True, help="Make objects from meshes, photographs or generators, and look at them.")

ObjectPath = Annotated[Path, typer.Argument(help="An object file (*.object.safetensors).", dir_okay=False)]
_TURNTABLE_VIEWS, _TURNTABLE_PIXELS = 8, 240


@app.command("build")
def object_build(
    file: Annotated[Path | None, typer.Argument(help="A mesh: GLB, OBJ, PLY, STL.", dir_okay=False)] = None,
    generate: Annotated[str | None, typer.Option("--generate", help="Instead of a file: hydrant or car.")] = None,
    images: Annotated[
        Path | None, typer.Option("--images", help="Instead of a file: transforms.json of pictures with transparency.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Object file.", show_default="<name>.object.safetensors")
    ] = None,
    resolution: Annotated[
        int, typer.Option("--resolution", min=8, max=128, help="Voxels along the longest side.")
    ] = 64,
    height_m: Annotated[float | None, typer.Option("--height", help="Scale to this height [m].")] = None,
    up: Annotated[str, typer.Option("--up", help="Which axis of the file points up: z or y.")] = "z",
    steps: Annotated[int | None, typer.Option("--steps", min=0, help="Steps of the fit.")] = None,
) -> None:
    """Make an object file."""
    from advnerf_core.objects.build import build_from_images, build_from_mesh
    from advnerf_core.objects.model import save_object
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.progress import ProgressDisplay

    if sum(given is not None for given in (file, generate, images)) != 1:
        raise ConfigError("expected one of FILE, --generate and --images")
    name = generate or (file or Path(images or "").resolve().parent).stem
    with ProgressDisplay() as display:
        report = display.start("object")
        if images is not None:
            views = _cut_out(images)
            model = build_from_images(
                views, name, resolution, 600 if steps is None else steps, {"images": str(images)}, report
            )
        else:
            mesh, source = _mesh(file, generate, up, height_m)
            model = build_from_mesh(mesh, name, resolution, 400 if steps is None else steps, source, report)
    path = output or Path(f"{name}.object.safetensors")
    save_object(path, model)
    size = " x ".join(f"{side:.2f}" for side in model.size_m)
    agreement = model.about.get("held_out_psnr_db")
    print(f"{path}: {size} m" + ("" if agreement is None else f", {agreement:.1f} dB on held-out views"))


@app.command("show")
def object_show(
    file: ObjectPath,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="PNG.", show_default="beside FILE")] = None,
) -> None:
    """Draw an object from eight sides."""
    import cv2
    import numpy as np

    from advnerf_core.files import write_atomically
    from advnerf_core.objects.build import draw_object
    from advnerf_core.objects.model import load_object
    from advnerf_core.objects.views import ring, viewing_lens

    model = load_object(file)
    poses = ring(model.solid_box, _TURNTABLE_VIEWS)
    drawn = draw_object(model, poses, viewing_lens(_TURNTABLE_PIXELS))
    pictures = drawn[..., :3] + 1.0 - drawn[..., 3:]
    half = _TURNTABLE_VIEWS // 2
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in (pictures[:half], pictures[half:])])
    pixels = np.rint(255 * np.clip(sheet[..., ::-1], 0.0, 1.0)).astype(np.uint8)
    path = output or file.with_suffix(".png")
    write_atomically(path, cv2.imencode(".png", pixels)[1].tobytes())
    print(path)


@app.command("info")
def object_info(file: ObjectPath) -> None:
    """Say what an object file holds."""
    from advnerf_core.objects.model import load_object

    model = load_object(file)
    rows = table("what", "value")
    rows.add_row("name", model.name)
    rows.add_row("size", " x ".join(f"{side:.3f}" for side in model.size_m) + " m")
    rows.add_row("voxels", " x ".join(map(str, model.grids.density.shape)) + f" of {1e3 * model.grids.voxel:.1f} mm")
    rows.add_row("free colours", str(int(model.slots.max())))
    for key, value in model.about.items():
        rows.add_row(key, str(value))
    print_table(rows)


def _mesh(file: Path | None, generate: str | None, up: str, height_m: float | None):  # type: ignore[no-untyped-def]
    import hashlib

    from advnerf_core.objects.generators import GENERATORS
    from advnerf_core.objects.mesh import load_mesh, stand
    from nodes.runtime.errors import ConfigError

    if file is not None:
        mesh = load_mesh(file, up, height_m)
        return mesh, {"mesh": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    if generate not in GENERATORS:
        raise ConfigError(f"expected --generate to be one of {', '.join(GENERATORS)}; got {generate!r}")
    return stand(GENERATORS[generate](), height_m=height_m), {"generator": generate}


def _cut_out(transforms: Path) -> PosedRgba:
    import numpy as np

    from advnerf_core.objects.fit import PosedRgba
    from advnerf_core.scene.dataset import load_transforms
    from nodes.runtime.errors import ConfigError

    listed = load_transforms(transforms).sorted_by_name()
    for path in listed.missing:
        print(f"missing, left out: {path}")
    loaded = listed.load()
    if loaded.alpha is None:
        raise ConfigError(
            f"expected pictures with transparency in {transforms}, all are opaque: cut the object out first"
        )
    alpha = loaded.alpha[..., None].astype(np.float32) / 255.0
    rgb = loaded.rgb.astype(np.float32) / (255.0 if loaded.rgb.dtype == np.uint8 else 1.0)
    images = np.concatenate([rgb * alpha, alpha], axis=-1)
    return PosedRgba(images, loaded.T_world_from_camera, tuple(loaded.pinholes))
