"""Sections of an experiment's page: maps, films, textures, fidelity, and for live drives their timing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from markupsafe import Markup

from advnerf_core.report import maps, plots
from advnerf_core.report.clips import Frames, image_uri
from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import SHOWN_VIEWS, Drives, ReportData
from advnerf_core.report.pages import HOW, MAX_EMBEDDED_BYTES, fits, fragments
from advnerf_core.report.reference import DOMAINS
from advnerf_core.report.result_table import ResultTable
from advnerf_core.report.text_table import Table, number

_DIFFERENCE_GAIN = 4


def page_sections(data: ReportData, table: ResultTable) -> list[tuple[str, Markup]]:
    """Headings and HTML; parts that were not measured are named as such."""
    drawn = fragments(
        "sections.html",
        data=data,
        image=lambda picture: image_uri(picture, quality=88),
        hops=_hop_table(data).html(),
        live_tries=_tries_table(table),
        timings=_timing_table(data).html(),
        figures=_figures(data),
        textures=[(t, image_uri(t.image)) for t in data.textures],
        pairs_of_views=_views(data),
        fidelity_rows=_fidelity_numbers(data),
        missing=lambda part: data.not_measured.get(part, ""),
    )
    world = [("overview", "The world")] if data.overview is not None else []
    parts = [("texture", "What the panel showed")] if data.textures else []
    parts += [("views", "Learned and real pictures")] if data.fidelity else []
    if data.live:
        parts += [("laps", "Laps without attack"), ("timing", "Live timing")]
    parts.append(("manifest", HOW))

    def made(*wanted: tuple[str, str]) -> list[tuple[str, Markup]]:
        return [(heading, Markup(getattr(drawn, name)())) for name, heading in wanted]

    driven = [(each["drives"].scenario.capitalize(), Markup(drawn.driven(each))) for each in _driven(data)]
    return [*made(("fidelity", "How true the learned scene is"), *world), *driven, *made(*parts)]


def _driven(data: ReportData) -> Iterator[dict[str, Any]]:
    """Content of each scenario's section; films are embedded while there is room, the first scenario's on the first screen."""
    room, whole = MAX_EMBEDDED_BYTES, data.overview is None
    for index, each in enumerate(data.drives):
        embedded = fits(each.film, room)
        room -= each.film.file.stat().st_size if each.film and embedded else 0
        yield {
            "drives": each,
            "pictures": [(name, _run_figures(each, name, whole and bool(each.scene.edges_m))) for name in each.victims],
            "notes": [run for run in each.runs if run.note],
            "film": each.film if embedded and index > 0 else None,
            "beside": "" if each.film is None or embedded else each.film.file.name,
        }  # fmt: skip


def _figures(data: ReportData) -> dict[str, Any]:
    """Inline SVG of all figures with data, by name."""
    made: dict[str, tuple[Any, str]] = {}
    if data.laps is not None:
        scene, dt_s = data.drives[0].scene, data.drives[0].dt_s
        made["laps_map"] = maps.laps_map(data.laps, scene), "The drive without attack from above"
        made["laps_cte"] = (
            plots.laps_cte(data.laps, dt_s, scene.off_track_m),
            "Its cross-track error over time",
        )
    if data.fidelity is not None and len(data.fidelity.steering_rad):
        made["steering"] = plots.steering_agreement(data.fidelity), "Control on learned against real images"
    if data.latency is not None:
        made["latency"] = plots.latency_histogram(data.latency), "Histogram of capture-to-serial latency"
    return {name: plots.svg(*each) for name, each in made.items()}


def _run_figures(driven: Drives, victim: str, whole: bool) -> dict[str, Markup]:
    text = f"All drives of the victim {victim} from above"
    out = {"zoom": plots.svg(maps.trajectory_map(driven, victim), text)}
    if whole:
        out["whole"] = plots.svg(
            maps.trajectory_map(driven, victim, zoom=False), f"{text}, in the whole place"
        )
    for domain in DOMAINS:
        if driven.select(victim=victim, domain=domain):
            figure = plots.cte_over_time(driven, domain, victim)
            out[domain] = plots.svg(figure, f"Cross-track error over time, {domain}")
    if any(c.victim == victim for c in driven.curves):
        figure = plots.loss_curves(driven, victim)
        goal = driven.maximised
        said = "Excess" if goal is None else f"{goal.name} [{goal.unit}]"
        over = " over the plain object" * (goal is None)
        out["curves"] = plots.svg(figure, f"{said} of each evaluation of the searches{over}")
    return out


def _views(data: ReportData) -> list[dict[str, Any]]:
    """Image pairs with their difference, of the first few views with images."""
    out: list[dict[str, Any]] = []
    for view in data.fidelity.views if data.fidelity else ():
        if view.real is not None and view.surrogate is not None and len(out) < SHOWN_VIEWS:
            images = view.real, view.surrogate, _difference(view.real, view.surrogate)
            out.append({"view": view, "images": [image_uri(each) for each in images]})
    return out


def _difference(a: Frames, b: Frames) -> Frames:
    difference = np.abs(a.astype(np.int16) - b.astype(np.int16)).mean(axis=2, keepdims=True)
    return np.repeat(np.clip(_DIFFERENCE_GAIN * difference, 0, 255).astype(np.uint8), 3, axis=2)


def _fidelity_numbers(data: ReportData) -> Markup:
    f = data.fidelity
    if f is None:
        return Markup("")
    rows = tuple(
        (size, str(len(f.views)), number(f.mean(f"psnr_{name}_db"), 2), number(f.mean(f"ssim_{name}"), 3), steers)
        for size, name, steers in (("camera size", "full", ""), ("policy's image", "policy", number(f.steering_difference_rad, 4)))
    )  # fmt: skip
    columns = ("size", "held-out views", "PSNR [dB]", "SSIM", f"mean |control difference| [{f.unit}]")
    return Table("Surrogate fidelity", columns, rows, (False, *[True] * 4)).html()


def _hop_table(data: ReportData) -> Table:
    """Latency per hop, the whole path last."""
    latency = data.latency
    hops = {**latency.hops_ms, "capture to serial write": latency.capture_to_serial_ms} if latency else {}
    cells = tuple(
        (name, str(len(ms)), *(number(value, 1) for value in np.percentile(ms, [50, 95, 99, 100])))
        for name, ms in hops.items()
    )
    columns = ("hop", "frames", "p50 [ms]", "p95 [ms]", "p99 [ms]", "max [ms]")
    return Table("Live latency", columns, cells, (False, *[True] * 5), (len(cells) - 1,))


def _tries_table(table: ResultTable) -> Table:
    """Tries of the live drives of each cell, with the reasons of discarded ones."""
    cells = []
    for cell in table.cells.values():
        spoiled = [reason for tries in cell.extra.get("spoiled_tries", ()) for reason in tries]
        driven = "NOT DRIVEN LIVE" if cell.not_driven_live else "yes"
        named = style_of(cell.method).title, cell.victim, str(cell.seed)
        cells.append((*named, driven, str(len(spoiled)), "; ".join(spoiled)))
    columns = ("object shows", "policy", "seed", "driven live", "spoiled tries", "why they do not count")
    return Table("Live drives", columns, tuple(cells), (False, False, True, False, True, False))


def _timing_table(data: ReportData) -> Table:
    """Wall time of the stages and their sum."""
    timings = data.manifest.timings
    cells = [(name, number(wall_s, 1)) for name, wall_s in timings.items()]
    cells.append(("all stages", number(sum(timings.values()), 1)))
    return Table("Stages", ("stage", "wall time [s]"), tuple(cells), (False, True), (len(cells) - 1,))
