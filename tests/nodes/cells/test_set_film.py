"""The film of a published set is made of clips on this machine, whatever seeds were registered."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image

from advnerf_core.report.clips import ClipTrack, write_clip
from advnerf_core.report.evidence.page import filmed_of
from nodes.experiment.run.set_film import MOST_BYTES, write_film

# Its searches have the seeds 6 to 11.
PUBLISHED = Path(__file__).parents[3] / "docs" / "results" / "gap_duckietown_robust"


def test_the_film_shows_the_first_seed_of_each_method_or_is_not_made(tmp_path):
    published, run = tmp_path / "results" / PUBLISHED.name, tmp_path / "run"
    shutil.copytree(PUBLISHED, published)
    experiment = SimpleNamespace(folder=run)
    assert write_film(experiment, published) is None  # another machine drove
    for name, grey in (("none_0", 40), ("random_coarse_6", 120), ("gradient_6", 200)):
        frames = np.full((12, 66, 200, 3), grey, np.uint8)
        track = ClipTrack(name, name.rpartition("_")[0], frames, np.zeros(12))
        write_clip(run / "cells" / f"more_hardened_{name}" / "clip.mp4", [track])
    film = write_film(experiment, published)
    assert film is not None
    assert film.stat().st_size <= MOST_BYTES
    shown = np.asarray(Image.open(film).convert("RGB"))
    thirds = [shown[shown.shape[0] // 2 :, k * 253 + 60 : k * 253 + 190].mean() for k in range(3)]
    assert thirds == sorted(thirds)
    assert thirds[2] - thirds[0] > 100.0


def test_of_scenarios_with_searches_of_their_own_the_largest_difference_is_filmed():
    def primary(scenario, surrogate_m, difference_m):
        searches = {"gradient": [{"surrogate_m": surrogate_m}]}
        test = {"scenario": scenario, "method": "gradient"}
        return {"test": test, "searches": searches, "difference_m": difference_m}

    apart = [primary("straight", 0.1, 0.1), primary("right", 0.2, 3.0), primary("left", 0.3, None)]
    assert filmed_of({"primary": apart}) == apart[1]
    shared = [primary("composed", 0.1, 0.1), primary("native", 0.1, 3.0)]
    assert filmed_of({"primary": shared}) == shared[0]
    each = [
        {"scenario": place, "victim": victim, "baseline": "cem", "difference_m": difference_m}
        for place, victim, difference_m in (("cx", "a", 0.1), ("cx", "b", 2.0), ("ct", "a", 1.0))
    ]
    claimed = filmed_of({"primary": [], "claims": [{"method": "gradient", "each": each}]})
    assert (claimed["test"]["scenario"], claimed["test"]["victim"]) == ("cx", "b")
