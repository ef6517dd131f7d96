"""The picture of a set: all deployed drives from above and over time, and camera images with and without the attack."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from PIL import Image

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.evidence.about import ObjectPlace, read_about
from advnerf_core.report.evidence.page import above_of, film_of, filmed_of, has_stills, maps_of
from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.rows import Key
from advnerf_core.report.evidence.verifying.layout import SET
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import STYLE

Floats = NDArray[np.float64]
MOST_BYTES = 250_000
_SIZE_IN, _DPI = (12.0, 6.2), 100
# Left, bottom, width and height in shares of the picture.
_MAP, _TIME = (0.055, 0.085, 0.455, 0.8), (0.59, 0.085, 0.4, 0.165)
_STILLS_LEFT, _STILLS_BOTTOM, _STILL = (0.545, 0.772), (0.35, 0.645), (0.22, 0.24)
_QUALITIES = (90, 80, 65, 50)
# Height of a film's captions as a share, and its frames per second.
_CAPTION, _FILM_HZ, _COLUMNS = 0.2, 5.0, 3
# Left of each of several maps, as a share of its width, and of all of them, as one of the picture's.
_MARGIN, _LEFT = 0.13, 0.02
_BEFORE_S = 1.0  # before the key moment, when the object is in sight
_SPACING = 0.05  # between points along the path, in half lanes


@dataclass(frozen=True)
class DriveGroup:
    """All deployed drives with one condition of the object.

    Attributes:
        poses: ``[T + 1, 3]`` of each drive: x [m], y [m], yaw [rad].
        ctes_m: ``[T]`` signed cross-track error of each drive [m].
    """

    title: str
    colour: str
    poses: Sequence[Floats]
    ctes_m: Sequence[Floats]
    off_track: int
    collided: int

    @property
    def label(self) -> str:
        """The condition and how its drives ended."""
        hit = f", {self.collided} collided" if self.collided else ""
        return f"{self.title}: {self.off_track} of {len(self.poses)} off track{hit}"


def write_above_of(folder: Path) -> Path | None:
    """Write the picture of a published set beside its folder; None if it has no primary test, claim or contrast.

    Of a set whose scenarios share their searches the last one is drawn, with stills of its film; otherwise one map for each.
    """
    data = read_json(folder / SET)
    maps = maps_of(data)
    if not maps:
        return None
    about = read_about(folder.parent).get(folder.name)
    film, target = folder.parent / film_of(folder.name), folder.parent / above_of(folder.name)
    evidence = read_evidence(folder)
    if not has_stills(data):
        return write_maps(evidence, maps, target)
    place = about.object if about else None
    ((shown,),) = maps
    return write_above(evidence, shown, filmed_of(data), place, film, target)


def write_maps(evidence: Evidence, maps: Sequence[Sequence[Mapping[str, Any]]], target: Path) -> Path:
    """Write a picture with one map for each of `maps_of`, and below it the deviation over time."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor="white")
        for number, shown in enumerate(maps):
            scenario = shown[0]["test"]["scenario"]
            groups = groups_of_drives(evidence, shown)
            registered = evidence.registration.scenarios[scenario]
            share = (1.0 - _LEFT) / len(maps)
            left, width = _LEFT + (number + _MARGIN) * share, (1.0 - 1.2 * _MARGIN) * share
            ax = figure.add_axes((left, 0.36, width, 0.46))
            _draw_map(ax, groups, registered.reference_path(), registered.off_track_m, None)
            ax.set_title(scenario.replace("_", " "), pad=20 * len(groups))
            small = {"fontsize": 7.0, "handlelength": 1.2} if len(maps) > 3 else {}
            above = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "frameon": False}
            ax.legend(handles=_handles(groups), **above, **small)
            below = figure.add_axes((left, 0.085, width, 0.15))
            _draw_deviation(below, groups, registered.off_track_m, registered.dt_s)
            if number:  # said once for the row
                below.set_title("")
                for each in (ax, below):
                    each.set_ylabel("")
    write_atomically(target, _webp(figure))
    return target


def write_above(
    evidence: Evidence,
    shown: Mapping[str, Any],
    filmed: Mapping[str, Any],
    place: ObjectPlace | None,
    film: Path,
    target: Path,
) -> Path:
    """Write the picture of a set as a ``.webp``: all drives of ``shown``, and stills of the film of ``filmed``.

    Both are primary tests from ``set.json``. Without the position of the object, or without a film, the picture lacks these.
    """
    groups = groups_of_drives(evidence, [shown])
    registered = evidence.registration.scenarios[shown["test"]["scenario"]]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor="white")
        _draw_map(figure.add_axes(_MAP), groups, registered.reference_path(), registered.off_track_m, place)
        _draw_deviation(figure.add_axes(_TIME), groups, registered.off_track_m, registered.dt_s)
        _draw_stills(figure, evidence, filmed, film)
        handles = [*_handles(groups), Line2D([], [], color=LIGHT["muted"], lw=1.1, label="edge of the track")]
        if place is not None:
            label = "object" + " (estimated)" * place.estimated
            handles.append(Line2D([], [], color=LIGHT["ink"], lw=4.0, label=label))
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.01, 0.995), ncols=len(handles))
    write_atomically(target, _webp(figure))
    return target


def moment_of(evidence: Evidence, key: Key) -> tuple[float, bool]:
    """Time [s] at which the first deployed drive of the first search leaves the track, or deviates most; and whether it left."""
    cell = evidence.searches(key)[0]
    metrics = evidence.metrics(cell, "deployed")[0]
    if metrics.time_to_leaving_s is not None:
        return metrics.time_to_leaving_s, True
    largest = int(np.abs(metrics.ctes_m).argmax())
    return (largest + 1) * evidence.scenario_of(cell).dt_s, False


def groups_of_drives(evidence: Evidence, shown: Sequence[Mapping[str, Any]]) -> list[DriveGroup]:
    """Drives past the plain object, the strongest baseline, where there is one, and the attack, of all victims."""
    keys = [_key(each) for each in shown]
    # Fixed colours of different lightness, for any method.
    plain = _group(evidence, style_of(NONE).title, LIGHT[NONE], [(*key[:2], NONE) for key in keys])
    attack = _group(evidence, style_of(keys[0][2]).title, LIGHT["gradient"], keys)
    baselines = [str(each["baseline"]) for each in shown if each["baseline"]]
    if not baselines:
        return [plain, attack]
    strongest = style_of(baselines[0]).title if len(set(baselines)) == 1 else "strongest baseline"
    of_baselines = [(*key[:2], baseline) for key, baseline in zip(keys, baselines, strict=True)]
    return [plain, _group(evidence, strongest, LIGHT["random"], of_baselines), attack]


def _key(shown: Mapping[str, Any]) -> Key:
    test = shown["test"]
    return test["scenario"], test["victim"], test["method"]


def _group(evidence: Evidence, title: str, colour: str, keys: Sequence[Key]) -> DriveGroup:
    cells = [cell for key in keys for cell in evidence.searches(key)]
    metrics = [each for cell in cells for each in evidence.metrics(cell, "deployed")]
    poses = [drive.poses() for cell in cells for drive in cell.kept["deployed"]]
    off = sum(each.off_track for each in metrics)
    hit = sum(each is not None for cell in cells for each in cell.obstacles("deployed"))
    return DriveGroup(title, colour, poses, [np.array(each.ctes_m) for each in metrics], off, hit)


def _draw_map(
    ax: Any, groups: Sequence[DriveGroup], path: Any, off_track_m: float, place: ObjectPlace | None
) -> None:
    along = np.asarray(path.pose_at(np.arange(0.0, path.length_m, _SPACING * off_track_m)))
    across = np.stack([-np.sin(along[:, 2]), np.cos(along[:, 2])], axis=1)
    for side in (-off_track_m, off_track_m):
        ax.plot(*(along[:, :2] + side * across).T, color=LIGHT["muted"], lw=1.1, zorder=1)
    ax.plot(*along[:, :2].T, color=LIGHT["grid"], lw=1.1, zorder=1)
    for level, group in enumerate(groups):
        for poses in group.poses:
            ax.plot(*poses[:, :2].T, color=group.colour, lw=_width(group), alpha=0.75, zorder=4 - level)
            ax.plot(*poses[-1, :2], "o", ms=2.6, color=group.colour, zorder=5)
    driven = np.concatenate([poses[:, :2] for group in groups for poses in group.poses])
    corners = [driven.min(axis=0) - 1.3 * off_track_m, driven.max(axis=0) + 1.3 * off_track_m]
    if place is not None:
        middle = _draw_object(ax, place)
        corners += [middle - 0.7 * place.width_m, middle + 0.7 * place.width_m]
    box = ax.get_position()
    shape = box.width * _SIZE_IN[0] / (box.height * _SIZE_IN[1])
    low, high = _in_shape(np.min(corners, axis=0), np.max(corners, axis=0), shape)
    ax.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        xlabel="x [m]",
        ylabel="y [m]",
        title="every deployed drive from above; dots: where it ends",
    )
    ax.set_aspect("equal")


def _in_shape(low: Floats, high: Floats, shape: float) -> tuple[Floats, Floats]:
    """Corners of a box around another one, whose width is ``shape`` times its height."""
    size = np.maximum(high - low, [shape * (high - low)[1], (high - low)[0] / shape])
    middle = 0.5 * (low + high)
    return middle - 0.5 * size, middle + 0.5 * size


def _width(group: DriveGroup) -> float:
    """Thinner lines for more drives."""
    return 1.2 if len(group.poses) <= 20 else 0.6


def _draw_object(ax: Any, place: ObjectPlace) -> Floats:
    """Draw the face from above, with an arrow along its front direction; returns its middle."""
    middle = np.array([place.x_m, place.y_m])
    front = np.array([np.cos(place.yaw_rad), np.sin(place.yaw_rad)])
    half = 0.5 * place.width_m * np.array([-front[1], front[0]])
    ax.plot(
        *np.stack([middle - half, middle + half]).T,
        color=LIGHT["ink"],
        lw=4.0,
        solid_capstyle="butt",
        zorder=6,
    )
    arrow = {"arrowstyle": "-|>", "color": LIGHT["ink"], "lw": 1.0}
    ax.annotate("", middle + 0.6 * place.width_m * front, middle, arrowprops=arrow, zorder=6)
    return middle


def _draw_deviation(ax: Any, groups: Sequence[DriveGroup], off_track_m: float, dt_s: float) -> None:
    for side in (-off_track_m, off_track_m):
        ax.axhline(side, color=LIGHT["muted"], lw=1.1, zorder=1)
    ax.axhline(0.0, color=LIGHT["grid"], lw=1.1, zorder=1)
    for level, group in enumerate(groups):
        for ctes_m in group.ctes_m:
            times = dt_s * np.arange(1, len(ctes_m) + 1)
            ax.plot(times, ctes_m, color=group.colour, lw=_width(group), alpha=0.75, zorder=4 - level)
    ax.set(xlabel="time [s]", ylabel="left of the path [m]", title="distance of every drive from the path")
    ax.set_xlim(0.0, dt_s * len(groups[0].ctes_m[0]))
    ax.grid(axis="x", visible=False)


def _draw_stills(figure: Figure, evidence: Evidence, filmed: Mapping[str, Any], film: Path) -> None:
    """Camera images at the key moment and a second before: above with the attack, below past the plain object."""
    when_s, left = moment_of(evidence, _key(filmed))
    moment = "it leaves the track" if left else "it deviates most"
    for at_s, x in zip((max(when_s - _BEFORE_S, 0.0), when_s), _STILLS_LEFT, strict=True):
        views = _frame_at(film, at_s) if film.exists() else None
        note = f" ({moment})" if at_s == when_s else ""
        for column, title, y in (
            (0, f"plain object, {at_s:.1f} s", _STILLS_BOTTOM[0]),
            (2, f"attack, {at_s:.1f} s{note}", _STILLS_BOTTOM[1]),
        ):
            ax = figure.add_axes((x, y, *_STILL))
            ax.set_axis_off()
            ax.set_title(title)
            if views is None:
                ax.text(0.5, 0.5, "no film was kept", ha="center", va="center", transform=ax.transAxes)
            else:
                ax.imshow(views[column], interpolation="bicubic")


def _frame_at(film: Path, when_s: float) -> list[NDArray[np.uint8]]:
    """The pictures of the three drives, without captions, in the film's frame that is nearest to a time."""
    with Image.open(film) as opened:
        opened.seek(min(round(when_s * _FILM_HZ), int(getattr(opened, "n_frames", 1)) - 1))
        frame = np.asarray(opened.convert("RGB"))
    edges = np.linspace(0, frame.shape[1], _COLUMNS + 1).round().astype(int)
    top = round(_CAPTION * frame.shape[0])
    return [frame[top:, begin + 1 : end - 1] for begin, end in pairwise(edges)]


def _handles(groups: Sequence[DriveGroup]) -> list[Line2D]:
    return [Line2D([], [], color=group.colour, lw=2.2, label=group.label) for group in groups]


def _webp(figure: Figure) -> bytes:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI, facecolor="white")
    picture = Image.open(drawn).convert("RGB")
    for quality in _QUALITIES:
        data = io.BytesIO()
        picture.save(data, "WEBP", quality=quality, method=6)
        if data.tell() <= MOST_BYTES:
            break
    return data.getvalue()
