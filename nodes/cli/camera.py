"""The commands ``advnerf car camera ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import Overrides, fail_unless, print_findings

app = CommandGroup(
    no_args_is_help=True, help="Find cameras, test them, and import the factory calibration of a ZED."
)


@app.command("list")
def camera_list() -> None:
    """List the cameras of this computer: stable paths, formats, sizes, rates, and controls with ranges and values."""
    from nodes.lab.camera_tools import describe_devices, describe_oaks

    lines = [*describe_devices(), *describe_oaks()]
    print("\n".join(lines) if lines else "no video device and no OAK found; check the cable")


@app.command("try")
def camera_try(
    source: Annotated[
        str,
        typer.Argument(
            help="Source as in a launch file, for example '{kind: v4l2, device: /dev/v4l/by-id/...}'."
        ),
    ],
    frames: Annotated[int, typer.Option(min=2, help="Number of frames to read.")] = 50,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Save the last image here (.png, .jpg).")
    ] = None,
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=0.5, help="Give up after this many seconds.")
    ] = 15.0,
) -> None:
    """Read a source as the camera node does; print rate, missed frames, age of the stamps and brightness."""
    from advnerf_core.data.image_files import write_image
    from nodes.lab.camera_tools import parse_source, try_source

    trial = try_source(parse_source(source), frames, timeout_s)
    height, width = trial.picture.shape[:2]
    print(f"{trial.frames} frames of {width} x {height}, {trial.rate_hz:.2f} Hz, {trial.missed} missed")
    print(f"age on arrival: median {trial.age_ms[0]:.1f} ms, worst {trial.age_ms[1]:.1f} ms")
    print(f"mean brightness {trial.brightness:.0f} of 255")
    if counted := ", ".join(f"{name} {value:g}" for name, value in trial.counters.items() if value):
        print(f"counters: {counted}")
    if output is not None:
        write_image(output, trial.picture)
        print(f"saved {output}")


@app.command("check")
def camera_check(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="KIND|SOURCE...",
            help="A kind (v4l2, folder, file.py:Class of your own, ...) with its keys as --set, or a source as in a launch file.",
        ),
    ],
    overrides: Overrides = None,
    shows: Annotated[
        Literal["red", "green", "blue"] | None,
        typer.Option(help="Colour of what is held before the camera; checks the order of colours."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Save the last image here (.png, .jpg): look at it.")
    ] = None,
) -> None:
    """Hold cameras against the contract: form of the images, stamps, reopening, timeouts, stalls.

    Exit code 1 if a part of it is not met.
    """
    from advnerf_core.data.image_files import write_image
    from nodes.lab.camera_check import CameraBench, check_camera
    from nodes.lab.camera_tools import parse_source, source_document
    from nodes.lab.plugin_tables import say_code

    met = True
    for text in sources:
        say_code(source_document(text, overrides or []).data, Path.cwd())
        source = parse_source(text, overrides or [])
        bench = CameraBench(source.camera(), shows=shows or "")
        print(f"{source.kind}:")
        met &= print_findings(check_camera(bench))
        if output is not None and bench.seen:
            write_image(output, bench.seen[-1].rgb)
            print(f"saved {output}")
    fail_unless(met)


@app.command("factory")
def camera_factory(
    factory: Annotated[Path, typer.Argument(help="Factory calibration of the ZED, SN<serial>.conf.")],
    mount: Annotated[Path, typer.Option(help="Camera file from which the pose on the car is copied.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Path of the camera.yaml to write.")],
    mode: Annotated[str, typer.Option(help="Camera mode: 2K, HD1080, HD720 or VGA.")] = "VGA",
    width: Annotated[int, typer.Option(min=1, help="Width of the delivered images [px].")] = 336,
    height: Annotated[int, typer.Option(min=1, help="Height of the delivered images [px].")] = 188,
) -> None:
    """Write the calibration file of a ZED's rectified left eye from its factory calibration."""
    from advnerf_core.files import refuse_overwriting
    from calibration.schema import save_calibration
    from hardware.cameras.zed.calibration import EYE_SIZES
    from nodes.lab.camera_tools import CameraToolError, calibration_from_zed

    if mode not in EYE_SIZES:
        raise CameraToolError(f"expected --mode {', '.join(EYE_SIZES)}; got {mode}")
    largest = EYE_SIZES[mode]
    if width > largest[0] or height > largest[1]:
        raise CameraToolError(
            f"expected at most {largest[0]} x {largest[1]} in mode {mode}; got {width} x {height}. Reduce --width and --height"
        )
    refuse_overwriting((factory, mount), (output,))
    found = calibration_from_zed(factory, mode, (width, height), mount)
    save_calibration(found, output)
    print(f"fx {found.fx:.2f}, fy {found.fy:.2f}, cx {found.cx:.2f}, cy {found.cy:.2f}: saved {output}")
