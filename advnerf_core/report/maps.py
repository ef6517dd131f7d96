"""A place from above: path, edges, objects and drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import Drives, Laps, Run, Scene
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import add_run_legend, end_style, new_axes, run_style

Floats = NDArray[np.float64]

_MARGIN_M = 0.15  # white around what a map shows
_PLAN_IN, _MANY = 4.6, 6  # width of the first screen's map [inch]; drives of an arm that get thin lines


@dataclass(frozen=True, eq=False)
class Arm:
    """Drives past the same object: poses ``[T + 1, 2 or more]`` of each, x [m] and y [m] first."""

    title: str
    condition: str
    poses: Sequence[Floats]


def drives_from_above(scene: Scene, arms: Sequence[Arm]) -> Figure:
    """All drives of some arms from above, with the track and the objects where they stand; for a page's first screen."""
    driven = [np.asarray(poses)[:, :2] for arm in arms for poses in arm.poses]
    box = _box(scene, [*driven, *scene.objects_m, *list(scene.faces_m.values())[:1]])
    with new_axes(_PLAN_IN, min(_height_in(box, width_in=_PLAN_IN) + 0.25, _PLAN_IN)) as ax:
        _draw_scene(ax, scene)
        for level, arm in enumerate(arms):
            line = {"color": style_of(arm.condition).light, "alpha": 0.85, "zorder": 2.0 + 0.1 * level}
            line["lw"] = 1.8 if len(arm.poses) < _MANY else 0.9
            for number, poses in enumerate(arm.poses):
                label = arm.title if number == 0 else None
                ax.plot(*np.asarray(poses)[:, :2].T, label=label, **line)
                ax.plot(*np.asarray(poses)[-1, :2], "o", ms=3, **line)
        _frame(ax, box)
        ax.figure.legend(loc="outside upper left", ncols=3, columnspacing=1.2)
    return ax.figure


def trajectory_map(drives: Drives, victim: str, zoom: bool = True) -> Figure:
    """All drives of one victim from above: either the part that any victim drove, or the whole scene."""
    runs, faces = drives.select(victim=victim), list(drives.scene.faces_m.values())
    driven = _box(drives.scene, [*(run.states[:, :2] for run in drives.runs), *faces[:1]])
    box = driven if zoom else _whole_box(drives.scene)
    with new_axes(6.0, _height_in(box, legend=zoom)) as ax:
        _draw_scene(ax, drives.scene)
        for run in runs:
            ax.plot(run.states[:, 0], run.states[:, 1], **run_style(run))
            ax.plot(*run.states[-1, :2], **end_style(run))
        _draw_starts(ax, runs)
        _frame(ax, box)
        if zoom:
            add_run_legend(ax, runs)
    return ax.figure


def laps_map(laps: Laps, scene: Scene) -> Figure:
    """The drive without attack from above."""
    box = _whole_box(scene)
    with new_axes(6.0, _height_in(box)) as ax:
        _draw_scene(ax, scene)
        ax.plot(laps.states[:, 0], laps.states[:, 1], color=LIGHT["laps"], lw=1.2)
        _frame(ax, box)
    return ax.figure


def band_outline(scene: Scene) -> Outline:
    """The on-track band around the path as one outline; a closed path gives a ring."""
    xy = scene.path_xy_m
    if scene.closed and np.allclose(xy[0], xy[-1]):
        xy = xy[:-1]
    tangent = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0) if scene.closed else np.gradient(xy, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    left, right = xy + scene.off_track_m * normal, (xy - scene.off_track_m * normal)[::-1]
    if not scene.closed:
        return Outline(np.concatenate([left, right]), closed=False)
    # Opposite senses: the fill rule leaves the inside of the ring empty.
    return Outline.make_compound_path(
        *(Outline(np.concatenate([ring, ring[:1]]), closed=True) for ring in (left, right))
    )


def _draw_scene(ax: Any, scene: Scene) -> None:
    ax.grid(False)
    ax.add_patch(PathPatch(band_outline(scene), fc=LIGHT["band"], ec="none", zorder=0.5))
    for edge in scene.edges_m:
        ax.plot(*edge.T, color=LIGHT["ink"], lw=1.2, zorder=1)
    for corners in scene.objects_m:
        ax.add_patch(Polygon(corners, closed=True, fc=LIGHT["grid"], ec=LIGHT["ink"], lw=1.0, zorder=1.5))
    path = np.concatenate([scene.path_xy_m, scene.path_xy_m[:1]]) if scene.closed else scene.path_xy_m
    ax.plot(*path.T, color=LIGHT["tape"], lw=2.6, alpha=0.55, zorder=1.1, solid_joinstyle="round")
    _note(ax, path[len(path) * 5 // 8], "path, on-track band", (0, 12))
    if scene.fence_m is not None:
        ax.add_patch(Polygon(scene.fence_m, fill=False, ec=LIGHT["muted"], lw=1.0, ls=(0, (1, 2)), zorder=1))
        corner = scene.fence_m[np.argmin(scene.fence_m @ [1.0, -1.0])]
        _note(ax, corner, "fence", (4, -9), ha="left")
    for name, segment in scene.faces_m.items():
        _draw_face(ax, segment, name)
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal")


def _draw_face(ax: Any, segment: Floats, name: str) -> None:
    """A face from above, with short strokes on its front side."""
    along = segment[1] - segment[0]
    front = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    ax.plot(*segment.T, color=LIGHT["ink"], lw=4.0, solid_capstyle="butt", zorder=2.5)
    middle = segment.mean(axis=0)
    arrow = {"arrowstyle": "-|>", "color": LIGHT["ink"], "lw": 1.0}
    ax.annotate("", middle + 0.34 * front, middle, arrowprops=arrow)
    away = -11.0 * front
    turn = float(np.degrees(np.arctan2(along[1], along[0])))
    text = {"va": "center", "size": 8.5, "rotation": turn, "rotation_mode": "anchor", "color": LIGHT["ink"]}
    _note(ax, middle, name, (away[0], away[1]), **text)


def _draw_starts(ax: Any, runs: Sequence[Run]) -> None:
    """An arrow along the first heading of every start."""
    for start in sorted({r.start for r in runs}):
        x, y, yaw = next(r.states[0] for r in runs if r.start == start)
        ax.annotate(
            "",
            (x, y),
            (x - 0.3 * np.cos(yaw), y - 0.3 * np.sin(yaw)),
            zorder=3.5,
            annotation_clip=True,
            arrowprops={"arrowstyle": "-|>", "color": LIGHT["ink"], "lw": 1.2},
        )
    if runs:
        _note(ax, runs[0].states[0, :2], "start", (-14, 9))


def _note(ax: Any, at: Floats, text: str, offset_pt: tuple[float, float], **style: Any) -> None:
    shown = {
        "ha": "center",
        "size": 8,
        "color": LIGHT["muted"],
        "annotation_clip": True,
        "zorder": 4,
        **style,
    }
    ax.annotate(text, tuple(at), xytext=offset_pt, textcoords="offset points", **shown)


def _box(scene: Scene, points: Sequence[Floats]) -> Floats:
    """Corners ``[2, 2]`` of the part that holds all points, with a margin of half a lane [m]."""
    xy = np.concatenate(points)
    return np.stack([xy.min(axis=0) - scene.off_track_m, xy.max(axis=0) + scene.off_track_m])


def _whole_box(scene: Scene) -> Floats:
    """Corners ``[2, 2]`` of everything static [m]."""
    xy = np.concatenate([scene.path_xy_m, *scene.edges_m])
    return np.stack([xy.min(axis=0), xy.max(axis=0)])


def _height_in(box: Floats, legend: bool = False, width_in: float = 6.0) -> float:
    """Height of a figure that shows ``box`` to scale without empty stripes [inch]."""
    width_m, height_m = box[1] - box[0] + 2 * _MARGIN_M
    high_in = float(np.clip((width_in - 0.6) * height_m / width_m, 2.0, 0.9 * width_in))
    return high_in + (1.25 if legend else 0.45)


def _frame(ax: Any, box: Floats) -> None:
    ax.set_xlim(box[0, 0] - _MARGIN_M, box[1, 0] + _MARGIN_M)
    ax.set_ylim(box[0, 1] - _MARGIN_M, box[1, 1] + _MARGIN_M)
