import dataclasses
import itertools

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from advnerf_core.geometry import make_transform, rotation_z
from advnerf_core.report import maps, plots
from advnerf_core.report.conditions import CONDITIONS
from advnerf_core.report.data import face_segment
from advnerf_core.report.palette import DARK, LIGHT

# Machado, Oliveira and Fernandes 2009: dichromacy (severity 1) on linear RGB.
DICHROMATS = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "none": np.eye(3),
}


def lab(colours, seen):
    rgb = np.array([to_rgb(c) for c in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ np.array(seen).T
    linear = np.clip(linear, 0, 1)
    back = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return cv2.cvtColor(back[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0]


@pytest.mark.parametrize("seen", DICHROMATS)
@pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
def test_conditions_differ_for_colour_blind_readers(palette, seen):
    colours = lab([palette[c] for c in ("none", "random", "gradient")], DICHROMATS[seen])
    distances = [np.linalg.norm(colours[i] - colours[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(distances) > 25  # CIE 1976; 2.3 is just noticeable


@pytest.mark.parametrize(("seen", "least"), [("none", 20), ("protanopia", 8), ("deuteranopia", 8)])
@pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
def test_colours_of_all_conditions_are_told_apart(palette, seen, least):
    places = lab([palette[name] for name in CONDITIONS], DICHROMATS[seen])
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(places, 2)) > least


def test_palette_colours_are_distinct_and_all_themed():
    assert len(set(LIGHT.values())) == len(LIGHT)
    assert LIGHT.keys() == DARK.keys()


def test_face_segment_ends_and_front():
    T = make_transform(rotation_z(np.pi), [3.0, 1.0, 0.4])
    segment = face_segment(T, 0.8)
    np.testing.assert_allclose(segment, [[3.0, 1.4], [3.0, 0.6]], atol=1e-12)
    along = segment[1] - segment[0]
    np.testing.assert_allclose([along[1], -along[0]] / np.linalg.norm(along), [-1.0, 0.0], atol=1e-12)


def test_band_contains_exactly_the_points_near_the_path(make):
    scene = make.scene()
    band = maps.band_outline(scene)
    points = np.array(
        [[0.0, -2.0], [0.0, -2.39], [0.0, -1.61], [0.0, -2.42], [0.0, -1.58], [0.0, 0.0], [2.0, 0.0]]
    )
    # Even-odd by hand: inside the outer ring and not inside the inner one.
    rings = [r for r in band.to_polygons(closed_only=True)]
    inside = sum(cv2_inside(r, points) for r in rings) % 2 == 1
    assert inside.tolist() == [True, True, True, False, False, False, True]


def cv2_inside(ring, points):
    contour = ring.astype(np.float32)
    return np.array(
        [cv2.pointPolygonTest(contour, (float(x), float(y)), False) >= 0 for x, y in points]
    ).astype(int)


def test_svg_follows_the_theme_and_loads_nothing(report):
    text = plots.svg(plots.cte_over_time(report.drives[0], "deployed", "hardened"), 'drives & "errors" \\1')
    assert "var(--gradient)" in text
    assert not any(colour in text for colour in LIGHT.values())
    assert "http" not in text
    assert 'aria-label="drives &amp; &#34;errors&#34; \\1"' in text


def test_figures_that_are_compared_have_the_same_axes(report):
    drives, victims = report.drives[0], ("hardened", "naive")
    axes = [plots.cte_over_time(drives, d, v).axes[0] for d in ("surrogate", "deployed") for v in victims]
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in axes}) == 1
    others = [
        dataclasses.replace(curve, victim="naive", values=3.0 * curve.values) for curve in drives.curves
    ]
    both = dataclasses.replace(drives, curves=(*drives.curves, *others))
    axes = [plots.loss_curves(both, victim).axes[0] for victim in victims]
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in axes}) == 1
    maps_of = [maps.trajectory_map(drives, victim).axes[0] for victim in victims]
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in maps_of}) == 1


def test_png_is_written_whole(report, tmp_path):
    path = plots.write_png(maps.trajectory_map(report.drives[0], "hardened"), tmp_path / "map.png", dpi=50)
    assert cv2.imread(str(path)).shape[1] == pytest.approx(300, abs=30)
    assert [p.name for p in tmp_path.iterdir()] == ["map.png"]
