"""The numbers of an audit are held to its drives, of drives that end where the test says, without any search."""

import json
from dataclasses import replace

import numpy as np
import pytest

from advnerf_core.errors import ConfigError
from advnerf_core.report.audit_result import write_audit
from nodes.audit.comparing import ATTACK_KEPT, Before
from nodes.audit.judging import (
    LEARNED_ARMS,
    WORLD_ARMS,
    controls_of,
    disturbed_numbers_of,
    judgement_of,
    numbers_of,
)
from nodes.audit.kept import DRIVES, RESULT, AuditDiffersError, KeptDrivesError, check_audit, read_drives
from nodes.audit.verdict import effect_in_words
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
    sentence = f"It brings the policy {effect_in_words(judgement_of(found['world'].arms, LIMIT_M))}; a plain one does not."
    result = audit_result(
        verdict={"outcome": "found", "evidence": "world", "sentence": sentence, "reasons": []},
        place={**audit()["place"], "off_track_m": LIMIT_M},
        starts={**audit()["starts"], "judging": {"seed": 2, "count": STARTS}},
        strongest={**audit()["strongest"], "judgements": [judged(*each) for each in found.items()]},
        controls=[
            control for name, each in found.items() for control in controls_of(name, each.arms, LIMIT_M)
        ],
    )
    write_audit(tmp_path / RESULT, result)
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


def test_an_audit_in_which_nothing_was_judged_has_no_drives(folder):
    write_audit(folder / RESULT, audit_result("cannot_judge", strongest=None, controls=[]))
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
