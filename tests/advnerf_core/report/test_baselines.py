"""What pages say of a set's baselines, and of whether it can be driven again, by sets that are published with the code."""

from pathlib import Path

import pytest

from advnerf_core.report.evidence.families import families_note, lacking_baselines
from advnerf_core.report.evidence.kept_build import LOST, is_kept, lost_note
from advnerf_core.report.evidence.registration import PrimaryTest, RegisteredCell, read_registration
from advnerf_core.report.evidence.results import read_evidence
from benchmarks.strongest import strongest_random

PUBLISHED = Path(__file__).parents[3] / "docs" / "results"


def test_published_sets_are_marked_with_what_their_baselines_lack():
    (note,) = families_note(read_registration(PUBLISHED / "gap_duckietown"))
    assert (
        "One family of random textures only; no coarse search; baseline of other cells (random, coarse)"
        in note
    )
    (room,) = families_note(read_registration(PUBLISHED / "room"))
    assert "best random, random, coarse, each with as many evaluations" in room
    assert "2 families of random textures only" in room
    # The textures of 1/f noise have the gradient's own cells.
    (pink,) = families_note(read_registration(PUBLISHED / "gap_filament"))
    assert "other cells" not in pink


def test_a_set_with_all_baselines_has_no_mark():
    registration = read_registration(PUBLISHED / "room")
    against = ("random_coarse", "random_levels", "random_pink", "cem")
    ran = [
        RegisteredCell(scenario="track", victim="hardened", method=method, seed=0)
        for method in (*against, "gradient", "gradient_coarse")
    ]
    test = PrimaryTest(scenario="track", victim="hardened", method="gradient", against=against)
    (note,) = families_note(registration.model_copy(update={"cells": tuple(ran), "primary": (test,)}))
    assert "**" not in note
    # The same without the gradient in the coarse cells.
    (note,) = families_note(registration.model_copy(update={"cells": tuple(ran[:-1]), "primary": (test,)}))
    assert "**baseline of other cells (random, coarse, cross-entropy) than the gradient's.**" in note


def test_places_and_shapes_have_one_baseline_without_a_mark():
    registration = read_registration(PUBLISHED / "room")
    track = registration.scenarios["track"]
    of_shapes = track.model_copy(update={"space": {"kind": "mesh_shape", "bound_m": 1.0}})
    test = PrimaryTest(scenario="track", victim="hardened", method="gradient", against=("random",))
    update = {"scenarios": {"track": of_shapes}, "primary": (test,)}
    (note,) = families_note(registration.model_copy(update=update))
    assert note.startswith("*Baseline*: random places or shapes")
    assert "**" not in note


def test_what_is_lacking_is_said_at_once():
    families = ("random_coarse", "random_levels", "random_pink")
    assert lacking_baselines((*families, "cem"), False, families) == []
    found = lacking_baselines(("random_pink", "gradient"), True, families)
    assert found[0] == "2 more of the random textures random_coarse, random_levels"
    assert found[1] == "a coarse search (cem or evolution)"
    assert found[2].startswith("gradient_coarse")


@pytest.mark.parametrize("name", ["room", "paper_car", "paper_junction"])
def test_sets_with_their_scene_and_victim_can_be_driven_again(name):
    assert is_kept(PUBLISHED / name)
    assert lost_note(PUBLISHED / name) == []


@pytest.mark.parametrize(
    "name",
    [
        "gap_duckietown",
        "gap_duckietown_robust",
        "gap_filament",
        "gap_metadrive",
        "gap_metadrive_unseen",
        "gap_room",
    ],
)
def test_sets_whose_weights_are_lost_say_so(name):
    assert not is_kept(PUBLISHED / name)
    assert lost_note(PUBLISHED / name) == [f"This set {LOST}.\n"]


def test_the_best_random_search_is_a_maximum_over_searches():
    (found,) = strongest_random(PUBLISHED / "room")
    evidence = read_evidence(PUBLISHED / "room")
    # By hand, from poses alone: total CTE of each drive minus that without attack from the same start, per tick.
    path, ticks = evidence.registration.scenarios["track"].reference_path(), 60
    none = evidence.cells["track_hardened_none_0"].kept["deployed"]

    def total_m(drive):
        driven = abs(path.project(drive.poses()[1 : drive.driven_ticks + 1, :2]).cte_m)
        return driven.sum() + (ticks - len(driven)) * min(
            driven[-1], evidence.registration.scenarios["track"].held_cap_m
        )

    by_search = []
    for seed in range(6):
        drives = evidence.cells[f"track_hardened_random_coarse_{seed}"].kept["deployed"]
        pairs = zip(drives, none, strict=True)
        by_search.append(sum((total_m(one) - total_m(other)) / ticks for one, other in pairs) / len(drives))
    assert found.method == "random_coarse"
    assert found.deployed.best_m == pytest.approx(max(by_search), abs=1e-9)
    assert found.deployed.mean_m == pytest.approx(sum(by_search) / 6, abs=1e-9)
    assert (found.deployed.all_off_track, found.deployed.all_drives) == (20, 30)
    assert found.deployed.best_m > found.margin_m == pytest.approx(0.04)
