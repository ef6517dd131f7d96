"""The commands ``advnerf scene ...``, which train, evaluate, render and show scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nodes.cli import carla as cli_carla
from nodes.cli import object as cli_object
from nodes.cli import room as cli_room
from nodes.cli import scene_gate as cli_scene_gate
from nodes.cli import scene_import as cli_scene_import
from nodes.cli import world as cli_world
from nodes.cli.panels import in_panels
from nodes.lab.training_request import TrainingRequest
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import listen_address, print_table, scene_argument, table

app = CommandGroup(
    no_args_is_help=True,
    cls=in_panels(
        {
            "Posed images": ("from-images", "from-bag", "from-phone-and-car", "from-scan"),
            "Scenes": ("train", "from-splat", "eval", "render", "view", "match-colours", "gate"),
            "Objects": ("object",),
            "Places to drive": ("world", "room", "carla"),
        }
    ),
    help="Learn scenes from videos, photographs and bags; build objects; check worlds, measure a room, use CARLA.",
)
app.add_typer(cli_scene_import.app)
app.command("gate")(cli_scene_gate.gate)
for name, group in (("object", cli_object), ("world", cli_world), ("room", cli_room), ("carla", cli_carla)):
    app.add_typer(group.app, name=name)

DataSet = Annotated[Path, typer.Argument(help="A transforms.json, or its folder.", exists=True)]
SceneFile = Annotated[
    Path, typer.Argument(help="A scene file (scene.safetensors).", exists=True, callback=scene_argument)
]
Size = Annotated[
    tuple[int, int] | None,
    typer.Option(
        "--size",
        metavar="WIDTH HEIGHT",
        help="Resize the images to this width and height.",
        show_default="their size",
    ),
]
Every = Annotated[int, typer.Option("--every", min=2, help="Every N-th image is held out.")]
IntervalScale = Annotated[
    float,
    typer.Option(
        "--interval-scale",
        min=0.05,
        max=20.0,
        help="Length of a sample interval relative to training. Longer intervals render faster.",
    ),
]
_HELD_OUT_EVERY = 8


@app.command("train")
def scene_train(request: TrainingRequest) -> None:
    """Train a scene on posed images and print PSNR and SSIM on the held-out images.

    The alpha channel of images is learned too: transparent areas stay transparent.
    """
    from nodes.lab.scene_training import FIGURES, SCENE, train
    from nodes.runtime.locks import hold_folder
    from nodes.runtime.progress import ProgressDisplay

    output = request.output
    with hold_folder(output), ProgressDisplay() as display:
        figures = train(request, display.start("scene"))
    _print_figures(figures)
    print(f"{output / SCENE}; every image in {output / FIGURES}")


@app.command("eval")
def scene_eval(
    scene: SceneFile,
    transforms: DataSet,
    size: Size = None,
    every: Every = _HELD_OUT_EVERY,
    interval_scale: IntervalScale = 1.0,
) -> None:
    """Evaluate a scene on the held-out images of a data set."""
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.splats.scene_file import load_renderer
    from nodes.lab.scene_training import evaluate, warn_of

    renderer = load_renderer(scene, interval_scale)
    held_out = load_transforms(transforms).training_and_held_out(every)[1]
    views = held_out.load(size)
    figures = evaluate(renderer, held_out, views)
    warn_of(figures, views)
    _print_figures(figures)


@app.command("render")
def scene_render(
    scene: SceneFile,
    transforms: DataSet,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the rendered images.")],
    video: Annotated[Path | None, typer.Option(help="Also write a video (MP4) through all views.")] = None,
    size: Size = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Render only the cameras of held-out images.")
    ] = False,
    every: Every = _HELD_OUT_EVERY,
    interval_scale: IntervalScale = 1.0,
) -> None:
    """Render a scene from the cameras of a data set: colour, depth and, optionally, a video."""
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.files import refuse_overwriting
    from advnerf_core.splats.scene_file import load_renderer
    from nodes.lab.scene_training import render, rendered_files
    from nodes.runtime.progress import ProgressDisplay

    renderer = load_renderer(scene, interval_scale)
    listed = load_transforms(transforms)
    inputs = [scene, *listed.files]
    listed = listed.training_and_held_out(every)[1] if held_out else listed.sorted_by_name()
    refuse_overwriting(inputs, [*rendered_files(listed, output), *([] if video is None else [video])])
    with ProgressDisplay() as display:
        count = render(renderer, listed, size, output, video, display.start("render"))
    print(f"{count} views in {output}" + ("" if video is None else f", and {video}"))


@app.command("view")
def scene_view(
    scene: SceneFile,
    transforms: Annotated[
        Path | None, typer.Option("--cameras", help="A transforms.json whose cameras are shown.", exists=True)
    ] = None,
    objects: Annotated[
        list[Path] | None, typer.Option("--object", exists=True, help="Object file to place at the origin.")
    ] = None,
    room: Annotated[
        Path | None, typer.Option(help="Room calibration whose path is drawn.", exists=True)
    ] = None,
    listen: Annotated[
        str,
        typer.Option(
            metavar="HOST:PORT",
            help="Where to listen. 0.0.0.0 lets other computers on the network connect.",
        ),
    ] = "127.0.0.1:8080",
) -> None:
    """Fly through a scene in the browser."""
    from nodes.lab.scene_view import SceneView

    host, port = listen_address(listen)
    view = SceneView(scene, transforms, objects or [], room, host.strip("[]"), port)
    print(f"http://{host}:{view.port} shows {scene}; press Ctrl-C to stop", flush=True)
    view.serve()


def _print_figures(figures: dict[str, Any]) -> None:
    rows = table("held-out image", "PSNR", "PSNR, gain fitted", "SSIM")
    for row in [*figures["images"], {"image": "mean", **figures["mean"]}]:
        plain, fitted = (
            "-" if row[key] is None else f"{row[key]:.2f} dB" for key in ("psnr_db", "gain_fitted_psnr_db")
        )
        rows.add_row(row["image"], plain, fitted, f"{row['ssim']:.3f}")
    print_table(rows)
