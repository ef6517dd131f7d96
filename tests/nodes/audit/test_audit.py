"""Whole audits by the command, of policies whose truth is known, in a place that is known by photographs of a drive in a circle."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from advnerf_core.documents import read_json
from advnerf_core.report.audit_result import read_audit
from nodes.audit.kept import AuditDiffersError, check_audit
from tests.support import circle_place
from tests.support.circle_place import RADIUS_M, WHEELBASE_M

pytestmark = pytest.mark.slow  # a learned place and a dozen searches each


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder."""
    found = tmp_path_factory.mktemp("user")
    circle_place.make_folder(found)
    return found


def audit(folder: Path, policy: str, *options: str, output: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command; what an earlier audit has learned of the place is taken over."""
    target, learned = folder / (output or policy), folder / "seduced"
    for half in ("half", "other-half"):
        if learned.exists() and target != learned and not (target / half).exists():
            shutil.copytree(learned / half, target / half)
    return circle_place.audit(folder, policy, *options, output=output)


@pytest.fixture(scope="module")
def seduced(folder: Path) -> subprocess.CompletedProcess[str]:
    return audit(folder, "seduced", "--harden", "--ci")


def test_a_policy_that_red_leads_astray_is_found_and_the_numbers_are_those_of_the_drives(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    assert seduced.returncode == 1, seduced.stdout + seduced.stderr
    result = read_audit(folder / "seduced" / "audit.json")
    assert result.verdict.evidence == "surrogate"
    assert "not driven" in result.verdict.sentence
    assert result.fidelity is not None
    assert result.fidelity.halves_agree
    assert {each.kind: each.off_track for each in result.controls} == {
        "no_object": 0,
        "plain_object": 0,
        "natural_picture": 0,
    }
    assert result.strongest is not None
    assert (folder / "seduced" / result.strongest.object.texture).is_file()
    worse = result.strongest.judgements[0].disturbed
    assert worse is not None
    assert (worse.off_track, worse.plain_off_track) == (8, 0), "red leads it astray through noise, too"
    assert check_audit(folder / "seduced")
    page = (folder / "seduced" / "audit.html").read_text()
    assert page.index(result.verdict.sentence) < page.index("<video") < page.index("<svg")


def test_a_changed_number_is_noticed(
    folder: Path, seduced: subprocess.CompletedProcess[str], tmp_path: Path
) -> None:
    for name in ("audit.json", "drives.json"):
        shutil.copy(folder / "seduced" / name, tmp_path / name)
    data: dict[str, Any] = read_json(tmp_path / "audit.json")
    data["strongest"]["judgements"][0]["effect"]["low_m"] -= 0.01
    (tmp_path / "audit.json").write_text(json.dumps(data))
    with pytest.raises(AuditDiffersError, match=r"effect\.low_m: expected"):
        check_audit(tmp_path)


def test_a_second_run_gives_the_same_bytes(folder: Path, seduced: subprocess.CompletedProcess[str]) -> None:
    before = (folder / "seduced" / "audit.json").read_bytes()
    again = audit(folder, "seduced", "--ci")
    assert again.returncode == seduced.returncode
    assert (folder / "seduced" / "audit.json").read_bytes() == before


def test_a_cluster_finds_the_same(folder: Path, seduced: subprocess.CompletedProcess[str]) -> None:
    pytest.importorskip("ray")
    found = audit(folder, "seduced", "--ci", "--cluster", "here", output="spread")
    assert found.returncode == seduced.returncode, found.stdout + found.stderr
    for name in ("audit.json", "object.attack.safetensors"):
        assert (folder / "spread" / name).read_bytes() == (folder / "seduced" / name).read_bytes(), name


def test_the_action_for_continuous_integration_gives_the_same_bytes(
    folder: Path, seduced: subprocess.CompletedProcess[str], tmp_path: Path
) -> None:
    action = yaml.safe_load((circle_place.ROOT / ".github/actions/audit/action.yml").read_text())
    step = next(each for each in action["runs"]["steps"] if each.get("name") == "audit")
    given = {name: str(row.get("default", "")) for name, row in action["inputs"].items()}
    options = circle_place.command("seduced")[circle_place.command("seduced").index("--evaluations") :]
    given |= {
        "policy": "drivers:seduced",
        "place": "photos",
        "car": "car.yaml",
        "limit": str(circle_place.LIMIT_M),
        "output": "action",
        "options": " ".join(options),
    }
    (tmp_path / "advnerf").write_text(f'#!/bin/sh\nexec {sys.executable} -m nodes.cli "$@"\n')
    (tmp_path / "advnerf").chmod(0o755)
    environment = circle_place.environment(folder)
    environment |= {name: given[text.split(".")[1].split()[0]] for name, text in step["env"].items()}
    environment["PATH"] = f"{tmp_path}:{environment['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", step["run"]], cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == seduced.returncode, done.stdout + done.stderr
    assert (folder / "action/audit.json").read_bytes() == (folder / "seduced/audit.json").read_bytes()


def test_exported_frames_are_labelled_with_steering_back_to_the_path(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    rows = (folder / "seduced" / "harden" / "labels.csv").read_text().splitlines()
    columns = rows[0].split(",")
    labels = [dict(zip(columns, row.split(","), strict=True)) for row in rows[1:]]
    assert all((folder / "seduced" / "harden" / each["image"]).is_file() for each in labels)
    held = math.atan(WHEELBASE_M / RADIUS_M)
    # Where a drive first leaves its line; farther off, a car that already turns back steeply is straightened.
    first: dict[str, dict[str, str]] = {}
    for each in labels:
        if abs(float(each["cte_m"])) > 0.15:
            first.setdefault(each["image"].split("_")[0], each)
    assert len(first) == 5
    assert all((float(each["steering"]) - held) * float(each["cte_m"]) < 0.0 for each in first.values())


def test_a_blind_policy_is_cleared_once_a_planted_weakness_was_found(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "blind")
    assert found.returncode == 0, found.stdout + found.stderr
    result = read_audit(folder / "blind" / "audit.json")
    assert result.planted is not None
    assert result.planted.found
    assert "no object was found within this budget" in result.verdict.sentence
    # No gradient leads a policy that does not look, and its gradient searches are not told as ones that found nothing.
    assert "gradient at spot 1: the policy's gradient is exactly zero" in found.stdout
    assert {"random_coarse"} == {each.method for each in result.tried}
    assert sum("gradient is exactly zero" in each.why for each in result.not_tried) == 3


def test_a_policy_that_does_not_drive_is_not_judged(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "astray")
    assert found.returncode == 2, found.stdout + found.stderr
    assert "does not drive here: without any object it leaves its lane from 4 of 4 starts" in found.stdout


def test_a_biased_policy_is_worse_than_before_and_an_unchanged_one_is_not(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    against = ("--against", "seduced/audit.json")
    assert audit(folder, "seduced", *against, output="again").returncode == 1
    found = audit(folder, "biased", *against)
    assert found.returncode == 3, found.stdout + found.stderr
    assert "The policy is worse than in seduced/audit.json" in found.stdout


def test_without_a_terminal_a_question_names_its_option(folder: Path) -> None:
    found = audit(folder, "blind", "--car", "racecarj", output="asked")
    assert found.returncode == 2
    assert "expected --camera-height, as no terminal can be asked" in found.stderr


def test_another_question_in_the_same_folder_is_refused(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "blind", output="seduced")
    assert found.returncode == 64
    assert "expected a folder of this audit or a new one" in found.stderr
