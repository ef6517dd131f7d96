"""Rows that contradict themselves, and numbers on pages that no row has, are found."""

import json

import pytest

from benchmarks.kept_commands import kept_by
from benchmarks.kept_rows import row_problems
from benchmarks.page_numbers import count_numbers, numbers_in, write_list
from benchmarks.published_check import target_problems
from benchmarks.results import LedgerRow

ROW = LedgerRow(
    "photos", 25.53, "dB", ">= 26 dB", False, "python -m benchmarks.gap one", "of 40 photos, 3 ms each"
)


@pytest.mark.parametrize(
    ("value", "target", "met", "problem"),
    [
        (25.5, ">= 26 dB", False, ""),
        (25.5, ">= 26 dB", True, "says that 25.5 met"),
        (27.0, ">= 26 dB", False, "says that 27 missed"),
        (27.0, ">= 26 dB, never dark", False, ""),  # it may be dark
        (27.0, ">= 26 dB, never dark", True, ""),
        (0.9, "< 1", True, ""),
        (1.0, "< 1", True, "says that 1 met"),
        (1000.0, "<= 1,000 ms", True, ""),
        (5.0, "printed", None, ""),
        ("20/20", ">= 20", True, ""),
    ],
)
def test_a_verdict_follows_from_value_and_target(value, target, met, problem):
    row = {"line": "a", "value": value, "target": target, "met": met}
    assert problem in "".join(target_problems([row]))
    assert bool(problem) == bool(list(target_problems([row])))


def test_rows_are_held_against_the_kept_data():
    row = vars(ROW)
    assert list(row_problems([row], [ROW])) == []
    for key, value in (("value", 25.54), ("met", True), ("note", "of 4 photos"), ("target", ">= 25 dB")):
        (problem,) = row_problems([{**row, key: value}], [ROW])
        assert f"'photos', {key}: recorded" in problem
    (problem,) = row_problems([row], [])
    assert "the kept data does not give it" in problem
    (problem,) = row_problems([], [ROW])
    assert "the ledger does not have it" in problem


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        ("python -m benchmarks.gap gap_room", True),
        ("python -m benchmarks.gap gap_room gap_filament", True),
        ("python -m benchmarks.predictions", True),
        (
            "advnerf experiment run launch/junction.experiment.yaml --setting retrain --folder runs/retrain",
            True,
        ),
        ("advnerf experiment launch/room.experiment.yaml", False),
        ("python -m benchmarks.floors", False),
    ],
)
def test_commands_whose_data_is_kept_are_known(command, kept):
    assert (kept_by(command) is not None) is kept


def test_numbers_have_units_and_are_no_code():
    text = "It took 12.5 ms (`3 ms`), 1,200 MB and 4 of 5.\n\n    sleep 9 s\n\n[see](a/7 m) 8 × as fast, 3D, v1.2 s"  # noqa: RUF001
    assert list(numbers_in(text)) == [("12.5", "ms"), ("1200", "MB"), ("8", "x")]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("# A\n\nIt reaches 25.5 dB of 26 dB, at 3 ms.\n", ""),
        ("# A\n\nIt reaches 25.6 dB.\n", "25.6 dB is in no published row or set; say at the head"),
        ("# A\n\n*Figures were measured once, not kept.*\n\nIt reaches 25.6 dB.\n", ""),
    ],
)
def test_a_figure_is_published_or_its_page_is_marked(tmp_path, text, says):
    (tmp_path / "results").mkdir()
    page = tmp_path / "a.md"
    page.write_text(text)
    write_list(tmp_path, [vars(ROW)])
    problems = "\n".join(count_numbers(tmp_path, [vars(ROW)]).problems)
    assert (says in problems) if says else (problems == "")
    # A figure that was edited is not listed.
    page.write_text(text.replace("25.", "28."))
    assert "as often on the page as in page_numbers.json" in "\n".join(
        count_numbers(tmp_path, [vars(ROW)]).problems
    )


def test_a_figure_whose_row_has_changed_is_not_published_any_more(tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "a.md").write_text("# A\n\nIt reaches 25.5 dB.\n")
    write_list(tmp_path, [vars(ROW)])
    assert json.loads((tmp_path / "page_numbers.json").read_text()) == {"a.md": {"published": ["25.5 dB"]}}
    (problem,) = count_numbers(tmp_path, [{**vars(ROW), "value": 29.0}]).problems
    assert "25.5 dB is in no published row or set any more" in problem
