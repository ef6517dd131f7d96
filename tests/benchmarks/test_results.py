import json

from benchmarks.results import read_rows, record_row


def test_a_row_replaces_its_older_self_and_a_miss_stays_with_its_reason(tmp_path):
    where = {"ledger": tmp_path / "results.json", "page": tmp_path / "results.md"}
    record_row("#2 a", 25.0, "dB", ">= 26 dB", False, "make bench", "too few photos", **where)
    record_row("#2 b", 3, "x", ">= 2", True, "make bench", machine="another", date="2026-01-02", **where)
    record_row("#2 a", 25.5, "dB", ">= 26 dB", False, "make bench", "0.5 dB short | dark images", **where)

    rows = read_rows(where["ledger"])
    assert [(r["line"], r["value"], r["met"]) for r in rows] == [("#2 a", 25.5, False), ("#2 b", 3, True)]
    assert json.loads(where["ledger"].read_text()) == rows
    assert (rows[1]["machine"], rows[1]["date"]) == ("another", "2026-01-02")
    assert "cores" in rows[0]["machine"]
    page = where["page"].read_text()
    assert "25.5 dB" in page
    assert "**no**" in page
    assert "0.5 dB short \\| dark images" in page


def test_an_absent_ledger_has_no_rows(tmp_path):
    assert read_rows(tmp_path / "none.json") == []
