"""The numbers of an audit are held to its drives, of drives that end where the test says, without any search."""

import json
from dataclasses import replace

import numpy as np
import pytest

from advnerf_core.errors import ConfigError
from advnerf_core.files import sha256_of
from advnerf_core.report.audit_result import AuditComparison, AuditEffect, read_audit, write_audit
from nodes.audit.comparing import ATTACK_KEPT, Before
from nodes.audit.judging import (
    LEARNED_ARMS,
    WORLD_ARMS,
    comparison_of,
    controls_of,
    disturbed_numbers_of,
    numbers_of,
)
from nodes.audit.kept import DRIVES, RESULT, AuditDiffersError, KeptDrivesError, check_audit, read_drives
from nodes.audit.question import FILE as QUESTION
from nodes.audit.sentence import sentence_of
from tests.support.audits import audit, audit_result
from tests.support.commands import advnerf as command

LIMIT_M, STARTS, TICKS = 0.4, 8, 20
ENDS_M = {"object": 0.9, "object_disturbed": 0.7}


def kept_drives(arms):
    """Drives along the x axis that end beside it: those past the object off the lane."""
    along, offsets_m = np.linspace(0.0, 2.0, TICKS + 1), np.linspace(-0.05, 0.05, STARTS)
    states = {
        name: [
            np.stack([along, offset_m + ENDS_M.get(name, 0.1) * along / 2.0, 0.0 * along], axis=1).tolist()
            for offset_m in offsets_m
        ]
        for name in arms
    }
    return {
        "path": {"start_pose": [0.0, 0.0, 0.0], "segments": [["line", 10.0]]},
        "limits": {"ticks": TICKS, "dt_s": 0.1, "held_cap_m": 1.6},
        "off_track_m": LIMIT_M,
        "states": states,
        "driven_ticks": {name: [TICKS] * STARTS for name in arms},
    }


def judged(evidence, kept):
    numbers = {
        "evidence": evidence,
        "measure": "max_abs_cte",
        **numbers_of(kept.arms, LIMIT_M, 0.1),
        "disturbed": None,
    }
    if evidence == "surrogate":
        effects = dict.fromkeys(("noise", "gain", "brightness", "jitter_m", "jitter_rad"), 0.02)
        numbers["disturbed"] = {**effects, **disturbed_numbers_of(kept.arms, LIMIT_M)}
    return numbers


@pytest.fixture
def folder(tmp_path):
    """The folder of an audit that was judged in a learned copy and in a world."""
    drives = {"surrogate": kept_drives(LEARNED_ARMS), "world": kept_drives(WORLD_ARMS)}
    (tmp_path / DRIVES).write_text(json.dumps(drives))
    found = read_drives(tmp_path)
    (tmp_path / QUESTION).write_text("name: audit\n")
    (tmp_path / "panel.png").write_bytes(b"a picture")
    panel = {**audit()["strongest"]["object"], "texture_sha256": sha256_of(tmp_path / "panel.png")}
    searches = [
        {**audit()["tried"][0], "setting": f"1-gradient-{number}", "off_track": left, "effect_m": effect_m}
        for number, left, effect_m in ((1, 2, 0.5), (2, 4, 0.3), (3, 4, 0.4))
    ]
    result = audit_result(
        question={"file": QUESTION, "sha256": sha256_of(tmp_path / QUESTION)},
        tried=[{**each, "selected": each["setting"] == "1-gradient-3"} for each in searches],
        budget={**audit()["budget"], "evaluations_spent": 150},
        place={**audit()["place"], "off_track_m": LIMIT_M},
        starts={**audit()["starts"], "judging": {"seed": 2, "count": STARTS}},
        strongest={"object": panel, "judgements": [judged(*each) for each in found.items()]},
        controls=[
            control for name, each in found.items() for control in controls_of(name, each.arms, LIMIT_M)
        ],
    )
    said = result.verdict.model_copy(update={"sentence": sentence_of(result, "found", ())})
    write_audit(tmp_path / RESULT, result.model_copy(update={"verdict": said}))
    return tmp_path


def change(file, edit):
    data = json.loads(file.read_text())
    edit(data)
    file.write_text(json.dumps(data))


def test_an_audit_as_it_was_written_agrees_with_its_drives(folder):
    assert [line.split(": ", 1)[1] for line in check_audit(folder)] == [
        f"{evidence}, {STARTS} starts: as the drives say" for evidence in ("surrogate", "world")
    ]


def test_the_command_verifies_an_audit_from_any_folder_and_asks_for_that_of_the_sets(
    folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder)  # without docs/results
    assert command(monkeypatch, "verify", folder) == 0
    assert "as the drives say" in capsys.readouterr().out
    assert command(monkeypatch, "verify") == 2
    assert "got docs/results, which does not exist; give --folder" in capsys.readouterr().err


def last(data):
    return data["strongest"]["judgements"][-1]


def shifted(data):
    """One start to the other, of which the mean stays."""
    for start, by_m in zip(last(data)["starts"], (0.01, -0.01), strict=False):
        start["off_path_m"] += by_m


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (shifted, r"world\.starts\.0\.off_path_m"),
        (lambda data: last(data)["effect"].update(high_m=3.0), r"world\.effect\.high_m"),
        (lambda data: last(data)["starts"][0].update(x_m=1.0), r"world\.starts\.0\.x_m"),
        (
            lambda data: last(data)["starts"][3].update(control_off_track=True),
            r"starts\.3\.control_off_track",
        ),
        (lambda data: last(data)["route"].pop(), r"world\.route"),
        (lambda data: last(data)["route"][2].update(y_m=0.5), r"world\.route\.2\.y_m"),
        (lambda data: data["controls"][0].update(off_track=3), r"surrogate: controls\.0\.off_track"),
        (lambda data: data["controls"].pop(), r"world: controls"),
        (
            lambda data: data["strongest"]["judgements"][0]["disturbed"].update(plain_off_track=4),
            r"surrogate\.disturbed\.plain_off_track",
        ),
        (lambda data: data["strongest"]["judgements"][0].update(disturbed=None), "surrogate: disturbed"),
        (lambda data: data["place"].update(off_track_m=1.0), r"place\.off_track_m"),
        (lambda data: data["starts"]["judging"].update(count=80), r"starts\.judging\.count"),
        (lambda data: data["strongest"]["judgements"].pop(0), "judged evidence"),
        (lambda data: data["verdict"].update(outcome="nothing_found"), "verdict: expected found"),
        (lambda data: data["verdict"].update(sentence="It moves by 0.01 m."), r"verdict\.sentence"),
        (lambda data: data["strongest"]["object"]["pose"].update(x_m=9.0), r"verdict\.sentence"),
        (lambda data: data["place"].update(name="Elsewhere"), r"verdict\.sentence"),
        (lambda data: data["question"].update(sha256="0" * 64), r"SHA-256 of audit\.experiment\.yaml"),
        (
            lambda data: data["strongest"]["object"].update(texture="a.png"),
            "SHA-256 of a.png: expected no file",
        ),
        (
            lambda data: data["budget"].update(evaluations_spent=90),
            r"budget\.evaluations_spent: expected 150",
        ),
        (lambda data: data["tried"].pop(), r"evaluations_spent: expected 100"),
        (
            lambda data: data["tried"][0].update(off_track=8),
            r"tried: the selected one\.0: expected 1-gradient-1",
        ),
        (lambda data: data["tried"][1].update(effect_m=0.9), r"the selected one\.0: expected 1-gradient-2"),
        (
            lambda data: data["verdict"].update(outcome="cannot_judge", evidence=None, reasons=["no time"]),
            "verdict: expected found",
        ),
        (
            lambda data: data.update(
                strongest=None,
                verdict={
                    **data["verdict"],
                    "outcome": "cannot_judge",
                    "evidence": None,
                    "reasons": ["no time"],
                },
            ),
            "judged evidence",
        ),
    ],
)
def test_every_number_that_was_changed_is_noticed(folder, edit, says):
    change(folder / RESULT, edit)
    with pytest.raises(AuditDiffersError, match=says):
        check_audit(folder)


@pytest.mark.parametrize(
    "edit",
    [
        lambda data: data.update(world=[]),
        lambda data: data["world"].pop("limits"),
        lambda data: data["world"]["states"].pop("natural_picture"),
        lambda data: data["world"]["states"]["object"].pop(),
        lambda data: data["world"]["states"]["object"][0].pop(),
        lambda data: data["world"].update(driven_ticks=dict.fromkeys(WORLD_ARMS, "all")),
        lambda data: data["world"].update(states={name: [] for name in WORLD_ARMS}),
    ],
)
def test_drives_that_are_damaged_are_one_error(folder, edit):
    change(folder / DRIVES, edit)
    with pytest.raises(KeptDrivesError, match="expected the drives of the audit beside it"):
        check_audit(folder)


def compared(folder, now_m, then_m):
    """The result of the folder as one that is compared with an earlier one: ends beside the path [m] without any object."""
    arms = [name for name in WORLD_ARMS if name != "natural_picture"]

    def edit(data, end_m=0.0):
        data.update(against=kept_drives(arms), against_then=kept_drives(arms))
        for key, end_m in (("against", now_m), ("against_then", then_m)):
            for number, states in enumerate(data[key]["states"]["no_object"]):
                for state in states:
                    state[1] = end_m * state[0] / 2.0 + 0.001 * number

    change(folder / DRIVES, edit)
    both = read_drives(folder)
    numbers = comparison_of(both["against"].arms, both["against_then"].arms, LIMIT_M)
    result = read_audit(folder / RESULT)
    fields = {"file": "old/audit.json", "sha256": "0" * 64, "margin_m": 0.04, "starts": STARTS}
    result = result.model_copy(update={"against": AuditComparison(**fields, **numbers)})
    outcome = "worse" if result.against.is_worse else "found"
    said = {"outcome": outcome, "sentence": sentence_of(result, outcome, ())}
    write_audit(
        folder / RESULT, result.model_copy(update={"verdict": result.verdict.model_copy(update=said)})
    )


def test_a_policy_that_got_worse_is_held_to_the_drives_that_say_so(folder):
    compared(folder, 0.6, 0.1)
    assert check_audit(folder)[-1].endswith(f"against old/audit.json, {STARTS} starts: as the drives say")
    sentence = read_audit(folder / RESULT).verdict.sentence
    assert "it comes 0.50 m farther off its path without any object (98% 0.50 to 0.50)" in sentence
    assert sentence.endswith(f"without any object it leaves its lane from {STARTS}, then from 0.")


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            lambda data: data["against"].update(off_track_alone_then=3),
            r"against\.off_track_alone_then: expected 0",
        ),
        (lambda data: data["against"]["effect"].update(low_m=0.3), r"against\.effect\.low_m"),
        (lambda data: data["against"].update(past="object"), r"against\.past: expected no_object"),
        (lambda data: data["against"].update(starts=7), r"against\.starts: expected 8"),
    ],
)
def test_a_comparison_that_was_changed_is_noticed(folder, edit, says):
    compared(folder, 0.6, 0.1)
    change(folder / RESULT, edit)
    with pytest.raises(AuditDiffersError, match=says):
        check_audit(folder)


def test_a_comparison_without_its_drives_is_noticed(folder):
    compared(folder, 0.12, 0.1)
    change(folder / DRIVES, lambda data: data.pop("against_then"))
    with pytest.raises(AuditDiffersError, match="compared drives"):
        check_audit(folder)


def test_what_was_found_or_not_is_said_without_contradiction():
    found = audit_result()
    near = found.strongest.judgements[0].model_copy(
        update={"effect": AuditEffect(mean_m=-0.004, low_m=-0.03, high_m=0.02)}
    )
    result = found.model_copy(
        update={"strongest": found.strongest.model_copy(update={"judgements": (near,)})}
    )
    assert sentence_of(result, "nothing_found", ()).endswith(
        "the strongest of 1 brings it no farther off its path (0.00 m, 95 % -0.03 to 0.02) and out of its lane from 3 of 4 starts; a plain "
        "one, or none, does from 0, so that this may be chance."
    )


def test_an_audit_in_which_nothing_was_judged_has_no_drives(folder):
    result = audit_result("cannot_judge", strongest=None, controls=[])
    updates = {
        "question": read_audit(folder / RESULT).question,
        "budget": result.budget.model_copy(update={"evaluations_spent": 50}),
        "verdict": result.verdict.model_copy(
            update={"sentence": sentence_of(result, "cannot_judge", result.verdict.reasons)}
        ),
    }
    write_audit(folder / RESULT, result.model_copy(update=updates))
    for drives in ("{}", None):
        (folder / DRIVES).unlink() if drives is None else (folder / DRIVES).write_text(drives)
        assert check_audit(folder) == [f"{folder}: cannot_judge, nothing was judged"]


@pytest.mark.parametrize(
    ("moved", "says"),
    [
        ((0.01, 0.0, 0.01), ""),
        ((0.0, 0.2, 0.0), r"others, up to 0\.200 m and 0\.000 rad"),
        ((0.0, 0.0, 0.3), r"and 0\.300 rad"),
        (None, "3 instead of 8"),
    ],
)
def test_audits_are_compared_from_the_same_starts_only(folder, moved, says, monkeypatch):
    monkeypatch.setattr("nodes.audit.comparing.load_attack", lambda file: None)
    (folder / ATTACK_KEPT).touch()
    before = Before(folder / RESULT)
    now = {
        name: replace(each, states=each.states[:3] if moved is None else each.states + np.array(moved))
        for name, each in read_drives(folder)["world"].arms.items()
    }
    if not says:
        assert before.compare(now, "world", LIMIT_M).effect.mean_m == 0.0
        return
    with pytest.raises(ConfigError, match=f"expected the starts of that audit, got .*{says}"):
        before.compare(now, "world", LIMIT_M)
