"""Sections of an experiment's page: maps, films, textures, fidelity, and for live drives their timing and memory."""

# ruff: noqa: RUF001 (typography for readers: dashes)

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.report import maps, plots
from advnerf_core.report.clips import Frames, data_uri, film_strip, image_uri
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.data import Drives, Hop, ReportData
from advnerf_core.report.reference import DOMAINS, Domain
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.text_table import Table, count, number

# Films beyond this stay beside the page: browsers open a 20 MB page at once, but not a 200 MB page.
MAX_EMBEDDED_BYTES = 12_000_000
_SHOWN_VIEWS = 6
_DIFFERENCE_GAIN = 4


def page_sections(data: ReportData, table: ResultTable) -> list[tuple[str, Markup]]:
    """Headings and HTML; parts that were not measured are named as such."""
    drawn = _fragments(data, table)
    parts = [("overview", "The world")] if data.overview is not None else []
    made = [(heading, Markup(getattr(drawn, name)())) for name, heading in parts]
    made += [(each["drives"].scenario.capitalize(), Markup(drawn.driven(each))) for each in _driven(data)]
    parts = [("texture", "What the panel showed")] if data.textures else []
    parts.append(("fidelity", "How true the learned scene is"))
    if data.live:
        parts += [("laps", "Laps without attack"), ("timing", "Live timing")]
        parts.append(("memory", "Memory against the horizon"))
    parts.append(("manifest", "How to make this page again"))
    return [*made, *((heading, Markup(getattr(drawn, name)())) for name, heading in parts)]


def what_it_did(data: ReportData, table: ResultTable, victim: str) -> list[str]:
    """Effect of the attack on one victim in each scenario, as plain text."""
    deployed = any(row.domain == "deployed" for row in table.rows)
    return [
        f"{each.scenario.capitalize()}: in the learned scene the cross-track error (CTE, the distance from the path) "
        f"{_effect(table, each, victim, 'surrogate')}."
        + (f" Deployed it {_effect(table, each, victim, 'deployed')}." if deployed else "")
        for each in data.drives
    ]


def _effect(table: ResultTable, driven: Drives, victim: str, domain: Domain) -> str:
    plain, attacked, random = (
        table.find(driven.scenario, victim, method, domain) for method in (NONE, "gradient", "random")
    )
    if plain is None or attacked is None or not (plain.excess and attacked.excess):
        return "was not measured in this run"
    text = (
        f"is {attacked.excess.excess_m:.3f} m per tick larger with the gradient texture than past the plain object (total "
        f"{number(attacked.total_m)} m against {number(plain.total_m)} m), and the car left the track in {attacked.off_track} of "
        f"{count(attacked.drives, 'drive')}"
    )
    if random is not None and random.excess is not None:
        text += (
            f"; with the best random texture it is {random.excess.excess_m:.3f} m per tick larger, and the car left in {random.off_track} "
            f"of {random.drives}"
        )
    return text + _warning(plain, driven.scene.off_track_m)


def _warning(plain: TableRow, off_track_m: float) -> str:
    """Warning for a victim that does not drive well without an attack; else empty."""
    mean_m = plain.mean_abs_cte_m or 0.0
    if drives(mean_m, plain.off_track > 0, off_track_m):
        return ""
    return (
        f"; but WITHOUT AN ATTACK THE POLICY DOES NOT DRIVE here (mean |CTE| {mean_m:.3f} m, expected "
        f"<= {mean_cte_limit_m(off_track_m):g} m; off the track in {plain.off_track} of {plain.drives}), so this excess proves nothing"
    )


def _fragments(data: ReportData, table: ResultTable) -> Any:
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = files("advnerf_core.report").joinpath("sections.html").read_text(encoding="utf-8")
    return environment.from_string(text).make_module(
        {
            "data": data,
            "style_of": style_of,
            "image": lambda picture: image_uri(picture, quality=88),
            "hops": _hop_table(data).html(),
            "live_tries": _tries_table(table),
            "memory_rows": _memory_table(data).html(),
            "timings": _timing_table(data).html(),
            "figures": _figures(data),
            "textures": [(t, image_uri(t.image)) for t in data.textures if t.image is not None],
            "views": _views(data),
            "fidelity_rows": _fidelity_numbers(data),
            "missing": lambda part: data.not_measured.get(part, ""),
        }
    )


def _driven(data: ReportData) -> Iterator[dict[str, Any]]:
    """Content of each scenario's section; films are embedded while there is room."""
    room = MAX_EMBEDDED_BYTES
    for each in data.drives:
        size = _size(each.film)
        fits = size <= room
        room -= size if fits else 0
        yield {
            "drives": each,
            "pictures": [
                (victim, _run_figures(each, victim, data.overview is None and bool(each.scene.edges_m)))
                for victim in each.victims
            ],
            "notes": [run for run in each.runs if run.note],
            "film": _video(each.film) if each.film and fits else None,
            "beside": "" if each.film is None or fits else each.film.name,
        }


def _size(film: Path | None) -> int:
    if film is None:
        return 0
    if not film.is_file():
        raise FileNotFoundError(f"expected the film {film}, got no such file; run the report stage again")
    return film.stat().st_size


def _figures(data: ReportData) -> dict[str, Any]:
    """Inline SVG of all figures with data, by name."""
    figures: dict[str, Any] = {}
    if data.laps is not None:
        scene, dt_s = data.drives[0].scene, data.drives[0].dt_s
        figures["laps_map"] = _svg(maps.laps_map(data.laps, scene), "The drive without attack from above")
        figures["laps_cte"] = _svg(
            plots.laps_cte(data.laps, dt_s, scene.off_track_m), "Its cross-track error over time"
        )
    if data.fidelity is not None and len(data.fidelity.steering_rad):
        figures["steering"] = _svg(
            plots.steering_agreement(data.fidelity), "Control on learned against real images"
        )
    if data.latency is not None:
        figures["latency"] = _svg(
            plots.latency_histogram(data.latency), "Histogram of capture-to-serial latency"
        )
    if data.memory:
        figures["memory"] = _svg(plots.memory_against_horizon(data.memory), "Peak memory against the horizon")
    return figures


def _run_figures(driven: Drives, victim: str, whole: bool) -> dict[str, Markup]:
    text = f"All drives of the victim {victim} from above"
    out = {"zoom": _svg(maps.trajectory_map(driven, victim), text)}
    if whole:
        out["whole"] = _svg(maps.trajectory_map(driven, victim, zoom=False), f"{text}, in the whole place")
    for domain in DOMAINS:
        if driven.select(victim=victim, domain=domain):
            figure = plots.cte_over_time(driven, domain, victim)
            out[domain] = _svg(figure, f"Cross-track error over time, {domain}")
    if any(c.victim == victim for c in driven.curves):
        figure = plots.loss_curves(driven, victim)
        out["curves"] = _svg(figure, "Total cross-track error per evaluation of the searches")
    return out


def _svg(figure: Any, description: str) -> Markup:
    return Markup(plots.svg(figure, description))


def _video(film: Path) -> dict[str, Any]:
    stills = film_strip(film)
    height, width = stills[0].shape[:2]
    return {
        "uri": data_uri(film),
        "width": width,
        "height": height,
        "poster": image_uri(stills[-1], quality=80),
        "stills": [image_uri(s, quality=80) for s in stills],
    }


def _views(data: ReportData) -> list[dict[str, Any]]:
    """Image pairs with their difference, of the first few views with images."""
    out: list[dict[str, Any]] = []
    for view in data.fidelity.views if data.fidelity else ():
        if view.real is not None and view.surrogate is not None and len(out) < _SHOWN_VIEWS:
            images = [
                image_uri(view.real),
                image_uri(view.surrogate),
                image_uri(_difference(view.real, view.surrogate)),
            ]
            out.append({"view": view, "images": images})
    return out


def _difference(a: Frames, b: Frames) -> Frames:
    difference = (
        np.abs(a.astype(np.int16) - b.astype(np.int16)).mean(axis=2, keepdims=True) * _DIFFERENCE_GAIN
    )
    return np.repeat(np.clip(difference, 0, 255).astype(np.uint8), 3, axis=2)


def _fidelity_numbers(data: ReportData) -> Markup:
    f = data.fidelity
    if f is None:
        return Markup("")
    difference = number(f.steering_difference_rad, 4)
    rows = (
        (
            "camera size",
            str(len(f.views)),
            number(f.mean("psnr_full_db"), 2),
            number(f.mean("ssim_full"), 3),
            "–",
        ),
        (
            "policy's image",
            str(len(f.views)),
            number(f.mean("psnr_policy_db"), 2),
            number(f.mean("ssim_policy"), 3),
            difference,
        ),
    )
    columns = ("size", "held-out views", "PSNR [dB]", "SSIM", f"mean |control difference| [{f.unit}]")
    return Table("Surrogate fidelity", columns, rows, (False, *[True] * 4)).html()


def _hop_table(data: ReportData) -> Table:
    """Latency per hop, the whole path last."""
    hops: tuple[Hop, ...] = () if data.latency is None else (*data.latency.hops, data.latency.overall)
    cells = tuple(
        (h.name, str(h.count), *(number(v, 1) for v in (h.p50_ms, h.p95_ms, h.p99_ms, h.max_ms)))
        for h in hops
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


def _memory_table(data: ReportData) -> Table:
    """Peak memory against the horizon."""
    cells = tuple((str(row.horizon_steps), number(row.adjoint_mib, 1)) for row in data.memory)
    return Table("Peak memory above idle", ("T", "adjoint [MiB]"), cells, (True, True))


def _timing_table(data: ReportData) -> Table:
    """Wall time of the stages and their sum."""
    timings = data.manifest.timings
    cells = [(name, number(wall_s, 1)) for name, wall_s in timings.items()]
    cells.append(("all stages", number(sum(timings.values()), 1)))
    return Table("Stages", ("stage", "wall time [s]"), tuple(cells), (False, True), (len(cells) - 1,))
