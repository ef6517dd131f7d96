"""An audit's exports, held against the readers and checkers of the formats' own people."""

import json
import shutil
import subprocess
import sys
import tarfile
import xml.etree.ElementTree as ET

import jsonschema
import pytest

from advnerf_core.report.exports.junit import HOLDS_PATH, write_junit
from advnerf_core.report.exports.openscenario import write_openscenario
from advnerf_core.report.exports.sarif import write_sarif
from advnerf_core.report.exports.write import write_exports
from tests.support.audits import audit, audit_result, comparison

NO_DRIVES = {"path": [], "route": []}


def result_with(outcome="found", evidence="world", **drives):
    strongest = audit(evidence=evidence)["strongest"]
    strongest["judgements"][0] |= drives
    return audit_result(outcome, evidence, strongest=strongest, against=comparison(outcome))


def asam_issues(file):
    """Issues that ASAM's checker finds in a scenario, and the names of the checks that were completed."""
    from qc_baselib import Configuration, Result
    from qc_openscenario import constants, main

    config, found = Configuration(), Result()
    config.set_config_param("InputFile", str(file))
    config.register_checker_bundle(checker_bundle_name=constants.BUNDLE_NAME)
    found.register_checker_bundle(name=constants.BUNDLE_NAME, description="", version="1", summary="")
    main.run_checks(config, found)
    checks = [check for bundle in found._report_results.checker_bundles for check in bundle.checkers]
    issues = [issue.description for check in checks for issue in check.issues]
    return issues, [check.checker_id for check in checks if check.status.value == "completed"]


@pytest.mark.parametrize("drives", [{}, NO_DRIVES, {"path": []}, {"route": []}])
@pytest.mark.parametrize("outcome", ["found", "nothing_found", "cannot_judge", "worse"])
def test_asams_checker_finds_nothing_wrong(tmp_path, outcome, drives):
    write_openscenario(tmp_path / "a.xosc", result_with(outcome, **drives))
    issues, completed = asam_issues(tmp_path / "a.xosc")
    assert issues == []
    assert "check_asam_xosc_xml_valid_schema" in completed
    assert "check_asam_xosc_reference_control_resolvable_entity_references" in completed
    assert len(completed) >= 16


def test_asams_checker_is_really_asked(tmp_path):
    file = tmp_path / "a.xosc"
    write_openscenario(file, result_with())
    file.write_text(file.read_text().replace('entityRef="Object"', 'entityRef="Nobody"'))
    assert len(asam_issues(file)[0]) > 0


def test_the_road_network_is_that_of_the_place_or_none(tmp_path):
    write_openscenario(tmp_path / "a.xosc", result_with())
    assert list(ET.parse(tmp_path / "a.xosc").find("RoadNetwork")) == []
    with_roads = audit_result(place={**audit()["place"], "road_network": "roads.xodr"})
    write_openscenario(tmp_path / "a.xosc", with_roads)
    assert ET.parse(tmp_path / "a.xosc").find("RoadNetwork/LogicFile").get("filepath") == "roads.xodr"


def numbers(element, *names):
    return tuple(float(element.get(name)) for name in names)


def test_object_and_route_stand_where_the_audit_had_them(tmp_path):
    result = result_with()
    write_openscenario(tmp_path / "a.xosc", result)
    scenario = ET.parse(tmp_path / "a.xosc").getroot()
    header = scenario.find("FileHeader")
    assert (header.get("revMajor"), header.get("revMinor")) == ("1", "2")
    assert header.get("description") == result.verdict.sentence
    placed = scenario.find(".//Private[@entityRef='Object']//WorldPosition")
    assert numbers(placed, "x", "y", "z", "h", "p", "r") == (3.0, 0.8, 0.0, 3.1, 0.0, 0.0)
    size = scenario.find(".//MiscObject/BoundingBox/Dimensions")
    assert numbers(size, "length", "width", "height") == (0.02, 0.6, 0.6)
    assert scenario.find(".//MiscObject//File").get("filepath") == "panel.png"
    driven = [
        (*numbers(vertex, "time"), *numbers(vertex.find(".//WorldPosition"), "x", "y", "h"))
        for vertex in scenario.findall(".//Polyline/Vertex")
    ]
    assert driven == [(p.t_s, p.x_m, p.y_m, p.yaw_rad) for p in result.judgement.route]
    waypoints = [numbers(each, "x", "y") for each in scenario.findall(".//Route//WorldPosition")]
    assert waypoints == [(p.x_m, p.y_m) for p in result.judgement.path]


def test_long_paths_are_thinned_and_keep_their_ends(tmp_path):
    path = [{"t_s": 0.1 * i, "x_m": float(i), "y_m": 0.0, "yaw_rad": 0.0} for i in range(500)]
    write_openscenario(tmp_path / "a.xosc", result_with(path=path))
    found = ET.parse(tmp_path / "a.xosc").findall(".//Route//WorldPosition")
    xs = [float(each.get("x")) for each in found]
    assert (len(xs), xs[0], xs[-1]) == (30, 0.0, 499.0)
    assert xs == sorted(set(xs))


def test_what_the_audit_did_not_know_of_the_vehicle_is_listed(tmp_path):
    write_openscenario(tmp_path / "a.xosc", result_with())
    assumed = ET.parse(tmp_path / "a.xosc").find(".//Vehicle//Property[@name='assumed']").get("value")
    assert {"length", "width", "height", "maxSteering"} <= set(assumed.split(", "))
    sizes = {"length_m": 0.5, "width_m": 0.3, "height_m": 0.2, "max_steering_rad": 0.4}
    write_openscenario(tmp_path / "a.xosc", audit_result(vehicle={**audit()["vehicle"], **sizes}))
    vehicle = ET.parse(tmp_path / "a.xosc").find(".//Vehicle")
    assert not {"length", "width", "height", "maxSteering"} & set(
        vehicle.find(".//Property[@name='assumed']").get("value").split(", ")
    )
    assert numbers(vehicle.find("BoundingBox/Dimensions"), "length", "width", "height") == (0.5, 0.3, 0.2)
    assert numbers(vehicle.find("Axles/FrontAxle"), "maxSteering", "positionX") == (0.4, 0.33)


def test_without_an_object_there_is_no_scenario(tmp_path):
    nothing = audit_result("cannot_judge", strongest=None)
    assert [file.name for file in write_exports(tmp_path, nothing)] == ["audit.sarif", "audit.junit.xml"]
    assert [file.name for file in write_exports(tmp_path, audit_result())][2:] == ["audit.xosc"]
    assert all(file.exists() for file in write_exports(tmp_path, audit_result()))
    write_exports(tmp_path, nothing)  # the same folder, with another policy
    assert sorted(file.name for file in tmp_path.iterdir()) == ["audit.junit.xml", "audit.sarif"]


SARIF_CASES = [
    ("found", "world", "fail", "error", "ADV1001"),
    ("found", "live", "fail", "error", "ADV1001"),
    ("found", "surrogate", "fail", "warning", "ADV1001"),
    ("worse", "world", "fail", "error", "ADV1002"),
    ("nothing_found", "world", "pass", "none", "ADV1001"),
    ("cannot_judge", "world", "open", "none", "ADV1001"),
]


@pytest.mark.parametrize(("outcome", "evidence", "kind", "level", "rule"), SARIF_CASES)
def test_sarif_has_one_result_for_the_policy_file(tmp_path, outcome, evidence, kind, level, rule):
    from sarif_pydantic import Sarif

    write_sarif(tmp_path / "a.sarif", result_with(outcome, evidence))
    log = json.loads((tmp_path / "a.sarif").read_text())
    Sarif.model_validate(log)
    (run,) = log["runs"]
    (found,) = run["results"]
    assert (found["kind"], found["level"], found["ruleId"]) == (kind, level, rule)
    assert run["tool"]["driver"]["rules"][found["ruleIndex"]]["id"] == rule
    assert found["message"]["text"].startswith("In MetaDrive, a 0.6 m panel")
    where = found["locations"][0]["physicalLocation"]["artifactLocation"]
    assert where == {"uri": "policies/my_policy.onnx", "index": 0}
    assert run["artifacts"][0]["location"]["uri"] == where["uri"]


def test_the_same_finding_keeps_its_fingerprint_when_numbers_change(tmp_path):
    prints = []
    for name, result in (("a", audit_result()), ("b", result_with(**NO_DRIVES)), ("c", audit_result())):
        if name == "c":
            result = audit_result(place={**audit()["place"], "name": "the hall"})
        write_sarif(tmp_path / name, result)
        prints.append(
            json.loads((tmp_path / name).read_text())["runs"][0]["results"][0]["partialFingerprints"]
        )
    assert prints[0] == prints[1]
    assert prints[0] != prints[2]


@pytest.mark.parametrize(
    ("path", "uri"),
    [("/home/me/a policy.onnx", "file:///home/me/a%20policy.onnx"), ("a policy.onnx", "a%20policy.onnx")],
)
def test_paths_become_uris(tmp_path, path, uri):
    write_sarif(tmp_path / "a", audit_result(policy={"path": path, "sha256": "0" * 64}))
    run = json.loads((tmp_path / "a").read_text())["runs"][0]
    assert run["artifacts"][0]["location"]["uri"] == uri


def test_a_policy_without_a_file_is_a_name(tmp_path):
    write_sarif(tmp_path / "a", audit_result(policy={"path": "grpc://127.0.0.1:6789", "sha256": None}))
    run = json.loads((tmp_path / "a").read_text())["runs"][0]
    names = run["results"][0]["locations"][0]["logicalLocations"]
    assert names[0]["fullyQualifiedName"] == "grpc://127.0.0.1:6789"
    assert "artifacts" not in run


JUNIT_CASES = [("found", 1, 0), ("worse", 1, 0), ("nothing_found", 0, 0), ("cannot_judge", 0, 1)]


@pytest.mark.parametrize(("outcome", "failures", "errors"), JUNIT_CASES)
def test_junit_fails_where_the_audit_found_something(tmp_path, outcome, failures, errors):
    from junitparser import JUnitXml

    write_junit(tmp_path / "a.xml", result_with(outcome))
    (suite,) = JUnitXml.fromfile(str(tmp_path / "a.xml"))
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (3, failures, errors, 0)
    verdict = next(case for case in suite if case.name == HOLDS_PATH)
    assert bool(verdict.result) == (outcome != "nothing_found")
    assert verdict.time == 610.0


def test_junit_names_what_kept_the_audit_from_a_verdict(tmp_path):
    doubtful = {**audit()["fidelity"], "trusted": False, "why": ["PSNR 19 dB, at least 25 needed"]}
    missed = {**audit()["planted"], "found": False}
    for outcome, tag in (("cannot_judge", "failure"), ("found", "skipped")):
        write_junit(tmp_path / "a.xml", audit_result(outcome, fidelity=doubtful, planted=missed))
        messages = [each.get("message") for each in ET.parse(tmp_path / "a.xml").iter(tag)][:2]
        assert messages == ["PSNR 19 dB, at least 25 needed", "known victim: not found in 40 drives"]


def test_exports_load_no_torch():
    code = "import sys, advnerf_core.report.exports.write; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_a_date_and_a_time_the_same_audit_gives_the_same_bytes(tmp_path):
    written = []
    for folder in (tmp_path / "one", tmp_path / "other"):
        result = audit_result(date=None, budget={**audit()["budget"], "seconds": None})
        written.append([file.read_bytes() for file in write_exports(folder, result)])
    assert written[0] == written[1]
    assert asam_issues(tmp_path / "one" / "audit.xosc")[0] == []
    assert b"2026" not in b"".join(written[0])


@pytest.mark.slow
def test_microsofts_multitool_finds_no_error_in_sarif(tmp_path):
    if shutil.which("npm") is None:
        pytest.skip("needs npm, for Microsoft's SARIF Multitool")
    package = "@microsoft/sarif-multitool-linux@5.7.0"
    subprocess.run(["npm", "pack", "--silent", package], cwd=tmp_path, check=True, timeout=600)
    with tarfile.open(next(tmp_path.glob("*.tgz"))) as archive:
        archive.extractall(tmp_path, filter="data")
    tool = tmp_path / "package" / "Sarif.Multitool"
    tool.chmod(0o755)
    schema = json.loads((tmp_path / "package" / "sarif-2.1.0.json").read_text())
    for index, (outcome, evidence, *_) in enumerate(SARIF_CASES):
        file = tmp_path / f"{index}.sarif"
        write_sarif(file, result_with(outcome, evidence))
        jsonschema.validate(json.loads(file.read_text()), schema)
        command = [tool, "validate", file, "--level", "Error", "--kind", "Fail"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False,
                              env={"DOTNET_SYSTEM_GLOBALIZATION_INVARIANT": "1", "HOME": str(tmp_path)})  # fmt: skip
        assert "Analysis completed successfully" in done.stdout, done.stdout + done.stderr
        assert ": error " not in done.stdout


@pytest.mark.slow
def test_junit_fits_the_schema_that_pytest_tests_its_own_reports_with(tmp_path):
    import xmlschema

    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "-q",
        "--no-deps",
        "--no-binary",
        ":all:",
        "pytest==9.2.0",
    ]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=600)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        member = next(name for name in archive.getnames() if name.endswith("/junit-10.xsd"))
        archive.extract(member, tmp_path, filter="data")
    schema = xmlschema.XMLSchema(str(tmp_path / member))
    # This schema of Jenkins' xunit plug-in has no element for errors, which Jenkins itself reads.
    for outcome in ("found", "worse", "nothing_found"):
        write_junit(tmp_path / "a.xml", result_with(outcome))
        schema.validate(str(tmp_path / "a.xml"))
