"""The commands ``advnerf scene ...``, which train, evaluate, render and show scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nodes.cli import scene_gate as cli_scene_gate
from nodes.cli import scene_import as cli_scene_import
from nodes.runtime.terminal import print_table, table

app = typer.Typer(
    no_args_is_help=True, help="Make posed images from videos, photographs and bags; train and show scenes."
)
app.add_typer(cli_scene_import.app)
cli_scene_gate.add_to(app)

DataSet = Annotated[Path, typer.Argument(help="A transforms.json, or its folder.", exists=True)]
SceneFile = Annotated[
    Path, typer.Argument(help="A scene file (scene.safetensors).", exists=True, dir_okay=False)
]
Size = Annotated[
    tuple[int, int] | None,
    typer.Option("--size", help="Resize the images to this width and height.", show_default="their size"),
]
Corner = Annotated[
    tuple[float, float, float] | None, typer.Option(help="Corner of the scene box, in the unit of the file.")
]
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
def scene_train(
    transforms: DataSet,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the results. A stopped training resumes there.")
    ],
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, show_default="1000 without --minutes; presets with a time: none"),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", min=0.01, help="Train for this many minutes instead of --steps."),
    ] = None,
    box_low: Corner = None,
    box_high: Corner = None,
    size: Size = None,
    open_scene: Annotated[
        bool, typer.Option("--open", help="Outdoor scene: rays may leave the box.")
    ] = False,
    every: Annotated[
        int, typer.Option("--every", min=2, help="Hold out every N-th image.")
    ] = _HELD_OUT_EVERY,
    near: Annotated[
        float | None,
        typer.Option(
            "--near",
            min=0.0,
            help="Learn nothing closer to a camera than this, in the unit of the file.",
            show_default="1/80 of the box's longest side",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed")] = 0,
    checkpoint_every_s: Annotated[
        float,
        typer.Option(
            "--checkpoint-every",
            min=0.0,
            help="Time between checkpoints; the most training that a kill loses [s].",
        ),
    ] = 30.0,
    unbounded: Annotated[
        bool | None,
        typer.Option(
            "--unbounded/--bounded",
            help="Also learn the scene outside the box, to the horizon, with detail that decreases with distance.",
            show_default="unbounded if aabb_scale in the file is more than 1",
        ),
    ] = None,
    preset: Annotated[
        str,
        typer.Option(
            "--preset",
            help="room: for rooms and for training on a CPU (8 levels of 4 features, 2^17 entries, view-independent colours unless "
            "--open or --unbounded). instant-ngp: default sizes of instant-ngp (16 levels of 2 features, 2^19 entries, finest "
            "2048 x aabb_scale, directions to degree 4), for detail and comparisons; slower. minutes, best: for photographs of "
            "any place, sizes and training for 3 and 10 minutes on two cores (view-dependent colours); --minutes changes the time.",
        ),
    ] = "room",
    interval_px: Annotated[
        float | None,
        typer.Option(
            "--interval-px",
            help="Length of a sample interval in image pixels. Smaller values are finer and slower.",
            show_default="4; 1.5 if all cameras stand outside the box",
        ),
    ] = None,
    interval: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--interval",
            help="Shortest and longest sample interval, in the unit of the file.",
            show_default="1/1024 and 1/64 of the box",
        ),
    ] = None,
    interval_growth: Annotated[
        float | None,
        typer.Option(
            "--interval-growth",
            help="Sample interval per distance.",
            show_default="--interval-px / focal length",
        ),
    ] = None,
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure",
            help="Learn a gain per channel for each photograph, for cameras that choose exposure and white balance themselves.",
        ),
    ] = False,
) -> None:
    """Train a scene on posed images and print PSNR and SSIM on the held-out images.

    The alpha channel of images is learned too: transparent areas stay transparent.
    """
    from nodes.lab.scene_training import FIGURES, SCENE, TrainingRequest, train, training_length
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.locks import HeldError, hold
    from nodes.runtime.progress import ProgressDisplay

    if (box_low is None) != (box_high is None):
        raise ConfigError("expected both --box-low and --box-high or neither, got one; add the other")
    steps, minutes = training_length(preset, steps, minutes)
    box = None if box_low is None or box_high is None else (box_low, box_high)
    request = TrainingRequest(
        transforms,
        output,
        steps,
        minutes,
        box,
        size,
        open_scene,
        every,
        near,
        seed,
        checkpoint_every_s,
        unbounded,
        preset,
        interval_px,
        interval,
        interval_growth,
        exposure,
    )
    output.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(output / ".lock")
    except HeldError as error:
        raise ConfigError(
            f"{output} is in use by process {error.owner}; wait until it ends, or stop it"
        ) from None
    with lock, ProgressDisplay() as display:
        figures = train(request, display.start("scene"))
    _print_figures(figures)
    print(f"{output / SCENE}; every image in {output / FIGURES}")


@app.command("eval")
def scene_eval(
    scene: SceneFile,
    transforms: DataSet,
    size: Size = None,
    every: int = _HELD_OUT_EVERY,
    interval_scale: IntervalScale = 1.0,
) -> None:
    """Evaluate a scene on the held-out images of a data set."""
    from advnerf_core.data.dataset import load_transforms
    from advnerf_core.scene.render_field import FieldRenderer
    from nodes.lab.scene_training import evaluate

    renderer = FieldRenderer.from_file(scene, interval_scale=interval_scale)
    _print_figures(evaluate(renderer, load_transforms(transforms).training_and_held_out(every)[1], size))


@app.command("render")
def scene_render(
    scene: SceneFile,
    transforms: DataSet,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the rendered images.")],
    video: Annotated[
        Path | None, typer.Option("--video", help="Also write a video (MP4) through all views.")
    ] = None,
    size: Size = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Render only the cameras of held-out images.")
    ] = False,
    every: int = _HELD_OUT_EVERY,
    interval_scale: IntervalScale = 1.0,
) -> None:
    """Render a scene from the cameras of a data set: colour, depth and, optionally, a video."""
    from advnerf_core.data.dataset import load_transforms
    from advnerf_core.scene.render_field import FieldRenderer
    from nodes.lab.scene_training import render
    from nodes.runtime.progress import ProgressDisplay

    renderer = FieldRenderer.from_file(scene, interval_scale=interval_scale)
    listed = load_transforms(transforms)
    listed = listed.training_and_held_out(every)[1] if held_out else listed.sorted_by_name()
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
        Path | None, typer.Option("--room", help="Room calibration whose path is drawn.", exists=True)
    ] = None,
    port: Annotated[int, typer.Option("--port", min=1, max=65535)] = 8080,
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address to serve on. 0.0.0.0 lets other computers on the network connect."
        ),
    ] = "127.0.0.1",
) -> None:
    """Fly through a scene in the browser."""
    from nodes.lab.scene_view import SceneView

    view = SceneView(scene, transforms, objects or [], room, host, port)
    print(f"http://{host}:{view.port} shows {scene}; press Ctrl-C to stop", flush=True)
    view.serve()


def _print_figures(figures: dict[str, Any]) -> None:
    rows = table("held-out image", "PSNR", "PSNR, gain fitted", "SSIM")
    for row in [*figures["images"], {"image": "mean", **figures["mean"]}]:
        plain, fitted = (f"{row[key]:.2f} dB" for key in ("psnr_db", "gain_fitted_psnr_db"))
        rows.add_row(row["image"], plain, fitted, f"{row['ssim']:.3f}")
    print_table(rows)
