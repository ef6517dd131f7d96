"""The picture of `advnerf attack check`: derivatives, adjoints over time, saturation, memory and time."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from advnerf_core.attack.closed_loop import ClosedLoopCosine
from advnerf_core.attack.health import TickHealth, TimeSplit
from advnerf_core.report.palette import LIGHT


def draw_health(
    adjoint: Sequence[float],
    frozen: Sequence[float],
    closed: ClosedLoopCosine,
    ticks: TickHealth,
    memory_mib: Mapping[int, float],
    split: TimeSplit,
    unit: str,
) -> bytes:
    """PNG of the measurements.

    Args:
        adjoint: Derivatives along random directions by the adjoint.
        frozen: The same by finite differences with frozen poses.
        closed: The cosine to the true closed loop, over the steps of the finite differences.
        ticks: Diagnostics over time.
        memory_mib: Peak above idle by horizon; may be empty.
        unit: Unit of the objective.
    """
    figure = Figure(figsize=(11.0, 6.0), layout="constrained", facecolor=LIGHT["paper"])
    axes = figure.subplots(2, 3).ravel()
    _derivatives(axes[0], "frozen poses: adjoint is exact here", adjoint, frozen)
    _cosines(axes[1], closed)
    axes[2].set_title("adjoint states")
    position, yaw = (np.maximum(each, 1e-12) for each in (ticks.lambda_position, ticks.lambda_yaw))
    axes[2].semilogy(position, color=LIGHT["none"], label=f"position [{unit}/m]")
    axes[2].semilogy(yaw, color=LIGHT["gradient"], label=f"yaw [{unit}/rad]")
    axes[2].set_xlabel("tick")
    axes[2].legend()
    axes[3].set_title("share of the starts")
    axes[3].step(
        range(len(ticks.saturated)), ticks.saturated, color=LIGHT["gradient"], label="steering saturated"
    )
    if ticks.visible:
        axes[3].step(range(len(ticks.visible)), ticks.visible, color=LIGHT["tape"], label="object seen")
    axes[3].set(ylim=(-0.05, 1.05), xlabel="tick")
    axes[3].legend()
    axes[4].set(title="peak memory above idle, nothing kept", xlabel="horizon [ticks]", ylabel="MiB")
    if memory_mib:
        axes[4].plot(list(memory_mib), list(memory_mib.values()), "o-", color=LIGHT["none"])
        axes[4].set_ylim(bottom=0.0)
    else:
        axes[4].text(0.5, 0.5, "not measured", ha="center", transform=axes[4].transAxes)
    _times(axes[5], split)
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)
    return stream.getvalue()


def _derivatives(axes: Axes, title: str, adjoint: Sequence[float], other: Sequence[float]) -> None:
    reach = 1.1 * max(np.abs([*adjoint, *other]).max(), 1e-12)
    axes.plot([-reach, reach], [-reach, reach], color=LIGHT["grid"])
    axes.plot(adjoint, other, "o", color=LIGHT["gradient"])
    axes.set(title=title, xlabel="by the adjoint", ylabel="by finite differences")


def _cosines(axes: Axes, closed: ClosedLoopCosine) -> None:
    """The cosine at each step with its interval; the steps that agree are filled."""
    axes.axhline(0.0, color=LIGHT["grid"])
    for at in closed.at_steps:
        agrees = closed.plateau is not None and at.step in closed.plateau
        axes.plot([at.step, at.step], [at.low, at.high], color=LIGHT["gradient"])
        axes.plot(at.step, at.cosine, "o", color=LIGHT["gradient"], fillstyle="full" if agrees else "none")
    axes.set(xscale="log", ylim=(-1.05, 1.05), xlabel="step in theta", ylabel="cosine")
    axes.set_title("true closed loop (information)" if closed.plateau else "true closed loop: cannot be told")


def _times(axes: Axes, split: TimeSplit) -> None:
    parts = {
        "render": split.render_s,
        "policy, drive": split.drive_s,
        "policy, backward": split.backward_s,
        "vjp": split.vjp_s,
    }
    axes.barh(list(parts), [1e3 * seconds / split.frames for seconds in parts.values()], color=LIGHT["none"])
    axes.invert_yaxis()
    axes.set(title="time a frame", xlabel="ms")
