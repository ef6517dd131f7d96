"""Parts of the page about an experiment whose drives were live: maps, films, textures, timing, memory."""

# ruff: noqa: RUF001 (typography for readers: dashes)

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.report import maps, plots
from advnerf_core.report.clips import Frames, data_uri, film_strip, image_uri
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.data import Clip, Hop, ReportData
from advnerf_core.report.reference import DOMAINS, Domain
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.text_table import Table, count, number

# Videos beyond this stay beside the page: browsers open a 20 MB page at once, a 200 MB page not.
MAX_EMBEDDED_BYTES = 12_000_000
_SHOWN_VIEWS = 6
_DIFFERENCE_GAIN = 4


_PARTS = (
    ("trajectories", "Where the car went"),
    ("clips", "What the camera saw"),
    ("texture", "What the panel showed"),
    ("fidelity", "How true the surrogate is"),
    ("search", "The search"),
    ("timing", "Live timing"),
    ("memory", "Memory against the horizon"),
    ("manifest", "How to make this page again"),
)


def live_sections(data: ReportData, table: ResultTable) -> list[tuple[str, Markup]]:
    """Headings and HTML of an experiment whose drives were live; missing parts are named as such."""
    drawn = _fragments(data, table)
    return [(heading, Markup(getattr(drawn, name)())) for name, heading in _PARTS]


def opening(data: ReportData, table: ResultTable, victim: str = "hardened") -> tuple[str, ...]:
    """The opening paragraphs as plain text: what was done, and what it did to one victim."""
    s = data.settings
    live = any(row.domain == "deployed" and row.method == "gradient" and row.seeds for row in table.rows)
    shown = (
        " Both were then shown to the driving car, frame by frame, by the live node graph." if live else ""
    )
    effects = [_effect(table, victim, domain, s.off_track_m) for domain in DOMAINS]
    story = (
        f"A texture for one flat board was searched for in a learned scene of the room: {s.iterations} gradient steps over "
        f"{s.horizon_steps} control ticks ({s.horizon_steps * s.control_period_s:g} s) from {count(len(s.start_poses), 'start pose')} with "
        f"{count(len(s.seeds), 'seed')}, against the best of {s.random_evaluations} random textures.{shown} In the learned scene the "
        f"cross-track error (CTE, the distance from the tape) {effects[0]}. On the live drive it {effects[1]}."
    )
    small = (
        "This is the small setting: it shows that the whole chain works, and its numbers rest on very few drives. The targets are stated for "
        "the full setting (make experiment)."
    )
    return (story,) if s.name == "full" else (story, small)


def _effect(table: ResultTable, victim: str, domain: Domain, off_track_m: float) -> str:
    scenario = next((row.scenario for row in table.rows), "")
    plain, attacked, random = (
        table.find(scenario, victim, method, domain) for method in (NONE, "gradient", "random")
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
    return text + _warning(plain, off_track_m)


def _warning(plain: TableRow, off_track_m: float) -> str:
    """What must be said of a victim that does not drive without an attack; empty if it drives."""
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
    text = files("advnerf_core.report").joinpath("live.html").read_text(encoding="utf-8")
    embedded, beside = _chosen(data.clips)
    return environment.from_string(text).make_module(
        {
            "data": data,
            "style_of": style_of,
            "hops": _hop_table(data).html(),
            "live_tries": _tries_table(table),
            "memory_rows": _memory_table(data).html(),
            "timings": _timing_table(data).html(),
            "settings": _settings(data),
            "figures": _figures(data),
            "videos": [_video(clip) for clip in embedded],
            "beside": beside,
            "textures": [(t, image_uri(t.image)) for t in data.textures if t.image is not None],
            "views": _views(data),
            "fidelity_rows": _fidelity_numbers(data),
            "notes": [r for r in data.runs if r.note],
            "missing": lambda part: data.not_measured.get(part, ""),
        }
    )


def _figures(data: ReportData) -> dict[str, Any]:
    """Inline SVG of all figures whose data there is, by name."""
    figures: dict[str, Any] = {"victims": []}
    for victim in data.victims:
        figures["victims"].append((victim, _run_figures(data, victim)))
    if data.laps is not None:
        s = data.settings
        figures["laps_map"] = _svg(
            maps.laps_map(data.laps, data.scene), "The drive without attack from above"
        )
        figures["laps_cte"] = _svg(
            plots.laps_cte(data.laps, s.control_period_s, s.off_track_m), "Its cross-track error over time"
        )
    if data.fidelity is not None and len(data.fidelity.steering_rad):
        figures["steering"] = _svg(
            plots.steering_agreement(data.fidelity), "Steering on surrogate against real images"
        )
    if data.latency is not None:
        figures["latency"] = _svg(
            plots.latency_histogram(data.latency), "Histogram of capture-to-serial latency"
        )
    if data.memory:
        figures["memory"] = _svg(plots.memory_against_horizon(data.memory), "Peak memory against the horizon")
    return figures


def _run_figures(data: ReportData, victim: str) -> dict[str, Markup]:
    out = {
        "room": _svg(
            maps.trajectory_map(data, victim=victim),
            f"The room from above with all drives of the {victim} policy",
        ),
        "zoom": _svg(
            maps.trajectory_map(data, zoom=True, victim=victim),
            f"The drives of the {victim} policy, enlarged",
        ),
    }
    for domain in DOMAINS:
        if data.select(victim=victim, domain=domain):
            out[domain] = _svg(
                plots.cte_over_time(data, domain, victim), f"Cross-track error over time, {domain}"
            )
    if any(c.victim == victim for c in data.curves):
        out["curves"] = _svg(
            plots.loss_curves(data, victim), "Total cross-track error per evaluation of the searches"
        )
    return out


def _svg(figure: Any, description: str) -> Markup:
    return Markup(plots.svg(figure, description))


def _chosen(clips: tuple[Clip, ...]) -> tuple[list[Clip], list[Clip]]:
    """Clips to embed while there is room, and the others."""
    embedded: list[Clip] = []
    beside: list[Clip] = []
    room = MAX_EMBEDDED_BYTES
    for clip in clips:
        if not clip.path.is_file():
            raise FileNotFoundError(
                f"expected the clip {clip.title!r} at {clip.path}, got no such file; run the deploy stage again"
            )
        fits = (size := clip.path.stat().st_size) <= room
        room -= size if fits else 0
        (embedded if fits else beside).append(clip)
    return embedded, beside


def _video(clip: Clip) -> dict[str, Any]:
    stills = film_strip(clip.path)
    height, width = stills[0].shape[:2]
    return {
        "title": clip.title,
        "caption": clip.caption,
        "uri": data_uri(clip.path),
        "width": width,
        "height": height,
        "poster": image_uri(stills[-1], quality=80),
        "stills": [image_uri(s, quality=80) for s in stills],
    }


def _views(data: ReportData) -> list[dict[str, Any]]:
    """Image pairs with their difference, of the first few views that carry images."""
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
            "policy's view, 200x66",
            str(len(f.views)),
            number(f.mean("psnr_policy_db"), 2),
            number(f.mean("ssim_policy"), 3),
            difference,
        ),
    )
    columns = ("size", "held-out views", "PSNR [dB]", "SSIM", "mean |steering difference| [rad]")
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
    """Tries of the live drives of each cell, with the reasons of those that did not count."""
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
    cells = [(t.name, number(t.wall_s, 1)) for t in data.timings]
    if cells:
        cells.append(("all stages", number(sum(t.wall_s for t in data.timings), 1)))
    return Table("Stages", ("stage", "wall time [s]"), tuple(cells), (False, True), (len(cells) - 1,))


def _settings(data: ReportData) -> Mapping[str, str]:
    s = data.settings
    poses = "; ".join(f"({x:.2f} m, {y:.2f} m, {np.degrees(yaw):.1f}°)" for x, y, yaw in s.start_poses)
    return {
        "setting": s.name,
        "horizon": f"T = {s.horizon_steps} control ticks of {s.control_period_s:g} s",
        "gradient attack": f"{s.iterations} iterations, Adam, learning rate {s.learning_rate:g}",
        "random search": f"best of {s.random_evaluations}",
        "start poses (x, y, yaw)": poses,
        "seeds": ", ".join(str(seed) for seed in s.seeds),
        "speed": f"{s.speed_mps:g} m/s",
        "off-track": f"|CTE| > {s.off_track_m:g} m",
        **{name: str(value) for name, value in s.extra.items()},
    }
