"""Pictures of pose attacks: loss landscapes, robustness maps, and placements."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from torch import Tensor

from advnerf_core.attack.pose_maps import Landscape, RobustnessMap
from advnerf_core.attack.spaces.placement import PoseSpace, footprint
from advnerf_core.driving.path import Path
from advnerf_core.geometry import Array, rotation_z
from advnerf_core.report.conditions import style_of
from advnerf_core.report.palette import LIGHT

_COLOURS = "magma"


def draw_landscape(
    found: Landscape, paths: Sequence[Path], marked: dict[str, tuple[float, float]] | None = None
) -> bytes:
    """PNG of a landscape, one panel for each yaw, seen from above; grey is the lane that must stay free.

    Args:
        paths: Reference paths, drawn over it.
        marked: Places to mark by name, ``(x_m, y_m)``.
    """
    panels = len(found.yaw_rad)
    figure = Figure(figsize=(1.5 + 4.2 * panels, 4.6), layout="constrained", facecolor=LIGHT["paper"])
    row = figure.subplots(1, panels, squeeze=False)[0]
    values = found.total_cte_m
    low, high = (
        (float(limit(values)) for limit in (np.nanmin, np.nanmax))
        if np.isfinite(values).any()
        else (0.0, 1.0)
    )
    for k, axes in enumerate(row):
        axes.set_facecolor(LIGHT["grid"])
        x, y = _edges(found.x_m), _edges(found.y_m)
        picture = axes.pcolormesh(
            x, y, np.ma.masked_invalid(values[:, :, k].T), cmap=_COLOURS, vmin=low, vmax=high
        )
        _draw_paths(axes, paths)
        for marker, (name, place) in zip("*oD^", (marked or {}).items(), strict=False):
            axes.plot(*place, marker, color="white", markeredgecolor="black", markersize=11, label=name)
        if marked:
            axes.legend(loc="upper right", fontsize=8)
        axes.set(
            xlim=(x[0], x[-1]),
            ylim=(y[0], y[-1]),
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
            title=f"yaw {np.rad2deg(found.yaw_rad[k]):.0f} deg",
        )
    figure.colorbar(picture, ax=list(row), label="total CTE [m]")
    figure.suptitle(f"total CTE over the place of object {found.object}")
    return _png(figure)


def draw_robustness(found: RobustnessMap) -> bytes:
    """PNG of a robustness map: total CTE, its ratio to plain colours at the same poses, and the largest |CTE|."""
    count, starts = found.total_cte_m.shape
    figure = Figure(
        figsize=(4.5 + 1.5 * starts, 2.4 + 0.35 * count), layout="constrained", facecolor=LIGHT["paper"]
    )
    parts = {
        "total CTE [m]": found.total_cte_m,
        "ratio to plain colours": found.total_cte_m / found.plain_cte_m,
        "largest |CTE| [m]": found.worst_cte_m,
    }
    rows = [f"{m[0]:+.2f}, {m[1]:+.2f} m, {np.rad2deg(m[2]):+.0f}°" for m in found.moves]
    columns = [f"{s[0]:.2f}\n{s[1]:.2f}\n{np.rad2deg(s[2]):.0f}°" for s in found.starts]
    for k, (axes, (name, values)) in enumerate(zip(figure.subplots(1, 3), parts.items(), strict=True)):
        picture = axes.imshow(np.ma.masked_invalid(values), aspect="auto", cmap=_COLOURS)
        axes.set_facecolor(LIGHT["grid"])
        axes.set_title(name)
        axes.set_xticks(range(starts), columns, fontsize=6)
        axes.set_yticks(range(count), rows if k == 0 else [""] * count, fontsize=7)
        axes.set_xlabel("start: x, y [m], yaw")
        figure.colorbar(picture, ax=axes)
        middle = 0.5 * (np.nanmin(values) + np.nanmax(values)) if np.isfinite(values).any() else 0.0
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                axes.text(
                    j,
                    i,
                    f"{value:.2g}",
                    ha="center",
                    va="center",
                    fontsize=6,
                    color="black" if value > middle else "white",
                )
    figure.axes[0].set_ylabel("object moved by")
    return _png(figure)


def draw_placements(
    space: PoseSpace, placements: Tensor, paths: Sequence[Path], drives: dict[str, Array]
) -> bytes:
    """PNG of the objects' placements, seen from above: bounds, footprints before and after, paths and drives.

    Args:
        placements: Current placements ``[K, 4]``.
        drives: Positions ``[T + 1, 2]`` of drives by name.
    """
    figure = Figure(figsize=(7.0, 6.2), layout="constrained", facecolor=LIGHT["paper"])
    axes = figure.subplots()
    _draw_paths(axes, paths)
    for k, field in enumerate(space.objects):
        low, high = footprint(field)
        for name, place, colour in (
            ("before", space.nominal[k], LIGHT["none"]),
            ("found", placements[k], LIGHT["gradient"]),
        ):
            x, y, yaw, scale = place.tolist()
            corners = scale * np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) @ rotation_z(yaw)[
                :2, :2
            ].T + [x, y]
            axes.add_patch(
                Polygon(corners, closed=True, facecolor=colour, alpha=0.6, label=name if k == 0 else None)
            )
            axes.annotate(str(k), (x, y), color=LIGHT["ink"], fontsize=8)
        (x, y), (half_x, half_y) = space.middle[k, :2].tolist(), space.half[k, :2].tolist()
        box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [half_x, half_y] + [x, y]
        axes.add_patch(Polygon(box, closed=True, fill=False, linestyle=":", edgecolor=LIGHT["muted"]))
    for name, xy in drives.items():
        colour = style_of(name).light
        axes.plot(xy[:, 0], xy[:, 1], color=colour, label=f"drive: {name}")
    axes.set(
        aspect="equal", xlabel="x [m]", ylabel="y [m]", title="objects, their bounds (dotted) and the drives"
    )
    axes.legend(fontsize=8)
    return _png(figure)


def _draw_paths(axes: Axes, paths: Sequence[Path]) -> None:
    for path in paths:
        xy = path.pose_at(np.linspace(0.0, path.length_m, 400))[:, :2]
        axes.plot(xy[:, 0], xy[:, 1], "--", color=LIGHT["tape"], linewidth=1.5)


def _edges(centres: Array) -> Array:
    """Borders of cells around ascending centres."""
    if len(centres) == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    inner = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2 * centres[0] - inner[0]], inner, [2 * centres[-1] - inner[-1]]])


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)
    return stream.getvalue()
