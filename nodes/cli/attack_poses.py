"""The commands of ``advnerf attack`` about where objects stand: ``landscape`` and ``robustness``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.cli.attack import Output
from nodes.runtime.terminal import Overrides

RequestFile = Annotated[
    Path,
    typer.Argument(
        help="A *.experiment.yaml file of one attack in a learned scene of your own, with space.kind places.",
        exists=True,
        dir_okay=False,
    ),
]
FoundAttack = Annotated[
    Path | None,
    typer.Option(
        "--attack",
        help="An attack file that gives poses and colours; without it, those of the request.",
        exists=True,
        dir_okay=False,
    ),
]


def attack_landscape(
    file: RequestFile, output: Output = None, attack: FoundAttack = None, overrides: Overrides = None
) -> None:
    """Map the total CTE over where one object stands: landscape.json and landscape.png; resumes after a kill."""
    import numpy as np

    from nodes.experiment.node.poses import mapped
    from nodes.experiment.node.prepare import load_request
    from nodes.runtime.locks import hold_folder
    from nodes.runtime.progress import ProgressDisplay

    request = load_request(file, overrides or [], output)
    folder, maps = request.folder, request.config.maps
    with hold_folder(folder), ProgressDisplay() as display:
        about, report = mapped(request, attack), display.start("landscape")
        found, picture = about.landscape(maps.landscape, maps.object, folder / "landscape.json", report)
    values = found.total_cte_m
    if np.isnan(values).all():
        print(f"no point of the grid is clear of the lane: {picture}")
        return
    best = np.unravel_index(int(np.nanargmax(values)), values.shape)
    place = (found.x_m[best[0]], found.y_m[best[1]], found.yaw_rad[best[2]])
    print(
        f"total CTE {np.nanmin(values):.1f} to {np.nanmax(values):.1f} m, largest with object {found.object} at "
        f"x {place[0]:.2f} m, y {place[1]:.2f} m, yaw {place[2]:.2f} rad; {np.isnan(values).mean():.0%} of the grid is lane: {picture}"
    )


def attack_robustness(
    file: RequestFile, output: Output = None, attack: FoundAttack = None, overrides: Overrides = None
) -> None:
    """Map what an attack does from other starts and with an object moved: robustness.json and .png; resumes after a kill."""
    import numpy as np

    from nodes.experiment.node.poses import mapped
    from nodes.experiment.node.prepare import load_request
    from nodes.runtime.locks import hold_folder
    from nodes.runtime.progress import ProgressDisplay

    request = load_request(file, overrides or [], output)
    folder, maps = request.folder, request.config.maps
    with hold_folder(folder), ProgressDisplay() as display:
        about, report = mapped(request, attack), display.start("robustness")
        found, picture = about.robustness(maps.robustness, maps.object, folder / "robustness.json", report)
    ratios = found.total_cte_m / found.plain_cte_m
    clear = ratios[np.isfinite(ratios)]
    text = (
        "no move leaves the lane clear"
        if not len(clear)
        else (
            f"ratio to plain colours: median {np.median(clear):.2f}, {clear.min():.2f} to {clear.max():.2f} over {len(clear)} cells"
        )
    )
    print(f"{text}: {picture}")
