import json
import shutil

from benchmarks.answers import answers, sets_table
from benchmarks.questions import OTHER, QUESTIONS, question_of
from benchmarks.results import PAGE, read_rows, record_row


def test_a_row_replaces_its_older_self_and_a_miss_stays_with_its_reason(tmp_path):
    where = {"ledger": tmp_path / "results.json", "page": tmp_path / "results.md"}
    record_row("a", 25.0, "dB", ">= 26 dB", False, "make bench", "too few photos", **where)
    record_row("b", 3, "x", ">= 2", True, "make bench", machine="another", date="2026-01-02", **where)
    record_row("a", 25.5, "dB", ">= 26 dB", False, "make bench", "0.5 dB short | dark images", **where)

    rows = read_rows(where["ledger"])
    assert [(r["line"], r["value"], r["met"]) for r in rows] == [("a", 25.5, False), ("b", 3, True)]
    assert json.loads(where["ledger"].read_text()) == rows
    assert (rows[1]["machine"], rows[1]["date"]) == ("another", "2026-01-02")
    assert "cores" in rows[0]["machine"]
    page = (tmp_path / "results" / "other.md").read_text()
    assert "## `make bench`" in page
    assert "25.5 dB" in page
    assert "**no**" in page
    assert "0.5 dB short \\| dark images" in page
    index = where["page"].read_text()
    assert "| 2 | 2 | 1 |" in index
    assert "registered sets" not in index  # none lies beside this ledger
    missed = (tmp_path / "results" / "missed.md").read_text()
    assert "| a | 25.5 dB | >= 26 dB | [other](other.md) |" in missed
    assert "| b |" not in missed


def test_the_short_answers_are_those_of_sets_and_rows(tmp_path):
    published = PAGE.parent / "results"
    shutil.copytree(published / "room", tmp_path / "room")
    file = tmp_path / "room" / "set" / "set.json"
    data = json.loads(file.read_text())
    data["primary"][0] |= {"difference_m": 0.123, "p_holm": None}
    file.write_text(json.dumps(data))
    found = {each.question: each.text for each in answers([], tmp_path)}
    assert "adds 0.12 to 0.12 m per tick, with p < 0.05 in 0 of 1 comparisons" in found["Better than what?"]
    assert "1 registered sets, 1 groups of searches. In 1 of 1 comparisons" in found["Does it transfer?"]
    # The maximum over searches, from the kept drives: an attacker takes it.
    victims = found["Against which victims?"]
    assert victims.startswith("1 victim. The best random search of each set moves them 0.169 to 0.169 m")
    assert "(set room: 5 of 5 drives off the track, 20 of 30 of all searches), and up to 0.185 m" in victims
    (line,) = sets_table(tmp_path).splitlines()[2:]
    assert "| trained with textures |" in line
    assert "| +0.123 (random, coarse) | not tested |" in line
    # Of a set with conditions the last is told, in which everything is the world's own.
    everywhere = sets_table(published)
    assert "gap_room), native own | exploration | trained with textures |" in everywhere
    assert "composed" not in everywhere
    # Scenarios with searches of their own are told one by one.
    assert "0 of 120; 120 run into something" in everywhere
    assert everywhere.count("[paper_car]") == 2
    # A claim about places is told too, with the places where nothing was found.
    (transfers,) = [each.text for each in answers([], published) if each.question == "Does it transfer?"]
    assert (
        "to the strongest baseline, per tick and in drives off the track: metadrive_billboard +0.487 m (95 % "
        in transfers
    )
    assert "+22 points (4 places and 2 victims); " in transfers
    # Nothing is claimed that was not measured.
    assert "How fast?" not in found
    assert answers([], tmp_path / "none") == []
    assert sets_table(tmp_path / "none") == ""


def test_an_absent_ledger_has_no_rows(tmp_path):
    assert read_rows(tmp_path / "none.json") == []


def test_every_row_answers_a_question_and_every_benchmark_belongs_to_one():
    rows = read_rows()
    assert len(rows) > 200
    assert [row["line"] for row in rows if question_of(row["command"]) is OTHER] == []
    named = [name for question in QUESTIONS for name in question.commands]
    assert len(named) == len(set(named))


def test_an_answer_counts_groups_of_searches_and_uses_the_smaller_excess(tmp_path):
    published = PAGE.parent / "results"
    for name in ("gap_room", "gap_filament", "gap_metadrive"):
        shutil.copytree(published / name / "set", tmp_path / name / "set")
    shutil.copy(published / "sets_about.json", tmp_path / "sets_about.json")
    (answer,) = [each.text for each in answers([], tmp_path) if each.question == "Does it transfer?"]
    assert "3 registered sets are 2 groups of searches in 2 worlds: 3 sets explore, 0 confirm." in answer
    # MetaDrive's 0.204 m over the plain panel are 0.067 m over no object.
    assert "by 0.067 to 0.074 m per tick over the stronger control; 1 lack drives with no object" in answer
    file = tmp_path / "gap_metadrive" / "set" / "set.json"
    data = json.loads(file.read_text())
    for row in data["rows"]:
        row["over_no_object_low_m"] = row["over_no_object_low_m"] and -0.01
    file.write_text(json.dumps(data))
    (answer,) = [each.text for each in answers([], tmp_path) if each.question == "Does it transfer?"]
    assert "In 2 of 3 comparisons" in answer


def test_a_set_with_a_claim_and_no_test_is_told(tmp_path):
    published = PAGE.parent / "results"
    shutil.copytree(published / "metadrive_billboard" / "set", tmp_path / "metadrive_billboard" / "set")
    shutil.copy(published / "sets_about.json", tmp_path / "sets_about.json")
    (answer,) = [each.text for each in answers([], tmp_path) if each.question == "Does it transfer?"]
    assert answer.startswith(
        "1 registered sets are 1 groups of searches in 1 worlds: 1 sets explore, 0 confirm. It adds to the strongest baseline, per tick and in drives off the track: "
    )
