"""What conditions are called and how they are drawn: the same everywhere, told apart, and the same for a stranger in every process."""

import subprocess
import sys
from contextvars import Context, copy_context
from dataclasses import replace
from functools import wraps
from pathlib import Path

import numpy as np

from advnerf_core.report import plots
from advnerf_core.report.conditions import CONDITIONS, SPARE, know_methods, order_of, style_of
from advnerf_core.report.data import LossCurve, Maximised, ReportData
from advnerf_core.report.palette import DARK, LIGHT
from advnerf_core.report.sections import page_sections

ROOT = Path(__file__).parents[3]
STYLES = {**CONDITIONS, **SPARE}


def alone(test):
    """A test in a context of its own: commands that earlier tests of this process called may have made methods known."""

    @wraps(test)
    def run():
        Context().run(test)

    return run


def test_every_condition_has_a_name_a_marker_and_a_colour_of_its_own():
    for values in ([s.title for s in CONDITIONS.values()], [s.marker for s in STYLES.values()]):
        assert len(set(values)) == len(values)
    for palette in (LIGHT, DARK):
        assert len({palette[key] for key in STYLES}) == len(STYLES)
    assert all(LIGHT[key] == style.light and DARK[key] == style.dark for key, style in STYLES.items())


@alone
def test_a_stranger_is_called_by_its_name_and_keeps_its_colour_in_every_process():
    style = style_of("Spiral")
    assert style.title == "Spiral"
    assert style.key in SPARE
    assert (style.light, style.dark) == (LIGHT[style.key], DARK[style.key])
    code = "from advnerf_core.report.conditions import style_of; print(style_of('Spiral').key)"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT, timeout=600
    )
    assert done.stdout.strip() == style.key
    assert len({style_of(f"method{k}").key for k in range(100)}) == 6


@alone
def test_strangers_of_one_table_never_share_a_colour_and_keep_it_in_any_order():
    names = [f"method{k}" for k in range(len(SPARE))]
    assert len({style_of(name).light for name in names}) < len(names)

    def shown(order, titles=None):
        know_methods((*order, "gradient"), titles)
        return {name: style_of(name) for name in names}

    styles = copy_context().run(shown, names)
    for values in zip(
        *((each.light, each.dark, each.marker, each.key) for each in styles.values()), strict=True
    ):
        assert len(set(values)) == len(names)
    assert copy_context().run(shown, names[::-1]) == styles
    titled = copy_context().run(shown, names, {"method3": "my best"})
    assert [titled[name].title for name in names[2:5]] == ["method2", "my best", "method4"]
    assert style_of("gradient") is CONDITIONS["gradient"]
    assert style_of("method3").title == "method3"  # outside of that context


@alone
def test_a_smaller_part_of_a_known_table_changes_no_colour():
    names = [f"method{k}" for k in range(12)]

    def shown():
        know_methods(names)
        before = [style_of(name) for name in names]
        know_methods(names[5:])
        return before, [style_of(name) for name in names]

    before, after = copy_context().run(shown)
    assert before == after


def test_tables_have_built_in_methods_first_then_strangers_by_name_then_special_drives():
    names = ["empty", "gradient", "zigzag", "none", "Spiral", "cem", "laps", "distilled", "random"]
    ordered = ["none", "random", "cem", "gradient", "distilled", "Spiral", "zigzag", "empty", "laps"]
    assert sorted(names, key=order_of) == ordered


def test_a_stranger_appears_in_the_report(make):
    amplitudes = {"none": 0.05, "Spiral": 0.5, "cem": 0.3, "gradient": 0.6}
    runs = tuple(make.drive("surrogate", name, amplitude) for name, amplitude in amplitudes.items())
    curves = (
        LossCurve("Spiral", np.array([1.0, 3.0, 2.0])),
        LossCurve("gradient", np.array([1.0, 2.0, 3.0])),
    )
    drives = make.drives(runs, curves)
    shown = ["plain object", "cross-entropy", "gradient", "Spiral"]
    legend = [
        text.get_text()
        for text in plots.cte_over_time(drives, "surrogate", "hardened").legends[0].get_texts()
    ]
    assert legend == [f"{name}, surrogate" for name in shown]
    legend = [text.get_text() for text in plots.loss_curves(drives, "hardened").legends[0].get_texts()]
    assert legend == [
        "gradient, one line per seed",
        "Spiral: each texture, best so far",
        "plain object",
    ]
    data = ReportData((drives,), make.manifest())
    assert any("Spiral" in body for _, body in page_sections(data, make.table([])))


def test_searches_for_another_objective_are_drawn_and_tabled_in_its_unit(make):
    runs = tuple(make.drive("surrogate", name, 0.1) for name in ("none", "random"))
    curves = [LossCurve("random", np.array([-8.0, -9.0, -6.0]), plain=-7.0)]
    drives = replace(make.drives(runs, curves), maximised=Maximised("Turn", "deg"))
    (axes,) = plots.loss_curves(drives, "hardened").axes
    assert axes.get_ylabel() == "Turn, learned scene [deg]"
    plain, dots, best = (line.get_ydata() for line in axes.lines)
    assert set(plain) == {-7.0}
    assert list(dots) == [-8.0, -9.0, -6.0]
    assert list(best) == [-8.0, -8.0, -6.0]
    table = make.table([])
    data = ReportData((drives,), make.manifest())
    assert any("Turn [deg] of each evaluation" in body for _, body in page_sections(data, table))
