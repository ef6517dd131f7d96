import copy
import json
import subprocess
import sys

import jsonschema
import pytest
from pydantic import ValidationError

from advnerf_core.errors import ConfigError
from advnerf_core.report.audit_result import AuditResult, audit_schema, read_audit, write_audit
from tests.support.audits import audit, audit_result, comparison, judged_drives

OUTCOMES = {"nothing_found": 0, "found": 1, "cannot_judge": 2, "worse": 3}


@pytest.mark.parametrize(("outcome", "code"), OUTCOMES.items())
def test_a_result_is_read_as_it_was_written(tmp_path, outcome, code):
    result = audit_result(outcome, against=comparison(outcome))
    write_audit(tmp_path / "audit.json", result)
    assert read_audit(tmp_path / "audit.json") == result
    assert result.exit_code == code
    jsonschema.validate(json.loads((tmp_path / "audit.json").read_text()), audit_schema())


def test_the_schema_is_one_and_refuses_what_the_model_refuses():
    schema = audit_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    for wrong in ({"unknown": 1}, {"starts": {}}, {"policy": {"path": "", "sha256": None}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(audit(**wrong), schema)
        with pytest.raises(ValidationError):
            AuditResult.model_validate(audit(**wrong))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"place": {**audit()["place"], "scale": None}}, "a judged object needs a known scale"),
        ({"strongest": None}, "found needs a judgement with the verdict's evidence"),
        ({"verdict": {**audit()["verdict"], "outcome": "worse"}}, "worse needs the comparison"),
        (
            {
                "verdict": {**audit()["verdict"], "outcome": "worse"},
                "against": comparison("found"),
            },
            "with a lower end above the margin",
        ),
        ({"against": comparison("worse")}, "such a comparison has no other verdict"),
        (
            {"verdict": {**audit()["verdict"], "outcome": "nothing_found", "evidence": "live"}},
            "nothing_found needs a judgement with the verdict's evidence",
        ),
        (
            {
                "verdict": {**audit()["verdict"], "outcome": "nothing_found", "evidence": "surrogate"},
                "strongest": {
                    **audit()["strongest"],
                    "judgements": [judged_drives("surrogate"), judged_drives("world")],
                },
            },
            "the strongest evidence that was judged",
        ),
        (
            {"verdict": {**audit()["verdict"], "outcome": "nothing_found"}, "planted": None},
            "needs a planted control",
        ),
        (
            {"verdict": {**audit()["verdict"], "outcome": "cannot_judge"}},
            "expected reasons exactly for cannot_judge",
        ),
        (
            {"starts": {each: {"seed": 1, "count": 4} for each in ("search", "selection", "judging")}},
            "different seeds",
        ),
        ({"fidelity": {**audit()["fidelity"], "trusted": False}}, "expected reasons in why"),
    ],
)
def test_a_conclusion_that_the_rest_does_not_support_is_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        AuditResult.model_validate(audit(**changes))


def test_a_surrogate_that_is_not_trusted_supports_no_verdict_of_its_own():
    doubtful = {**audit()["fidelity"], "trusted": False, "why": ["PSNR 19 dB, at least 25 needed"]}
    with pytest.raises(ValidationError, match="needs a trusted fidelity"):
        audit_result(evidence="surrogate", fidelity=doubtful)
    assert audit_result(evidence="world", fidelity=doubtful).exit_code == 1


def test_a_mean_that_is_not_that_of_the_drives_is_refused():
    changed = copy.deepcopy(audit()["strongest"])
    changed["judgements"][0]["starts"][0]["off_path_m"] += 0.1
    with pytest.raises(ValidationError, match="the mean over the starts"):
        audit_result(strongest=changed)


def test_a_file_with_errors_gets_one_line_for_each(tmp_path):
    data = audit()
    data["policy"]["hash"] = data["policy"].pop("sha256")
    data["budget"]["seconds"] = "long"
    (tmp_path / "audit.json").write_text(json.dumps(data))
    with pytest.raises(ConfigError) as error:
        read_audit(tmp_path / "audit.json")
    lines = str(error.value).splitlines()
    assert [line.split(": ")[1].split(",")[0] for line in lines] == [
        "unknown key policy.hash; valid keys here",
        "policy.sha256 is missing; add it",
        "budget.seconds",
    ]


def test_the_count_off_the_track_is_that_of_the_starts():
    assert audit_result().judgement.off_track == 3


def test_no_torch_is_loaded():
    code = "import sys, advnerf_core.report.audit_result; assert not {'torch', 'scipy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
