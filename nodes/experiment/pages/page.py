"""Parts of the report page about one experiment: the world, the drives, the learned scene, how it was made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from advnerf_core.report.clips import data_uri, image_uri
from advnerf_core.report.conditions import style_of
from advnerf_core.report.palette import LIGHT, LINE_STYLES
from advnerf_core.report.plots import new_axes, svg
from nodes.experiment.engine.artefact import read_artefact
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import FIDELITY
from nodes.experiment.steps import films
from nodes.experiment.steps.attack import cells
from nodes.experiment.steps.frozen import frozen_hashes
from nodes.experiment.steps.steering_gate import steering_of_victims

# Around the drives [m, at 6 m/s].
_MARGIN_M, _SHOWN_VIEWS = 3.0, 3


def sections(
    experiment: Experiment,
    seen: Mapping[str, Mapping[str, NDArray[np.uint8]]],
    overview: NDArray[np.uint8] | None = None,
    clips: Mapping[str, Path] | None = None,
) -> list[tuple[str, Markup]]:
    """Parts of the page about one experiment: headings and HTML.

    Args:
        experiment: With all stages and cells before finished.
        seen: Per path and method, what the camera saw of the objects.
        overview: The world from above; None where it cannot be seen so.
        clips: One film per path; None where nothing was deployed.
    """
    caption = "Paths of the drives, and the places of the objects"
    world = [] if overview is None else [("The world", _picture(overview, caption))]
    drives = [
        (name.capitalize(), Markup("\n").join(_drive(experiment, name, (clips or {}).get(name), seen[name])))
        for name in experiment.config.scenarios
    ]
    return [
        *world,
        *drives,
        ("The learned scene", Markup("\n").join(_fidelity(experiment))),
        ("How it was made", _how(experiment)),
    ]


def opening(experiment: Experiment) -> str:
    """What was done, in one paragraph."""
    attack, things = experiment.config.attack, experiment.objects
    methods = ", ".join(style_of(name).title for name in attack.method_names)
    counts = Counter(thing.kind.replace("_", " ") for thing in things)
    named = " and ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in counts.items())
    return (
        f"Policies ({', '.join(experiment.config.attacked)}) drive {', '.join(experiment.config.scenarios)}. "
        f"{experiment.config.space.searched.format(named)} ({methods}; {attack.evaluations} evaluations each, "
        f"{len(attack.seeds)} seed(s), {attack.starts} start(s), T = {experiment.config.horizon} ticks of {experiment.config.dt_s:g} s){_then(experiment)}. Total CTE is the sum of |CTE| over the drive's ticks; ratios are to the same start past the plain "
        "objects in the same domain."
    )


def _then(experiment: Experiment) -> str:
    if experiment.config.deploy.through == "nothing":
        return "; nothing was driven in the place itself"
    return f", then the opaque objects are put into the world {experiment.named_world.kind} by depth"


def _picture(image: NDArray[np.uint8], caption: str) -> Markup:
    return Markup('<figure><img src="{}" alt="{}"><figcaption>{}</figcaption></figure>').format(
        image_uri(image, 88), caption, caption
    )


def _drive(
    experiment: Experiment, name: str, clip: Path | None, seen: Mapping[str, NDArray[np.uint8]]
) -> list[Markup]:
    text = f"Drives ({name}) from above: dashed in the learned scene{', solid deployed' * (clip is not None)}"
    parts = [
        Markup("<figure>{}<figcaption>{}</figcaption></figure>").format(
            Markup(svg(trajectories(experiment, name), text)), text
        ),
    ]
    if clip is not None:
        parts.append(Markup('<video controls loop muted src="{}"></video>').format(data_uri(clip)))
    return [*parts, *(_picture(image, f"Objects seen: {style_of(key).title}") for key, image in seen.items())]


def trajectories(experiment: Experiment, name: str) -> Figure:
    """All drives of the main victim on one path, from above."""
    path = experiment.paths[name]
    line = path.pose_at(np.linspace(0.0, path.length_m, 300))[:, :2]
    found = [
        cell
        for cell in cells(experiment)
        if cell.scenario == name and cell.victim == experiment.config.main_victim
    ]
    drives = [
        (cell, domain, states)
        for cell in found
        for domain in films.DOMAINS[: 1 if experiment.config.deploy.through == "nothing" else 2]
        for states in films.drives_of(experiment, domain, cell)
    ]
    every = np.concatenate([states[:, :2] for _, _, states in drives])
    margin_m = experiment.along_m(_MARGIN_M)
    low, high = every.min(axis=0) - margin_m, every.max(axis=0) + margin_m
    with new_axes(6.4, float(np.clip(5.6 * (high - low)[1] / (high - low)[0], 2.2, 6.0)) + 0.9) as ax:
        _ground(ax, experiment)
        ax.plot(*line.T, color=LIGHT["tape"], lw=7.0, alpha=0.25, zorder=1)
        for cell, domain, states in drives:
            drawn = {"color": style_of(cell.method).light, "ls": LINE_STYLES[domain], "lw": 1.2, "zorder": 2}
            ax.plot(*states[:, :2].T, label=_label(cell, domain), **drawn)
        entries = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        ax.figure.legend(
            entries.values(), entries.keys(), loc="outside upper left", ncols=3, columnspacing=1.4
        )
        ax.set(xlabel="x [m]", ylabel="y [m]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set_aspect("equal")
    return ax.figure


def _label(cell: Cell, domain: str) -> str:
    return f"{style_of(cell.method).title}, {domain}"


def _ground(ax: Any, experiment: Experiment) -> None:
    """The roads' edges, and the objects."""
    from matplotlib.patches import Polygon

    ax.grid(False)
    for edge in experiment.world.road_edge:
        ax.plot(*edge.T, color=LIGHT["muted"], lw=1.0, zorder=0.5)
    for thing in experiment.objects:
        ax.add_patch(
            Polygon(thing.corners_m(), closed=True, fc=LIGHT["grid"], ec=LIGHT["ink"], lw=1.0, zorder=1.5)
        )


def _fidelity(experiment: Experiment) -> list[Markup]:
    scene = read_json(experiment.stage_folder("scene") / FIDELITY)
    controls = steering_of_victims(experiment)[experiment.config.main_victim]
    difference = float(np.mean([abs(row["real"] - row["surrogate"]) for row in controls]))
    mean, views = scene["mean"], scene["views"]
    text = (
        f"Held-out views of the driving camera: {mean['psnr_full_db']:.1f} dB at full size, {mean['psnr_policy_db']:.1f} dB as the policy sees it; "
        f"the policy's control on true and learned views differs by {difference:.3f} {experiment.car.control_unit} on average."
    )
    parts = [Markup("<p>{}</p>").format(text)]
    for index in np.linspace(0, len(views) - 1, min(_SHOWN_VIEWS, len(views))).round().astype(int):
        pair = [_read(experiment.folder / views[index][f"{name}_image"]) for name in ("real", "surrogate")]
        parts.append(_picture(np.concatenate(pair, axis=1), "True and learned"))
    return parts


def _how(experiment: Experiment) -> Markup:
    manifest = read_json(experiment.folder / "manifest.json")
    frozen = frozen_hashes(experiment)
    records = {
        name: read_artefact(experiment.stage_folder(name))
        for name in ("capture", "scene", "bake", "object", "policy")
    }
    times = ", ".join(
        f"{name} {record.seconds:.0f} s" for name, record in records.items() if record is not None
    )
    hashes = ", ".join(f"{name} {value[:12]}" for name, value in frozen.items())
    return Markup("<p><code>{}</code></p><p>Stages: {}.</p><p>Fixed before the first attack: {}.</p>").format(
        manifest["command"], times, hashes
    )


def _read(path: Path) -> NDArray[np.uint8]:
    import cv2

    return np.ascontiguousarray(cv2.cvtColor(np.asarray(cv2.imread(str(path))), cv2.COLOR_BGR2RGB))
