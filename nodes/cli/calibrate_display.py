"""The commands ``advnerf car calibrate display-colours`` and ``advnerf car calibrate display``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.lab.wizards.output import keep_inputs, save_and_print
from nodes.runtime.terminal import RunDir

Output = Annotated[
    Path, typer.Option("--output", "-o", help="YAML file to write. The plot is saved next to it.")
]


def display_colours(
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Folder for the images to show and for shown.csv, which you complete."
        ),
    ],
    width: Annotated[int, typer.Option(min=16, help="Width of the monitor [px].")] = 1920,
    height: Annotated[int, typer.Option(min=16, help="Height of the monitor [px].")] = 1080,
    seed: Annotated[int, typer.Option(help="Random seed of the mixed colours.")] = 0,
) -> None:
    """Write the sequence of plain-colour images to show full-screen for ``car calibrate display``."""
    import numpy as np

    from advnerf_core.data.image_files import write_image
    from advnerf_core.files import write_atomically
    from calibration.display_colour import colours_to_show

    colours = colours_to_show(seed=seed)
    lines = ["file,red,green,blue"]
    for index, (red, green, blue) in enumerate(colours.tolist()):
        picture = np.full((height, width, 3), (red, green, blue), np.uint8)
        write_image(output / "show" / f"{index:03d}.png", picture)
        lines.append(f"seen/{index:03d}.png,{red},{green},{blue}")
    write_atomically(output / "shown.csv", "\n".join(lines) + "\n")
    print(
        f"{len(colours)} images in {output / 'show'}; save the camera image of each under the same name in {output / 'seen'}"
    )


def display(
    output: Output,
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with shown.csv and the camera images. --screen and --twin create it.",
            file_okay=False,
        ),
    ],
    screen: Annotated[
        int | None,
        typer.Option(
            min=0, help="Show the colours on this screen and take the camera images from the running launch."
        ),
    ] = None,
    twin: Annotated[
        Path | None,
        typer.Option(exists=True, help="Socket of the simulated lab: show the colours on its monitor."),
    ] = None,
    conditions: Annotated[
        str, typer.Option(help="Lighting, exposure and monitor settings, stored in the file.")
    ] = "exposure and white balance locked",
    run_dir: RunDir = None,
) -> None:
    """Calibrate how the camera sees the monitor's colours: tone curves, mixing, ambient light, response."""
    from calibration.display_colour import fit_display
    from calibration.plots import display_plot
    from nodes.lab.wizards.bags import read_shown

    keep_inputs(output, folder)
    if screen is not None or twin is not None:
        _show_colours(folder, screen, twin, run_dir)
    fit = fit_display(*read_shown(folder))
    save_and_print(fit.calibration(conditions), output, lambda figure: display_plot(figure, fit))


def _show_colours(folder: Path, screen: int | None, twin: Path | None, run_dir: Path | None) -> None:
    from calibration.display_colour import colours_to_show
    from hardware.screen.display import Display, PygameDisplay, TwinDisplay
    from nodes.lab.wizards.screen import live_frames, show_and_watch
    from nodes.launching.watching import find_run_dir
    from nodes.runtime.progress import ProgressDisplay

    run = find_run_dir(run_dir)
    shown_on: Display = PygameDisplay(screen or 0) if twin is None else TwinDisplay(twin)
    try:
        with ProgressDisplay() as progress:
            show_and_watch(
                shown_on, live_frames(run), colours_to_show().tolist(), folder, progress.start("display")
            )
    finally:
        shown_on.close()
