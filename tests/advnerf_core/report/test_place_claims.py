"""Claims about kinds of places, against sums by hand and against an analysis of variance of a linear model."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.special import stdtrit

from advnerf_core.report.cells import CellResult, read_cells
from advnerf_core.report.evidence.page import results_page
from advnerf_core.report.evidence.place_claims import place_claim_data, place_claim_row
from advnerf_core.report.evidence.registration import (
    FILE,
    PlaceClaim,
    RegisteredCell,
    Registration,
    read_registration,
)
from advnerf_core.report.evidence.results import Evidence, as_data
from benchmarks.gap import place_rows
from benchmarks.planted_changes import write_simulated_set

PLACES, VICTIMS = ("one", "two", "three", "four"), ("hardened", "other")
CLAIM = PlaceClaim(name="four roads", scenarios=PLACES, victims=VICTIMS, against=("random",))


def replace(cell: CellResult, **values: Any) -> CellResult:
    return cell.model_copy(update=values)


def at_places(folder: Any, without_effect: set[tuple[str, str]], claim: PlaceClaim = CLAIM) -> Evidence:
    """The drives of one set at four places, of two victims; the gradient does nothing in some: there it drives as random textures."""
    registration = read_registration(folder)
    assert registration is not None
    cells = {cell.name: cell for cell in read_cells(folder) if cell.key[:2] == ("track", "hardened")}
    made, named = [], []
    for place in claim.scenarios:
        for victim in claim.victims:
            for cell in cells.values():
                weak = (place, victim) in without_effect and cell.method == "gradient"
                kept = cells[cell.name.replace("gradient", "random")].kept if weak else cell.kept
                made.append(replace(cell, scenario=place, victim=victim, kept=kept))
                named.append(
                    RegisteredCell(scenario=place, victim=victim, method=cell.method, seed=cell.seed)
                )
    registered = registration.model_copy(
        update={
            "scenarios": dict.fromkeys(claim.scenarios, registration.scenarios["track"]),
            "cells": tuple(named),
            "primary": (),
            "claims": (claim,),
        }
    )
    return Evidence(registered, [replace(cell, registration=registered.digest) for cell in made])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return folder


def mean_m(evidence: Evidence, method: str) -> float:
    cells = evidence.searches(("one", "other", method))
    return float(np.mean([o.excess_cte_m_per_tick for c in cells for o in evidence.outcomes(c, "deployed")]))


def test_the_interval_is_over_places_and_victims(folder: Any) -> None:
    evidence = at_places(folder, {(place, victim) for place in ("two", "three") for victim in VICTIMS})
    row = place_claim_row(evidence, CLAIM)
    full_m = mean_m(evidence, "gradient") - mean_m(evidence, "random")
    values = full_m * np.array([[1, 1], [0, 0], [0, 0], [1, 1]], float)
    assert [each["difference_m"] for each in row.each] == pytest.approx(values.ravel(), abs=1e-12)
    assert row.difference_m == pytest.approx(values.mean())
    assert (row.places, row.victims, row.reason) == (4, 2, "")
    # Places differ and victims do not, symmetrically: Student's interval of four values.
    half = stdtrit(3, 0.975) * values.mean(axis=1).std(ddof=1) / 2.0
    assert (row.low_m, row.high_m) == pytest.approx((values.mean() - half, values.mean() + half))
    assert row.least_off_track_points == 0.0 < row.off_track_points
    points = np.reshape([each["off_track_points"] for each in row.each], (4, 2)).mean(axis=1)
    assert row.low_off_track_points == pytest.approx(
        points.mean() - stdtrit(3, 0.975) * points.std(ddof=1) / 2.0
    )
    difference, bound = place_rows("roads", vars(row))
    assert (difference.value, bound.value) == (
        round(row.off_track_points),
        round(row.low_off_track_points or 0.0),
    )
    assert (difference.met, bound.met) == (row.off_track_points >= 50.0, False)


def test_at_one_place_the_interval_is_over_victims(folder: Any) -> None:
    victims = tuple("abcdef")
    claim = PlaceClaim(name="six victims", scenarios=("one",), victims=victims, against=("random",))
    evidence = at_places(folder, {("one", victim) for victim in victims[:3]}, claim)
    row = place_claim_row(evidence, claim)
    full_m = row.each[-1]["difference_m"]
    values = np.repeat([0.0, full_m], 3)  # symmetric: Student's interval of six values
    half = stdtrit(5, 0.975) * values.std(ddof=1) / np.sqrt(6.0)
    assert (row.low_m, row.high_m) == pytest.approx((values.mean() - half, values.mean() + half))
    data = as_data(evidence) | place_claim_data(evidence)
    registered = {**evidence.registration.as_filed().model_dump(mode="json"), "digest": "d" * 64}
    page = results_page({"simulated": {**data, "registered": registered, "filmed": False, "notes": []}})
    assert "minus the strongest baseline, 6 victims: +" in page
    assert "for new victims)" in page


def test_equal_shares_of_drives_have_a_mean_and_no_bound(folder: Any) -> None:
    row = place_claim_row(at_places(folder, set()), CLAIM)
    assert row.off_track_points == row.least_off_track_points
    assert row.low_off_track_points is None
    assert len(place_rows("roads", vars(row))) == 1


def test_many_searches_make_no_narrower_interval(folder: Any) -> None:
    """One place in two without an effect says the same of six searches as of two."""
    evidence = at_places(folder, {(place, victim) for place in ("one", "two") for victim in VICTIMS})
    many = place_claim_row(evidence, CLAIM)
    registered = evidence.registration.model_copy(
        update={"cells": tuple(cell for cell in evidence.registration.cells if cell.seed < 2)}
    )
    cells = [replace(cell, registration=registered.digest) for cell in evidence.cells.values()]
    two = place_claim_row(Evidence(registered, [cell for cell in cells if cell.seed < 2]), CLAIM)
    assert many.low_m < 0.0 < many.difference_m
    assert (many.high_m - many.low_m) == pytest.approx(two.high_m - two.low_m, rel=0.15)


def test_a_claim_needs_all_its_cells_and_stands_on_the_page(folder: Any) -> None:
    evidence = at_places(folder, set())
    fewer = Evidence(
        evidence.registration,
        [cell for cell in evidence.cells.values() if (cell.scenario, cell.method) != ("four", "random")],
    )
    (told,) = place_claim_data(fewer)["claims"]
    assert told["difference_m"] is None
    assert told["reason"] == "four_hardened_random_0 was not driven as registered"
    data = json.loads(json.dumps({**as_data(evidence), **place_claim_data(evidence)}))
    data |= {"registered": {**evidence.registration.as_filed().model_dump(mode="json"), "digest": "d" * 64}}
    page = results_page({"simulated": {**data, "filmed": False, "notes": []}})
    assert "**four roads**, " in page
    assert "4 places and 2 victims: +" in page
    data["claims"] = [told]
    page = results_page({"simulated": {**data, "filmed": False, "notes": []}})
    assert "no claim, as four_hardened_random_0 was not driven as registered" in page


def test_registrations_without_claims_keep_their_digest(folder: Any) -> None:
    registration = read_registration(folder)
    assert registration is not None
    written = json.loads((folder / FILE).read_text())
    del written["claims"]
    assert Registration.model_validate(written).digest == registration.digest
    claimed = registration.model_copy(update={"claims": (CLAIM,)})
    assert claimed.as_filed().digest != registration.digest
    assert Registration.model_validate(claimed.model_dump(mode="json")).claims == (CLAIM,)
    for places, victims in (
        (("a", "b"), VICTIMS),
        (("a",), ("p", "q", "r", "s")),
        (("a", "b"), tuple("pqrst")),
    ):
        told = f"expected 4 scenarios or more, or one and 5 victims or more, got {len(places)} and {len(victims)}"
        with pytest.raises(ValueError, match=told):
            PlaceClaim(name="x", scenarios=places, victims=victims, against=("random",))
    with pytest.raises(ValueError, match="expected different ones, got a, a, a, a"):
        PlaceClaim(name="x", scenarios=("a",) * 4, victims=VICTIMS, against=("random",))
