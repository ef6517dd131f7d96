"""What every registered set must show: all drives from above, stills, both controls, its role; and what no page may say."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from advnerf_core.errors import ConfigError
from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.about import ABOUT, check_about, read_about
from advnerf_core.report.evidence.above import (
    MOST_BYTES,
    groups_of_drives,
    moment_of,
    write_above_of,
    write_maps,
)
from advnerf_core.report.evidence.page import above_of, film_of, groups_of_searches, maps_of, searched_apart
from advnerf_core.report.evidence.plot import excess_plot
from advnerf_core.report.evidence.registration import SetError
from advnerf_core.report.evidence.results import read_evidence, rows
from advnerf_core.report.evidence.verify import verify_beside, verify_set
from advnerf_core.report.evidence.verifying.layout import complete_sets, sets_in
from advnerf_core.report.evidence.words import claim, excesses, p_text, smaller_excess
from benchmarks.planted_changes import write_simulated_set

DOCS = Path(__file__).parents[3] / "docs"
PUBLISHED = DOCS / "results"
SETS = complete_sets(PUBLISHED)
PAGE = (PUBLISHED / "transfer.md").read_text()


def section(name):
    return re.split(r"^## ", PAGE.split(f"\n## {name}\n")[1], flags=re.MULTILINE)[0]


def published(name):
    return json.loads((PUBLISHED / name / "set" / "set.json").read_text())


@pytest.mark.parametrize("name", SETS)
def test_every_set_shows_its_drives_from_above_and_what_the_camera_saw(name):
    text, picture, data = section(name), PUBLISHED / above_of(name), published(name)
    # A claim has a map of all its victims, without stills.
    several = len(maps_of(data)) > 1 or not data["primary"]
    # The conditions of a contrast share their searches, and have a map each.
    tested = {each["test"]["scenario"] for each in data["primary"]}
    cells = [cell for cell in read_cells(PUBLISHED / name) if cell.method == "gradient"]
    attacks = {
        frozenset(cell.attack_id for cell in cells if cell.scenario == scenario) for scenario in tested
    }
    assert several == (len(attacks) != 1)
    what = "of each scenario from above" if several else "from above, and what the camera saw"
    assert text.lstrip().startswith(f"![All deployed drives {what}]({picture.name})")
    assert picture.stat().st_size <= MOST_BYTES == 250_000
    assert Image.open(picture).size[0] == 1200
    assert (PUBLISHED / film_of(name)).exists()  # the stills are frames of it
    assert several or "Place of the object:" in text or "The place of the object was not kept" in text


def test_the_map_beside_the_stills_is_of_the_method_that_they_show(monkeypatch):
    """A coarser attack, which is tested against other baselines, is not drawn for the one in the film."""
    shown = []
    monkeypatch.setattr(
        "advnerf_core.report.evidence.above.write_above",
        lambda _, test, film, *__: shown.extend((test, film)),
    )
    write_above_of(PUBLISHED / "paper_monitor")
    assert [each["test"]["method"] for each in shown] == ["gradient", "gradient"]
    assert published("paper_monitor")["primary"][-1]["test"]["method"] == "gradient_coarse"


def test_the_legend_of_the_excesses_is_inside_its_picture():
    figure = excess_plot(read_evidence(PUBLISHED / "victim_panel"), {})
    figure.canvas.draw()
    (legend,) = figure.legends
    assert legend.get_window_extent().x1 <= figure.bbox.x1


@pytest.mark.parametrize("name", SETS)
def test_every_set_shows_both_controls_and_the_sentence_uses_the_smaller_excess(name):
    data, text = published(name), section(name)
    assert "| over no object |" in text
    # Conditions of the same searches share their drives in the learned scene, which appear once.
    missing = {
        (
            row["domain"] == "deployed" and row["scenario"],
            row["victim"],
            row["method"],
            f"{row['excess_m']:.3f}",
        )
        for row in data["rows"]
        if row["over_no_object_m"] is None and row["method"] != "empty"
    }
    assert text.count("| not driven |") == len(missing)
    apart = searched_apart(data["primary"]) if data["primary"] else []
    for test in apart if len(apart) > 1 else data["primary"][-1:]:
        (row,) = [
            each
            for each in data["rows"]
            if each["domain"] == "deployed"
            and all(each[key] == test["test"][key] for key in ("scenario", "victim", "method"))
        ]
        values = [row["excess_m"]] + [row["over_no_object_m"]] * (row["over_no_object_m"] is not None)
        assert f"the car is {min(values):.3f} m per tick further" in text
        assert all(f"{value:.3f}" in text for value in values)


@pytest.mark.parametrize("name", SETS)
def test_every_set_says_what_it_is_for_and_its_p_values(name):
    data, text = published(name), section(name)
    assert re.search(
        r"^\*\*(Exploration|Confirmation)\*\*, registered after .+ What changed: ", text, re.MULTILINE
    )
    claims, contrasts = data.get("claims", ()), data.get("contrasts", ())
    assert data["primary"] or claims or contrasts
    assert not (data["primary"] and claims)
    for each in contrasts:
        assert f"| {each['before_m']:.3f} | {each['after_m']:.3f} | {each['difference_m']:+.3f} |" in text
    for each in claims:
        places = "places and " * (each["places"] > 1)
        assert f"({each['low_m']:.3f} to {each['high_m']:.3f} for new {places}victims)" in text
    assert ("p deployed, after Holm" in text) == bool(data["primary"])
    assert ("| in the learned scene | p there, not adjusted |" in text) == bool(data["primary"])
    for test in data["primary"]:
        assert test["p_surrogate"] is None or f"| {p_text(test['p_surrogate'])} |" in text


def test_sets_that_share_searches_are_one_group_and_the_page_says_so():
    cells = {
        name: {
            cell.attack_id for cell in read_cells(PUBLISHED / name) if cell.method not in ("none", "empty")
        }
        for name in SETS
    }
    assert cells["gap_filament"] < cells["gap_room"]
    groups = groups_of_searches({name: published(name) for name in SETS})
    assert ["gap_filament", "gap_room"] in [sorted(group) for group in groups]
    assert len(groups) == len(SETS) - 1
    assert f"The {len(SETS)} sets are {len(SETS) - 1} groups of searches in 4 worlds." in PAGE
    for name, attacks in cells.items():
        assert {each["attack_id"] for each in published(name)["searches"]} == attacks


def test_excess_over_no_object_is_that_over_the_plain_object_and_that_of_the_plain_object():
    name = "gap_metadrive"
    evidence = read_evidence(PUBLISHED / name)
    found = {(row.scenario, row.method, row.domain): row for row in rows(evidence)}
    for (scenario, method, domain), row in found.items():
        if method in ("none", "empty"):
            continue
        plain = found[scenario, "none", domain]
        assert row.over_no_object_m == pytest.approx(row.excess_m + plain.over_no_object_m)
        assert plain.over_no_object_m == pytest.approx(-found[scenario, "empty", domain].excess_m)
        assert found[scenario, "empty", domain].over_no_object_m is None
    # By hand, from the poses alone.
    (scenario,) = {key[0] for key in found if key[0] == "native_own"}
    registered = evidence.registration.scenarios[scenario]
    path = registered.reference_path()

    def ctes_m(method):
        cells = [
            cell for cell in evidence.cells.values() if (cell.scenario, cell.method) == (scenario, method)
        ]
        drives = [drive.poses()[1:, :2] for cell in cells for drive in cell.kept["deployed"]]
        return np.mean([np.abs(path.project(xy).cte_m).mean() for xy in drives])

    by_hand = ctes_m("gradient") - ctes_m("empty")
    assert found[scenario, "gradient", "deployed"].over_no_object_m == pytest.approx(by_hand, abs=1e-4)
    assert by_hand == pytest.approx(0.067, abs=1e-3)


def test_a_claim_names_the_control_that_leaves_less():
    row = {
        "scenario": "s",
        "victim": "hardened",
        "method": "gradient",
        "domain": "deployed",
        "off_track": 1,
        "drives": 8,
        "collided": {"wall": 3},
    }
    row |= {
        "excess_m": 0.2,
        "low_m": 0.1,
        "high_m": 0.3,
        "over_no_object_m": 0.05,
        "over_no_object_low_m": -0.01,
        "over_no_object_high_m": 0.1,
    }
    assert [each.over for each in excesses(row)] == ["plain object", "no object"]
    assert (smaller_excess(row).mean_m, smaller_excess(row).is_shown) == (0.05, False)
    against = {
        "scenario": "s",
        "victim": "hardened",
        "method": "gradient",
        "against": ["random"],
    }
    test = {
        "test": against,
        "baseline": "random",
        "difference_m": 0.1,
        "low_m": 0.05,
        "high_m": 0.2,
        "p": 0.001,
        "p_holm": 0.002,
    }
    said = claim(test, [row])
    assert "0.050 m per tick further from its path than with no object" in said
    assert "no effect is shown" in said
    assert "Over the plain object the excess is 0.200 m." in said
    assert "1 of 8 drives leave the track; 3 (3 wall) run into something." in said
    assert "the only baseline run" in said
    bare = (
        row
        | {"collided": {}}
        | {"over_no_object_m": None, "over_no_object_low_m": None, "over_no_object_high_m": None}
    )
    assert "Drives with no object were not made." in claim(test, [bare])
    assert "run into something" not in claim(test, [bare])


def test_an_entry_for_each_set_is_read_strictly(tmp_path):
    write_simulated_set(tmp_path / "simulated")
    assert verify_set(tmp_path / "simulated").problems == ()  # nothing is said about any set
    entry = {"world": "room", "role": "exploration", "changed": "All."}
    (tmp_path / ABOUT).write_text(json.dumps({"other": entry}))
    with pytest.raises(SetError, match="expected an entry for simulated, got none; add world, role"):
        check_about(tmp_path, ["simulated"])
    assert "expected an entry for simulated" in verify_beside(tmp_path)[-1]
    with pytest.raises(SetError, match="got other; remove it"):
        check_about(tmp_path, [])
    for wrong in ({"role": "proof"}, {"world": ""}, {"colour": "red"}, {"object": {"x_m": "1"}}):
        (tmp_path / ABOUT).write_text(json.dumps({"simulated": entry | wrong}))
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            read_about(tmp_path)
    assert set(read_about(PUBLISHED)) == set(sets_in(PUBLISHED))


def test_the_moment_of_the_stills_is_that_of_the_kept_poses():
    name = "gap_duckietown_robust"
    folder = PUBLISHED / name
    evidence = read_evidence(folder)
    registered = evidence.registration.scenarios["more"]
    key = ("more", "hardened", "gradient")
    drive = evidence.cells["more_hardened_gradient_6"].kept["deployed"][0]
    off = np.abs(registered.reference_path().project(drive.poses()[:, :2]).cte_m) > registered.off_track_m
    assert moment_of(evidence, key) == (pytest.approx(np.argmax(off) * registered.dt_s), True)
    assert not moment_of(evidence, (*key[:2], "random_coarse"))[1]


def test_a_set_without_a_film_and_a_known_object_has_its_drives_from_above(tmp_path):
    write_simulated_set(tmp_path / "simulated")
    picture = tmp_path / above_of("simulated")
    picture.unlink()
    assert write_above_of(tmp_path / "simulated") == picture
    shown = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3).astype(int)
    for colour in ((0x00, 0x72, 0xB2), (0xDD, 0x93, 0x00), (0xB0, 0x12, 0x3C)):
        assert (np.abs(shown - colour).max(axis=1) < 40).sum() > 100  # all three are drawn


def test_scenarios_with_searches_of_their_own_have_a_map_each(tmp_path):
    folder = PUBLISHED / "paper_car"
    evidence = read_evidence(folder)
    maps = maps_of(published("paper_car"))
    picture = np.asarray(Image.open(write_maps(evidence, maps, tmp_path / "maps.webp")).convert("RGB"))
    halves = np.split(picture.astype(int), 2, axis=1)
    for half in halves:
        for colour in ((0x00, 0x72, 0xB2), (0xDD, 0x93, 0x00), (0xB0, 0x12, 0x3C)):
            assert (np.abs(half - colour).max(axis=-1) < 40).sum() > 100
    assert (np.abs(halves[0] - halves[1]).max(axis=-1) > 40).sum() > 1000  # each of its own drives


def test_each_place_of_a_claim_has_a_map_of_all_its_victims():
    data = published("metadrive_billboard")
    maps = maps_of(data)
    assert [{each["test"]["scenario"] for each in tests} for tests in maps] == [
        {"cx"},
        {"ct"},
        {"sxs"},
        {"sts"},
    ]
    assert all([each["test"]["victim"] for each in tests] == ["first", "second"] for tests in maps)
    evidence = read_evidence(PUBLISHED / "metadrive_billboard")
    for tests in maps:
        plain, baseline, attack = groups_of_drives(evidence, tests)
        assert len(plain.poses) == len(baseline.poses) == len(attack.poses) == 2 * 5
        rows = [
            row
            for row in data["rows"]
            if (row["domain"], row["method"], row["scenario"])
            == ("deployed", "gradient", tests[0]["scenario"])
        ]
        assert attack.off_track == sum(row["off_track"] for row in rows)


FORBIDDEN = ("the real place", "the real car", "learned copy", "no attack", "7 of 7 registered")


@pytest.mark.parametrize("phrase", FORBIDDEN)
def test_no_page_of_results_says_what_never_happened_or_has_a_second_name(phrase):
    pages = [
        DOCS / "results.md",
        DOCS / "was_not_run.md",
        DOCS / "evidence.md",
        DOCS.parent / "README.md",
        *PUBLISHED.glob("*.md"),
    ]
    assert [page.name for page in pages if re.search(rf"\b{phrase}\b", page.read_text(), re.IGNORECASE)] == []


def test_pages_that_speak_of_cars_link_what_was_not_run_and_the_first_is_short():
    for page in (DOCS.parent / "README.md", DOCS / "results.md", PUBLISHED / "transfer.md"):
        assert "was_not_run.md" in page.read_text()
    assert len((DOCS / "results.md").read_text().split()) <= 1500
    for name in SETS:
        prose = [
            line
            for line in section(name).splitlines()
            if line and not line.startswith(("|", "    ", "!", "#", "**Registered, and not run"))
        ]
        assert len(" ".join(prose).split()) <= 350
