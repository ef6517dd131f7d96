"""One look for all pages: its variables are enough for every style sheet, and its texts can be read."""

import re
from pathlib import Path

import pytest

from advnerf_core.report.palette import PAGE_DARK, PAGE_LIGHT, look_css

ROOT = Path(__file__).parents[3]
SHEETS = (
    "advnerf_core/report/page.css",
    "advnerf_core/report/page.html",
    "nodes/operator_page/web/page.css",
    "nodes/experiment_page/web/page.css",
)
LEAST_CONTRAST = 4.5  # WCAG 2.2, 1.4.3, level AA


@pytest.mark.parametrize("sheet", SHEETS)
def test_a_page_uses_only_the_colours_of_the_look(sheet):
    text = (ROOT / sheet).read_text()
    used = set(re.findall(r"var\(--([\w-]+)", text)) - {
        "head"
    }  # a length that the page sets where it uses it
    assert used <= set(re.findall(r"--([\w-]+):", look_css()))
    assert not re.findall(r"--[\w-]+:\s*#", text), "a colour of its own"


def luminance(colour):
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("palette", [PAGE_LIGHT, PAGE_DARK], ids=["light", "dark"])
def test_texts_can_be_read_in_both_themes(palette):
    pairs = [
        (name, ground)
        for name in ("ink", "muted", "good", "bad", "warn", "accent")
        for ground in ("paper", "panel")
    ]
    pairs += [("on-accent", "accent"), ("on-stop", "stop")]
    poor = {pair: contrast(*(palette[name] for name in pair)) for pair in pairs}
    assert {pair: value for pair, value in poor.items() if value < LEAST_CONTRAST} == {}
