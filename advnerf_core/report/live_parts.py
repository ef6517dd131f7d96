"""Parts of the page about an experiment whose drives were live: maps, films, textures, timing, memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from advnerf_core.report import maps, plots, tables
from advnerf_core.report.clips import Frames, data_uri, film_strip, image_uri
from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import ReportData
from advnerf_core.report.summary import key_figures, opening
from advnerf_core.report.targets import evaluate_targets, targets_table

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


@dataclass(frozen=True)
class LiveParts:
    """What an experiment whose drives were live adds to its page.

    Attributes:
        sections: Headings and HTML; missing parts are named as such.
        lead: What the page opens with: what happened in words, and the key figures.
        targets: The targets of the experiment, and whether they were met.
    """

    sections: list[tuple[str, Markup]]
    lead: tuple[str | Markup, ...]
    targets: Markup


def live_parts(data: ReportData) -> LiveParts:
    """The parts of the page about one experiment whose drives were live."""
    drawn = _fragments(data)
    return LiveParts(
        [(heading, Markup(getattr(drawn, name)())) for name, heading in _PARTS],
        (*opening(data), Markup(drawn.key_figures_part())),
        Markup(drawn.targets_part()),
    )


def _fragments(data: ReportData) -> Any:
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = files("advnerf_core.report").joinpath("live.html").read_text(encoding="utf-8")
    return environment.from_string(text).make_module(
        {
            "data": data,
            "style_of": style_of,
            "key_figures": key_figures(data),
            "targets": targets_table(evaluate_targets(data)).html(),
            "hops": tables.hop_table(data).html(),
            "live_tries": tables.live_tries_table(data).html(),
            "memory_rows": tables.memory_table(data).html(),
            "timings": tables.timing_table(data).html(),
            "settings": _settings(data),
            "figures": _figures(data),
            "videos": _videos(data),
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
    for domain in ("surrogate", "deployed"):
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


def _videos(data: ReportData) -> dict[str, list[dict[str, Any]]]:
    """Comparison clips, then single drives while there is room; the rest is named."""
    out: dict[str, list[dict[str, Any]]] = {"comparisons": [], "drives": [], "beside": []}
    wanted = [("comparisons", c.title, c.caption, c.path) for c in data.clips]
    for run in data.runs:
        if run.clip is not None:
            title = f"{run.domain}, {style_of(run.condition).title}, {run.victim} policy, start {run.start + 1}, seed {run.seed}"
            wanted.append(("drives", title, run.note, run.clip))
    embedded, seen = 0, set()
    for group, title, caption, path in wanted:
        if path in seen:
            continue
        seen.add(path)
        if not path.is_file():
            raise FileNotFoundError(
                f"expected the clip {title!r} at {path}, got no such file; run the deploy stage again"
            )
        size = path.stat().st_size
        if embedded + size > MAX_EMBEDDED_BYTES:
            out["beside"].append({"title": title, "name": path.name})
            continue
        embedded += size
        out[group].append(_video(title, caption, path))
    return out


def _video(title: str, caption: str, path: Path) -> dict[str, Any]:
    stills = film_strip(path)
    height, width = stills[0].shape[:2]
    return {
        "title": title,
        "caption": caption,
        "uri": data_uri(path),
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
    number = tables.number
    difference = number(f.steering_difference_rad, 4)
    rows = (
        (
            "camera size",
            str(len(f.views)),
            number(f.mean("psnr_full_db"), 2),
            number(f.mean("ssim_full"), 3),
            "–",  # noqa: RUF001 (typography for readers)
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
    return tables.Table("Surrogate fidelity", columns, rows, (False, *[True] * 4)).html()


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
