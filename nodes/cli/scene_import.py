"""The commands ``advnerf scene from-...``, which make posed images (``transforms.json``) from recordings."""

from __future__ import annotations

import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.splat_options import SplatOptions
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import print_table, scene_argument, table

if TYPE_CHECKING:
    from nodes.lab.importing.data_set import Facts

app = CommandGroup()

Output = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        help="Folder of the data set, written when it is complete. A stopped run resumes from OUTPUT.part.",
    ),
]
Media = Annotated[list[Path], typer.Argument(help="Videos and folders of photographs.", exists=True)]
Bag = Annotated[
    Path, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file of a drive.", exists=True)
]
Most = Annotated[
    int, typer.Option("--most", min=3, help="Use at most this many images of each video, folder or bag.")
]
OneCamera = Annotated[
    bool, typer.Option("--one-camera", help="All images are from one camera with one focal length (no zoom).")
]
ExtentM = Annotated[
    float,
    typer.Option(
        "--extent",
        min=0.001,
        help="Assumed distance between the two camera positions farthest apart [m], if nothing gives the scale.",
    ),
]
Seed = Annotated[int, typer.Option("--seed", help="Random seed.")]
Calibration = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        exists=True,
        dir_okay=False,
        show_default="camera.yaml in the bag",
        help="Camera calibration of the driving camera.",
    ),
]
StepM = Annotated[float, typer.Option("--step", min=0.0, help="Distance between two frames of the bag [m].")]

# More images that were left out are not listed in the terminal.
_SHOWN = 50


@app.command("from-images")
def from_images(
    media: Media,
    output: Output,
    metric: MetricOptions,
    most: Most = 300,
    one_camera: OneCamera = False,
    extent_m: ExtentM = 4.0,
    seed: Seed = 0,
) -> None:
    """Estimate poses and lenses of photographs, and of the sharpest frames of videos. All of them go into one model.

    The images of a folder share a camera unless their sizes or EXIF data differ.
    """
    from calibration.photo_model import SfmConfig
    from nodes.lab.importing.data_set import from_media as run
    from nodes.lab.importing.media import MediaConfig

    config, sfm = MediaConfig(most, one_camera), SfmConfig(seed=seed)
    _run("from-media", output, lambda report: run(media, output, config, sfm, extent_m, metric, report))


@app.command("from-bag")
def from_bag(
    bag: Bag,
    output: Output,
    calibration: Calibration = None,
    step_m: StepM = 0.1,
    most: Most = 300,
    margin_m: Annotated[
        float,
        typer.Option("--margin", min=0.0, help="Margin of the scene box around the car's trajectory [m]."),
    ] = 3.0,
) -> None:
    """Use recorded frames with their motion-capture poses. No pose is estimated."""
    from nodes.lab.importing.data_set import from_bag as run
    from nodes.lab.importing.driven_bag import BagConfig

    config = BagConfig(step_m, math.radians(5.0), most)
    _run("from-bag", output, lambda report: run(bag, output, config, margin_m, report, calibration))


@app.command("from-phone-and-car")
def from_phone_and_car(
    media: Media,
    output: Output,
    bag: Annotated[Path, typer.Option(help="Bag of a drive through the same room.", exists=True)],
    calibration: Calibration = None,
    step_m: StepM = 0.15,
    most: Most = 200,
    one_camera: OneCamera = False,
    seed: Seed = 0,
    tolerance_m: Annotated[
        float,
        typer.Option(
            "--tolerance",
            min=0.001,
            help="Largest accepted distance of a frame from its motion-capture pose [m].",
        ),
    ] = 0.08,
) -> None:
    """Combine phone media and the frames of a bag into one model, metric and in the motion-capture world."""
    from calibration.photo_model import SfmConfig
    from nodes.lab.importing.data_set import from_phone_and_car as run
    from nodes.lab.importing.driven_bag import BagConfig
    from nodes.lab.importing.media import MediaConfig

    media_config = MediaConfig(most, one_camera)
    bag_config = BagConfig(step_m, math.radians(8.0), most)
    _run(
        "from-phone-and-car",
        output,
        lambda report: run(
            media,
            bag,
            output,
            media_config,
            bag_config,
            SfmConfig(seed=seed),
            tolerance_m,
            report,
            calibration,
        ),
    )


@app.command("from-scan")
def from_scan(
    scan: Annotated[
        Path,
        typer.Argument(
            help="Folder or file of Polycam, Record3D, nerfstudio, COLMAP, LLFF, EuRoC or TUM.", exists=True
        ),
    ],
    output: Output,
    metric: MetricOptions,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Images of the scan, if they are not where its format has them.",
            exists=True,
            file_okay=False,
        ),
    ] = None,
    number: Annotated[
        str | None,
        typer.Option("--model", help="Which of several COLMAP models.", show_default="the largest"),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Camera calibration (camera.yaml), if the scan has no lens.", exists=True, dir_okay=False
        ),
    ] = None,
    most: Annotated[
        int | None,
        typer.Option(
            min=3, help="Use at most this many images, evenly spread.", show_default="all; 300 of a recording"
        ),
    ] = None,
) -> None:
    """Use the poses and lenses that scanning software found. No pose is estimated.

    If the scan has no metre, the data set has its unit, unless --length, --positions or --marker gives one.
    """
    from calibration.scans.scan import ScanOptions
    from nodes.lab.importing.scan import from_scan as run

    options = ScanOptions(images, number, calibration, most)
    _run("from-scan", output, lambda report: run(scan, output, options, metric, report))


@app.command("from-splat")
def from_splat(
    splat: Annotated[
        Path,
        typer.Argument(help="A .ply, .spz, .splat or .glb file of Gaussians.", exists=True, dir_okay=False),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene file to write (scene.safetensors).")],
    options: SplatOptions,
) -> None:
    """Make a scene of a Gaussian splat, which is then rendered, baked and attacked like a learned one.

    Invalid, invisible and floating Gaussians are left out and counted.
    """
    from nodes.lab.importing.splat import from_splat as run

    found = run(splat, output, options)
    for each in found.removed:
        print(f"left out: {each.count:,} Gaussians: {each.reason}")
    low, high = (", ".join(f"{value:g}" for value in corner) for corner in found.box)
    print(f"scale: {found.metres_per_unit:.6g} m a unit; box [m]: {low} to {high}")
    if found.psnr_db is not None:
        print(f"it shows the images with a PSNR of {found.psnr_db:.1f} dB (median)")
    print(f"{output}: {found.count:,} Gaussians")


@app.command("match-colours")
def match_colours(
    scene: Annotated[
        Path,
        typer.Argument(
            help="Scene file learned from the phone's images.", exists=True, callback=scene_argument
        ),
    ],
    images: Annotated[
        Path,
        typer.Argument(
            help="transforms_car.json with frames of the driving camera in the same world.", exists=True
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Scene file to write, with the colour map.", show_default="the scene file"
        ),
    ] = None,
    most: Annotated[int, typer.Option(min=1, help="Use at most this many frames, evenly spread.")] = 16,
) -> None:
    """Fit the map from a scene's colours to the driving camera's colours, and store it in the scene file."""
    from nodes.lab.importing.colours import match_colours as run

    result = run(scene, images, output or scene, most)
    print(
        f"{output or scene}: colour map fitted to {result.frames} frames, PSNR {result.before_db:.2f} dB without it, {result.after_db:.2f} dB with it"
    )


def _run(name: str, output: Path, work: Any) -> None:
    from nodes.lab.importing.staging import ALL_TRANSFORMS, work_folder
    from nodes.runtime.progress import ProgressDisplay
    from nodes.runtime.terminal import say_error
    from nodes.runtime.termination import ends_in_order

    code = 0
    try:
        with ends_in_order(), ProgressDisplay() as display:
            facts: Facts = work(display.start(name))
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except SystemExit as asked:
        code = int(asked.code or 0)
    if code:
        kept = work_folder(output)
        going_on = f"finished work is kept in {kept}; run the same command to resume"
        say_error(f"stopped; {going_on if kept.exists() else 'no files were left'}")
        raise typer.Exit(code)
    _print_report(facts)
    print("\n".join(str(output / name) for name in ALL_TRANSFORMS if (output / name).exists()))


def _print_report(facts: Facts) -> None:
    if "recorded_frames" in facts:
        print(
            f"{facts['taken_frames']} of {facts['recorded_frames']} frames used, {facts['without_pose']} had no motion-capture pose"
            + (f"; unchecked: {facts['unchecked']}" if facts.get("unchecked") else "")
        )
    if scan := facts.get("scan"):
        print(f"format: {scan['format']}")
    if colmap := facts.get("scan", {}).get("colmap"):
        sizes = ", ".join(f"{name} ({size} images)" for name, size in colmap["images_by_model"].items())
        print(f"model {colmap['model']}" + (f" of {sizes}; --model uses another" if "," in sizes else ""))
    if model := facts.get("structure_from_motion") or facts.get("model"):
        _print_model(model)
    if placing := facts.get("placing"):
        print(
            f"placed in the motion-capture world by {placing['inliers']} of {placing['cameras']} frames of the car: scale {placing['scale']:.4f}, "
            f"rms {1000 * placing['rms_position_m']:.1f} mm and {math.degrees(placing['rms_rotation_rad']):.2f} degrees"
        )
    if "up" in facts:
        print(f"up: {facts['up']}")
    print(f"scale: {facts['scale']}")


def _print_model(model: dict[str, Any]) -> None:
    rows = table("camera", "images", "lens", "focal length [px]", "distortion")
    for camera, found in model["cameras"].items():
        focal = f"{found['fl_x']:.1f}" + (f", {found['fl_y']:.1f}" if found["fl_y"] != found["fl_x"] else "")
        error = f" +- {found['focal_error_percent']:.1f} %" if found["focal_error_percent"] else ""
        k = ", ".join(f"{value:.4f}" for value in found["distortion"][:4])
        rows.add_row(camera, str(found["registered"]), found["model"], focal + error, k)
    print_table(rows)
    for camera, found in model["cameras"].items():
        print(f"{camera}: {found['model']}: {found['why']}")
    total = model["registered"] + len(model["left_out"])
    error_px = model["reprojection_error_px"]
    error = "" if error_px is None else f", reprojection error {error_px:.2f} px"
    print(f"{model['registered']} of {total} images placed, {model['points']} points{error}")
    for image in model["left_out"][:_SHOWN]:
        print(f"left out: {image['name']}: {image['why']}")
    if (more := len(model["left_out"]) - _SHOWN) > 0:
        print(f"left out: {more} more, which import.json names")
