"""The same attacks under two conditions, against sums by hand."""

import dataclasses
import hashlib
import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.report.cells import CellResult, read_cells
from advnerf_core.report.evidence.contrasts import contrast_data, contrast_rows
from advnerf_core.report.evidence.intervals import clustered_interval
from advnerf_core.report.evidence.page import results_page
from advnerf_core.report.evidence.plot import _means, excess_plot
from advnerf_core.report.evidence.registration import (
    Contrast,
    RegisteredCell,
    Registration,
    read_registration,
)
from advnerf_core.report.evidence.results import Evidence, as_data, rows
from benchmarks.planted_changes import write_simulated_set


def replace(cell: CellResult, **values: Any) -> CellResult:
    return cell.model_copy(update=values)


LEARNED = Contrast(name="learned scene to world", before="track", before_in="surrogate", after="track")
RENDERER = Contrast(name="another renderer", before="track", after="native")


def test_a_condition_is_not_compared_with_itself():
    with pytest.raises(ValidationError, match="expected two conditions, got track deployed twice"):
        Contrast(name="nothing", before="track", after="track")


@pytest.fixture(scope="module")
def evidence(tmp_path_factory: pytest.TempPathFactory) -> Evidence:
    """A set of which the second condition has the drives of the first, but those of its gradient are in the other domain."""
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    registration = read_registration(folder)
    assert registration is not None
    cells = [cell for cell in read_cells(folder) if cell.scenario == "track"]
    registered = [cell for cell in registration.cells if cell.scenario == "track"]
    copies = [
        replace(
            cell,
            scenario="native",
            kept={"deployed": cell.kept["surrogate" if cell.method == "gradient" else "deployed"]},
        )
        for cell in cells
    ]
    both = registration.model_copy(
        update={
            "scenarios": {**registration.scenarios, "native": registration.scenarios["track"]},
            "cells": (
                *registered,
                *(RegisteredCell(**{**cell.model_dump(), "scenario": "native"}) for cell in registered),
            ),
            "contrasts": (LEARNED, RENDERER),
        }
    )
    digest = both.digest
    return Evidence(both, [replace(cell, registration=digest) for cell in (*cells, *copies)])


def excess(evidence: Evidence, method: str, domain: str) -> np.ndarray:
    cells = evidence.searches(("track", "hardened", method))
    return np.array([[o.excess_cte_m_per_tick for o in evidence.outcomes(cell, domain)] for cell in cells])


def test_a_contrast_is_the_paired_difference_of_excess(evidence: Evidence) -> None:
    found = {(row.name, row.method): row for row in contrast_rows(evidence)}
    assert set(found) == {(each.name, m) for each in (LEARNED, RENDERER) for m in ("gradient", "random")}
    row = found[LEARNED.name, "gradient"]
    before, after = excess(evidence, "gradient", "surrogate"), excess(evidence, "gradient", "deployed")
    assert row.before_m == pytest.approx(before.mean())
    assert row.after_m == pytest.approx(after.mean())
    assert row.difference_m == pytest.approx(after.mean() - before.mean())
    interval = clustered_interval(list(after - before))
    assert interval is not None
    assert (row.low_m, row.high_m) == pytest.approx((interval.low, interval.high))
    assert (row.searches, row.drives, row.registered) == (6, 30, True)
    # Under the second condition nothing but the gradient's drives is another.
    assert found[RENDERER.name, "random"].difference_m == 0.0
    assert found[RENDERER.name, "gradient"].after_m == pytest.approx(
        found[RENDERER.name, "gradient"].before_m - row.difference_m, abs=0.02
    )


def test_another_attack_is_no_contrast(evidence: Evidence) -> None:
    cells = [
        replace(cell, attack_id="another") if (cell.scenario, cell.method) == ("native", "gradient") else cell
        for cell in evidence.cells.values()
    ]
    found = contrast_rows(Evidence(evidence.registration, cells))
    assert {(row.name, row.method) for row in found if row.name == RENDERER.name} == {
        (RENDERER.name, "random")
    }
    one = [
        replace(cell, attack_id="another")
        if (cell.scenario, cell.method, cell.seed) == ("native", "gradient", 2)
        else cell
        for cell in evidence.cells.values()
    ]
    part = next(
        row
        for row in contrast_rows(Evidence(evidence.registration, one))
        if (row.name, row.method) == (RENDERER.name, "gradient")
    )
    assert (part.searches, part.other_attacks, part.drives) == (5, 1, 25)
    kept = [seed for seed in range(6) if seed != 2]
    before = excess(evidence, "gradient", "deployed")[kept]
    assert part.before_m == pytest.approx(before.mean())
    none = evidence.registration.model_copy(update={"contrasts": ()})
    assert contrast_data(Evidence(none, cells)) == {}
    # The digest of a registration from before there were contrasts is over what its file says.
    said = none.model_dump(mode="json", exclude={"contrasts", "claims"})
    undated = json.dumps({name: each for name, each in said.items() if name != "date"}, sort_keys=True)
    digest = hashlib.sha256(undated.encode()).hexdigest()
    assert Registration.model_validate(said).digest == digest != none.digest


def test_the_page_and_the_picture_name_the_conditions(evidence: Evidence) -> None:
    data = {
        **as_data(evidence),
        **contrast_data(evidence),
        "registered": evidence.registration.model_dump(mode="json")
        | {"digest": evidence.registration.digest},
        "filmed": False,
    }
    text = results_page({"simulated": data})
    assert "### What each difference costs" in text
    assert "| learned scene to world | hardened | gradient | 6 x 5 |" in text
    assert "| native | hardened | gradient | deployed |" in text
    names = [label.get_text() for label in excess_plot(evidence, {}).axes[0].get_xticklabels()]
    assert any("native" in name for name in names)


def test_many_conditions_are_drawn_by_their_means(evidence: Evidence) -> None:
    # Its marker is no name but corners.
    pink = {"random": "random_pink"}
    shown = [
        dataclasses.replace(row, method=pink.get(row.method, row.method))
        for row in rows(evidence)
        if row.method != "none"
    ]
    figure = _means(shown, {})
    drawn = {(round(float(x), 9)) for line in figure.axes[0].lines for x in line.get_xdata()}
    assert {round(row.excess_m, 9) for row in shown} <= drawn
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        "track, hardened",
        "native, hardened",
    ]
    widest = max(abs(value) for row in shown for value in (row.low_m or 0.0, row.high_m or 0.0, row.excess_m))
    low, high = figure.axes[0].get_xlim()
    assert high - low < 3.0 * widest
