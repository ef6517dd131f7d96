"""``advnerf policy export`` and ``policy eval``: what cannot be is refused before anything is written over, and results have a folder each."""

import pytest

from advnerf_core.data.logs.choice import LogChoice, LogError, LogRequest
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy, save_policy
from nodes.lab.policy_data.frames import view_for_size
from tests.support.commands import advnerf
from tests.support.logs import write_tub_2


@pytest.fixture
def policy(tmp_path):
    save_policy(tmp_path / "policy.safetensors", PilotNet().eval(), view_for_size(64, 48), {})
    return tmp_path / "policy.safetensors"


@pytest.fixture
def onnx(tmp_path, policy):
    loaded = load_policy(policy)
    export_onnx(loaded.policy, PolicyContract(loaded.view), tmp_path / "mine.onnx")
    return tmp_path / "mine.onnx"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("{policy}", "--onnx", "{policy}"), "--onnx: expected a file name that ends with .onnx"),
        (("{policy}", "--onnx", "a.pt2"), "--onnx: expected a file name that ends with .onnx, got a.pt2"),
        (("{policy}", "--pt2", "a.onnx"), "--pt2: expected a file name that ends with .pt2, got a.onnx"),
        (("{onnx}", "--pt2", "a.pt2"), "which cannot be converted"),
    ],
)
def test_an_export_keeps_the_policy_and_has_a_name_that_can_be_loaded(
    policy, onnx, arguments, told, monkeypatch, capsys
):
    before = policy.read_bytes()
    given = [each.format(policy=policy, onnx=onnx) for each in arguments]
    assert advnerf(monkeypatch, "policy", "export", *given) == 2
    assert told in capsys.readouterr().err
    assert policy.read_bytes() == before


def test_a_policy_without_a_gradient_is_evaluated_without_maps(tmp_path, onnx, monkeypatch, capsys):
    log = f"{write_tub_2(tmp_path / 'tub')},steering-full-rad=0.4"
    asked = ("policy", "eval", str(onnx), log, "-o", str(tmp_path / "eval"))
    assert advnerf(monkeypatch, *asked) == 0
    assert [each.name for each in (tmp_path / "eval").iterdir()] == ["steering.png"]
    for option in (("--saliency", "3"), ("--video",)):
        assert advnerf(monkeypatch, *asked, *option) == 2
        assert "expected a policy with a gradient for --saliency and --video" in capsys.readouterr().err
    assert advnerf(monkeypatch, *asked, "--goal", "1") == 2
    assert "expected a goal of 0 numbers for this policy, got 1" in capsys.readouterr().err


def test_each_evaluated_log_has_a_folder_and_only_the_latest_maps(tmp_path, policy, monkeypatch):
    tub = write_tub_2(tmp_path / "tub")
    logs = [f"{tub},steering-full-rad={full_rad}" for full_rad in (0.3, 0.4)]
    out = tmp_path / "eval"
    assert advnerf(monkeypatch, "policy", "eval", str(policy), *logs, "--saliency", "3", "-o", str(out)) == 0
    assert sorted(each.name for each in out.iterdir()) == [
        f"eval_{tmp_path.name}_tub", f"eval_{tmp_path.name}_tub_2"
    ]  # fmt: skip
    assert advnerf(monkeypatch, "policy", "eval", str(policy), *logs, "--saliency", "1", "-o", str(out)) == 0
    assert [len(list(each.glob("saliency_*"))) for each in out.iterdir()] == [1, 1]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ("steering-offset-rad=nan", "less than 1.5708 rad, not degrees, got nan"),
        ("steering-offset-rad=3", "less than 1.5708 rad, not degrees, got 3"),
        ("steering-full-rad=0.3,steering-full-rad=0.4", "given twice, 0.3 and 0.4"),
    ],
)
def test_settings_of_a_log_that_cannot_be(settings, told):
    with pytest.raises(LogError, match=told):
        LogChoice().with_settings(settings)


@pytest.mark.parametrize(
    "ending", ["steering-full-rad=0.3", " steering-full-rad=0.3", "steering_full_rad=0.3"]
)
def test_settings_are_read_as_people_write_them(tmp_path, ending):
    log = write_tub_2(tmp_path / "tub")
    request = LogRequest.parsed(f"{log},{ending}")
    assert request.path == log
    assert request.choice(LogChoice()).steering_full_rad == 0.3
