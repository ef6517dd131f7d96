"""The pictures of the wiring page are those that ``docs/draw_car.py`` draws, and its markers are a subject that Tracker can tell."""

from itertools import combinations, pairwise
from math import dist

from docs import draw_car


def test_the_pictures_of_the_car_are_drawn_by_their_command():
    stale = [
        file.name for file, text in draw_car.written().items() if file.read_text(encoding="utf-8") != text
    ]
    assert stale == [], "run `python docs/draw_car.py`"


def test_no_symmetry_maps_the_markers_onto_one_another():
    distances_m = sorted(dist(a, b) for a, b in combinations(draw_car.MARKERS_M, 2))
    gaps_m = [b - a for a, b in pairwise(distances_m)]
    assert min(gaps_m) > 0.01
