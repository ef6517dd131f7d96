"""The commands ``advnerf calibrate ...``: each measures one thing and writes a dated YAML file with a picture beside it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.cli import calibrate_display as cli_calibrate_display
from nodes.lab.wizards.output import save_and_print
from nodes.runtime.terminal import RunDir

if TYPE_CHECKING:
    from advnerf_core.geometry import Array
    from calibration.charuco import Board
    from calibration.measured import LensCalibration

app = typer.Typer(
    no_args_is_help=True, help="Measure camera, car, room, monitor and clocks; poor data are refused with the reason."
)

cli_calibrate_display.add_to(app)

Output = Annotated[Path, typer.Option("--output", "-o", help="YAML file to write; its picture goes beside it.")]
Source = Annotated[
    Path | None, typer.Argument(help="Bag folder, or a .mcap, .db3 or .bag file.", exists=True, show_default="--live")
]
Live = Annotated[
    float,
    typer.Option("--live", min=0.0, metavar="SECONDS", help="Record the running launch for so long, and use that."),
]
Lens = Annotated[Path, typer.Option("--lens", help="Lens file (calibrate intrinsics) or camera file.", exists=True)]
Columns = Annotated[int, typer.Option("--columns", help="Squares per row of the ChArUco board.")]
Rows = Annotated[int, typer.Option("--rows", help="Squares per column.")]
SquareM = Annotated[float, typer.Option("--square", help="Side of a square, measured on the print [m].")]
MarkerM = Annotated[
    float | None, typer.Option("--marker", help="Side of a marker [m].", show_default="3/4 of a square")
]
Dictionary = Annotated[str, typer.Option("--dictionary", help="OpenCV's name of the markers.")]
Legacy = Annotated[bool, typer.Option("--legacy", help="The board was printed by OpenCV before 4.6.")]


@app.command("board")
def board(
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG file to print.")], columns: Columns = 6, rows: Rows = 6,
    square_m: SquareM = 0.16, marker_m: MarkerM = None, dictionary: Dictionary = "DICT_4X4_50", legacy: Legacy = False,
) -> None:  # fmt: skip
    """Draw a ChArUco board to print; measure a square of the print and give it to the other commands."""
    import cv2

    from advnerf_core.files import write_atomically

    made = _board(columns, rows, square_m, marker_m, dictionary, legacy)
    write_atomically(output, cv2.imencode(".png", made.picture(200))[1].tobytes())
    width, height = made.size_m
    print(
        f"{output}: print it {1000 * width:.0f} x {1000 * height:.0f} mm, without scaling, and glue it to something flat"
    )


@app.command("intrinsics")
def intrinsics(
    output: Output, source: Annotated[Path | None, typer.Argument(help="Bag, or folder of pictures.", exists=True, show_default="--live")] = None,
    columns: Columns = 6, rows: Rows = 6, square_m: SquareM = 0.16, marker_m: MarkerM = None, dictionary: Dictionary = "DICT_4X4_50",
    legacy: Legacy = False, every: Annotated[int, typer.Option("--every", min=1, help="Look at every so manieth frame.")] = 1,
    most: Annotated[int, typer.Option("--most", min=20, help="At most so many pictures, evenly spread.")] = 80,
    model: Annotated[str, typer.Option("--model", help="Distortion: none, two-radial (k1 k2 p1 p2) or three-radial.")] = "two-radial",
    live_s: Live = 0.0, run_dir: RunDir = None,
) -> None:  # fmt: skip
    """Focal length, principal point and distortion from pictures of a ChArUco board."""
    from calibration.charuco import BoardDetector
    from calibration.intrinsics import IntrinsicsConfig, calibrate_intrinsics
    from calibration.plots import intrinsics_plot
    from calibration.schema import CalibrationError
    from nodes.lab.wizards.bags import IMAGES, read_pictures

    if model not in ("none", "two-radial", "three-radial"):
        raise CalibrationError(f"expected --model none, two-radial or three-radial, got {model!r}")
    detector = BoardDetector(_board(columns, rows, square_m, marker_m, dictionary, legacy))
    views, size, seen = [], (0, 0), 0
    for index, (name, image) in enumerate(read_pictures(_source(source, live_s, run_dir, (IMAGES,), output))):
        if size not in ((0, 0), (image.shape[1], image.shape[0])):
            raise CalibrationError(
                f"expected pictures of one size, {name} has {image.shape[1]} x {image.shape[0]}, the others {size[0]} x {size[1]}"
            )
        size, seen = (image.shape[1], image.shape[0]), seen + 1
        if index % every == 0 and (found := detector.find(image)) is not None:
            views.append(found)
    step = max(1, -(-len(views) // most))
    print(f"board found in {len(views)} of {-(-seen // every)} pictures")
    fit = calibrate_intrinsics(views[::step], size, IntrinsicsConfig(model=model))  # type: ignore[arg-type]
    save_and_print(fit.calibration, output, intrinsics_plot(fit))


@app.command("camera-to-car")
def camera_to_car(
    output: Output, lens: Lens, source: Source = None, columns: Columns = 6, rows: Rows = 6, square_m: SquareM = 0.16,
    marker_m: MarkerM = None, dictionary: Dictionary = "DICT_4X4_50", legacy: Legacy = False,
    board_topic: Annotated[str, typer.Option("--board-topic", help="Poses of the tracked board.")] = "/vicon/board",
    untracked: Annotated[bool, typer.Option("--untracked", help="The board just stands there: hand-eye, the car is tilted by hand.")] = False,
    pattern: Annotated[
        Path | None, typer.Option("--pattern", exists=True, help="Text file of four rows: pose of the print on the tracked board.", show_default="solved for")
    ] = None,
    live_s: Live = 0.0, run_dir: RunDir = None,
) -> None:  # fmt: skip
    """Where the camera sits on the car, from stops before a ChArUco board."""
    from calibration.camera_to_car import calibrate_mount
    from calibration.charuco import BoardDetector
    from calibration.plots import mount_plot
    from nodes.lab.wizards.bags import CAR, IMAGES, still_views

    detector = BoardDetector(_board(columns, rows, square_m, marker_m, dictionary, legacy))
    tracked = None if untracked else board_topic
    bag = _source(source, live_s, run_dir, tuple(t for t in (IMAGES, CAR, tracked) if t), output)
    camera = _lens(lens)
    views, frames = still_views(bag, detector, tracked)
    print(f"{len(views)} stops with the board in view among {frames} frames")
    fit = calibrate_mount(views, camera, None if pattern is None else _transform(pattern))
    save_and_print(fit.calibration(camera), output, mount_plot(fit))


@app.command("mocap-to-scene")
def mocap_to_scene(
    output: Output,
    scene: Annotated[Path, typer.Argument(help="transforms.json of the scene, by structure from motion.", exists=True)],
    mocap: Annotated[Path, typer.Argument(help="transforms.json of the same images with motion-capture poses (advnerf scene from-bag).", exists=True)],
) -> None:  # fmt: skip
    """Scale and frame of a scene in the motion-capture world, from images with poses in both."""
    from advnerf_core.data.dataset import load_transforms
    from calibration.mocap_to_scene import place_scene
    from calibration.plots import scene_plot

    one, two = (
        {frame.path.name: frame.T_world_from_camera for frame in load_transforms(file).frames}
        for file in (scene, mocap)
    )
    fit = place_scene(one, two)
    save_and_print(fit.calibration, output, scene_plot(fit))


@app.command("vehicle")
def vehicle(
    output: Output,
    before: Annotated[Path, typer.Option("--before", exists=True, help="Vehicle file with servo range and limits; those stay.")],
    source: Source = None,
    wheelbase_m: Annotated[float | None, typer.Option("--wheelbase", min=0.05, help="By ruler [m].", show_default="of --before")] = None,
    live_s: Live = 0.0, run_dir: RunDir = None,
) -> None:  # fmt: skip
    """Speed gain, servo gain and offset, rear axle, delay and lag, from circles, straight runs and steps."""
    from calibration.plots import vehicle_plot
    from calibration.schema import VehicleCalibration, load_calibration
    from calibration.vehicle import fit_gains
    from calibration.vehicle_response import fit_response, vehicle_calibration
    from nodes.lab.wizards.bags import CAR, SENT, read_drive

    old = load_calibration(VehicleCalibration, before)
    drive = read_drive(_source(source, live_s, run_dir, (CAR, SENT), output))
    gains = fit_gains(drive, wheelbase_m or old.wheelbase_m)
    response = fit_response(drive, gains)
    new = vehicle_calibration(gains, response, old)
    save_and_print(new, output, vehicle_plot(gains, response))
    g, ahead = new.gains, 1000.0 * gains.origin_ahead_m
    print(f"servo {g.servo_per_rad:.4f} per rad, offset {g.servo_offset:.4f}; {g.erpm_per_mps:.1f} erpm per m/s")
    if abs(ahead) > 10.0:
        print(
            f"the subject's origin is {ahead:.0f} mm ahead of the rear axle: move it there in Tracker, or every cross-track error is off"
        )
    if new.response is not None:
        values = ", ".join(f"{key}: {value}" for key, value in new.response.attack_dynamics().items())
        print(f"for an attack request:\ndynamics: {{{values}}}")


@app.command("time-offset")
def time_offset(
    output: Output, camera: Annotated[Path, typer.Option("--camera", exists=True, help="The camera's file.")], source: Source = None,
    update: Annotated[bool, typer.Option("--update", help="Add the offset to latency_s of the camera's file.")] = False,
    live_s: Live = 0.0, run_dir: RunDir = None,
) -> None:  # fmt: skip
    """How much later the camera stamps an instant than motion capture, from turning the car to and fro."""
    import numpy as np

    from calibration.plots import offset_plot
    from calibration.schema import CameraCalibration, load_calibration, save_calibration
    from calibration.time_offset import fit_offset, image_turns
    from nodes.lab.wizards.bags import CAR, IMAGES, read_frames, read_poses

    known = load_calibration(CameraCalibration, camera)
    bag = _source(source, live_s, run_dir, (IMAGES, CAR), output)
    poses = read_poses(bag, CAR)
    start = int(poses.stamps_ns[0])
    turns = image_turns((((stamp - start) / 1e9, image) for stamp, image in read_frames(bag)), known)
    yaw = np.unwrap(np.arctan2(poses.T[:, 1, 0], poses.T[:, 0, 0]))
    fit = fit_offset(turns, (poses.stamps_ns - start) / 1e9, yaw)
    save_and_print(fit.calibration, output, offset_plot(fit))
    offset = fit.calibration.camera_minus_mocap_s
    # The stamps in the bag are what the camera node made of them with its present latency.
    total = known.latency_s + offset
    if update:
        save_calibration(known.model_copy(update={"latency_s": round(total, 6)}), camera)
    print(
        f"camera {1000 * offset:+.1f} ms behind motion capture; latency_s {known.latency_s:g} -> {total:.4f}"
        + (f" in {camera}" if update else "")
    )


def _board(columns: int, rows: int, square_m: float, marker_m: float | None, dictionary: str, legacy: bool) -> Board:
    from calibration.charuco import Board

    return Board(columns, rows, square_m, 0.75 * square_m if marker_m is None else marker_m, dictionary, legacy)


def _source(source: Path | None, live_s: float, run_dir: Path | None, topics: tuple[str, ...], output: Path) -> Path:
    from calibration.schema import CalibrationError

    if (source is None) == (live_s == 0.0):
        raise CalibrationError("expected either a recording or --live SECONDS")
    if source is not None:
        return source
    from nodes.lab.wizards.live import record_live
    from nodes.launching.watching import find_run_dir

    bag = output.with_name(f"{output.stem}-{time.strftime('%Y%m%d-%H%M%S')}")
    print(f"recording {', '.join(topics)} for {live_s:g} s into {bag}", flush=True)
    return record_live(find_run_dir(run_dir), topics, live_s, bag)


def _lens(file: Path) -> LensCalibration:
    """A lens out of its own file or out of a camera's."""
    from calibration.measured import LensCalibration
    from calibration.schema import CalibrationError, CameraCalibration, load_calibration

    try:
        return load_calibration(LensCalibration, file)
    except CalibrationError as error:
        try:
            camera = load_calibration(CameraCalibration, file)
        except CalibrationError:
            raise error from None
    fields = ("date", "method", "width", "height", "fx", "fy", "cx", "cy", "distortion", "rms_px")
    return LensCalibration(**{key: getattr(camera, key) for key in fields})


def _transform(file: Path) -> Array:
    """A rigid transform ``[4, 4]`` in a text file."""
    import numpy as np

    from calibration.schema import CalibrationError, require_rigid

    try:
        rows = np.loadtxt(file)
        if rows.shape != (4, 4):
            raise ValueError(f"expected four rows of four numbers, got {rows.shape}")
        require_rigid(tuple(map(tuple, rows.tolist())))
    except ValueError as error:
        raise CalibrationError(f"{file}: {error}") from error
    return rows
