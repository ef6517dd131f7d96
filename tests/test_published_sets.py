"""What is published with the code is what its kept drives give."""

from pathlib import Path

import pytest

from advnerf_core.report.evidence.verify import verify_beside, verify_set
from advnerf_core.report.evidence.verifying.history import verify_history
from advnerf_core.report.evidence.verifying.layout import sets_in
from benchmarks.kept_commands import kept_by
from benchmarks.kept_rows import computed_again, row_problems
from benchmarks.page_numbers import count_numbers
from benchmarks.published_check import gate_problems, row_page_problems, target_problems
from benchmarks.results import PAGE, read_rows

DOCS = Path(__file__).parents[1] / "docs"
PUBLISHED = DOCS / "results"


def test_something_is_published():
    assert "room" in sets_in(PUBLISHED)


@pytest.mark.parametrize("name", sets_in(PUBLISHED))
def test_a_published_set_verifies(name):
    found = verify_set(PUBLISHED / name)
    assert found.problems == ()
    assert found.numbers > 0 or found.awaits


def test_pictures_films_and_the_reference_build_are_as_published():
    assert verify_beside(PUBLISHED) == ()


def test_the_history_of_the_repository_agrees_where_there_is_one():
    assert verify_history(PUBLISHED).problems == ()


def test_numbers_on_pages_are_published_or_marked():
    found = count_numbers(DOCS, read_rows())
    assert found.problems == ()
    # Results stand on generated pages alone; what is counted on the others are settings.
    assert (found.published, found.marked) == (0, 0)
    assert found.settings > 100


def test_pages_are_those_of_their_rows_and_verdicts_those_of_their_targets():
    rows = read_rows()
    assert [*target_problems(rows), *row_page_problems(rows, PAGE)] == []


def test_rows_of_published_sets_are_computed_again():
    quick = tuple(f"python -m benchmarks.{name}" for name in ("gap", "predictions", "transfer_correlation"))
    rows = [row for row in read_rows() if row["command"].startswith(quick)]
    assert len(rows) >= 36
    assert list(row_problems(rows, computed_again([row["command"] for row in rows]))) == []


@pytest.mark.slow
def test_all_rows_of_kept_data_and_verdicts_of_the_gate_are_computed_again():
    rows = read_rows()
    assert sum(kept_by(row["command"]) is not None for row in rows) >= 108
    assert list(row_problems(rows, computed_again([row["command"] for row in rows]))) == []
    assert list(gate_problems()) == []
