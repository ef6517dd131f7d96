"""A request run in a folder: killed and gone on with, shown, checked."""

import dataclasses
import datetime
import json

import numpy as np
import pytest
import torch

from advnerf_core.attack import image_gradients
from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.problem import ZeroGradientError
from advnerf_core.attack.search.black_box import BudgetError
from advnerf_core.display import DisplayModel
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy, save_policy
from calibration.display_colour import DisplayCalibration
from calibration.schema import save_calibration
from nodes.experiment.node.check import check
from nodes.experiment.node.memory import measured_mib
from nodes.experiment.node.prepare import load_request, prepare, request_text
from nodes.experiment.node.search import attack_file, run_attack
from nodes.experiment.steps.keys import NoSuchCellError
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.tiny_request import StoppedError, loaded, stop_at_one, tiny_request

_SLOW = pytest.mark.slow  # the same loop with another search inside; tests of the searches resume them too


@pytest.mark.parametrize(
    "method",
    [
        "gradient",
        pytest.param("random", marks=_SLOW),
        pytest.param("cem", marks=_SLOW),
        pytest.param("evolution", marks=_SLOW),
    ],
)
def test_a_stopped_run_goes_on_to_the_same_bytes(tmp_path, method):
    file = tiny_request(tmp_path)
    changes = [
        f"over.method=[{method}]",
        "attack.population=4",
        "attack.robustness.noise=0.01",
        "attack.response.delay_s=0.05",
    ]
    request = loaded(file, changes)
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    assert not attack_file(tmp_path / "stopped", 0).exists()
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    attack = load_attack(whole)
    assert attack.method == method
    assert attack.required_face().subject == "board"
    assert len(json.loads((tmp_path / "whole" / "seed_0.json").read_text())["loss_m"]) == 3
    with pytest.raises(ConfigError, match="belongs to another attack"):
        run_attack(loaded(file), tmp_path / "whole", ProgressDisplay())


@pytest.mark.parametrize("together", [False, True])
def test_a_finished_seed_of_a_policy_that_has_changed_since_is_refused(tmp_path, together):
    file, folder = tiny_request(tmp_path, evaluations=1), tmp_path / "out"
    request = loaded(file, [f"attack.together={str(together).lower()}"])
    (found,) = run_attack(request, folder, ProgressDisplay())
    before = found.read_bytes()
    torch.manual_seed(1)
    old = load_policy(tmp_path / "policy.safetensors")
    save_policy(tmp_path / "policy.safetensors", PilotNet().eval(), old.view, {})
    with pytest.raises(ConfigError, match="choose another folder, or delete the file"):
        run_attack(loaded(file, [f"attack.together={str(together).lower()}"]), folder, ProgressDisplay())
    assert found.read_bytes() == before
    found.unlink()
    run_attack(loaded(file, [f"attack.together={str(together).lower()}"]), folder, ProgressDisplay())
    assert load_attack(found).policy_sha256 == load_policy(tmp_path / "policy.safetensors").sha256


def test_a_seed_without_its_curve_is_searched_again(tmp_path):
    request = loaded(tiny_request(tmp_path, evaluations=1))
    (found,) = run_attack(request, tmp_path / "out", ProgressDisplay())
    (curve := tmp_path / "out" / "seed_0.json").unlink()
    assert run_attack(request, tmp_path / "out", ProgressDisplay()) == [found]
    assert curve.exists()


def test_a_request_that_failed_to_load_does_not_lock_its_folder(tmp_path, monkeypatch, capsys):
    file, folder = tiny_request(tmp_path, evaluations=1), tmp_path / "out"
    wrong = "victims.mine.policy=not_here.safetensors"
    assert advnerf(monkeypatch, "attack", "run", file, "-o", folder, "--set", wrong) != 0
    assert "not_here.safetensors" in capsys.readouterr().err
    assert advnerf(monkeypatch, "attack", "run", file, "-o", folder) == 0
    assert advnerf(monkeypatch, "attack", "run", file, "-o", folder, "--set", "horizon=4") != 0
    assert "belongs to another attack" in capsys.readouterr().err
    kept = load_request(folder / "request.experiment.yaml", folder=folder)
    assert (
        request_text(kept) == request_text(loaded(file)) == (folder / "request.experiment.yaml").read_text()
    )


@pytest.mark.parametrize(
    "method", [pytest.param("distilled", marks=_SLOW), pytest.param("guided", marks=_SLOW)]
)
def test_an_onnx_policy_is_attacked_by_questions_within_the_budget_and_resumes_to_the_same_bytes(
    tmp_path, method
):
    file = tiny_request(tmp_path)
    victim = load_policy(tmp_path / "policy.safetensors")
    export_onnx(victim.policy, PolicyContract(victim.view), tmp_path / "policy.onnx")
    # 4 calls for the first lesson, 9 for each drive of 3 ticks with one pair of questions: three of them fit into 11 x 3.
    changes = [
        "victims.mine.policy=policy.onnx",
        f"over.method=[{method}]",
        "attack.evaluations=11",
        "attack.probes=1",
        "attack.warm_pairs=2",
    ]
    request = loaded(file, changes)
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    assert load_attack(whole).method == method
    assert len(json.loads((tmp_path / "whole" / "seed_0.json").read_text())["loss_m"]) == 3
    with pytest.raises(BudgetError, match="allow more evaluations"):
        run_attack(loaded(file, [*changes, "attack.evaluations=4"]), tmp_path / "poor", ProgressDisplay())
    with pytest.raises(NoSuchCellError, match="guided"):
        run_attack(loaded(file, [*changes, "over.method=[gradient]"]), tmp_path / "blind", ProgressDisplay())


@pytest.mark.slow  # tests/advnerf_core/attack/test_together.py has the search itself
def test_seeds_searched_together_resume_to_the_same_bytes_and_end_as_they_do_alone(tmp_path, monkeypatch):
    # In bfloat16 a batch of another size is rounded otherwise, and Adam turns what little gradient there is by a whole step.
    monkeypatch.setattr(image_gradients, "layer_type", lambda: torch.float32)
    file = tiny_request(tmp_path)
    request = loaded(file, ["over.seed=[0, 1]", "attack.together=true"])
    whole = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    resumed = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert [one.read_bytes() for one in resumed] == [one.read_bytes() for one in whole]
    alone = run_attack(loaded(file, ["over.seed=[0, 1]"]), tmp_path / "alone", ProgressDisplay())
    for one, other in zip(whole, alone, strict=True):
        assert load_attack(one).predicted_total_cte_m == pytest.approx(
            load_attack(other).predicted_total_cte_m, rel=1e-4
        )
        np.testing.assert_allclose(
            load_attack(one).face_object.theta, load_attack(other).face_object.theta, atol=1e-3
        )
    with pytest.raises(ConfigError, match="gradient method only"):
        loaded(file, ["over.method=[random]", "attack.together=true"])


def test_a_monitor_in_the_loop_is_searched_through_its_colours_and_the_gradient_is_sound(tmp_path):
    dim = DisplayModel(
        np.tile(np.linspace(0.0, 1.0, 9) ** 2.2, (3, 1)), 0.8 * np.eye(3) + 0.03, np.full(3, 0.05), 2.2
    )
    calibration = DisplayCalibration(date=datetime.date(2026, 1, 1), method="computed", model=dim.to_dict())
    save_calibration(calibration, tmp_path / "display.yaml")
    file = tiny_request(tmp_path)
    changes = ["attack.evaluations=2", "attack.robustness.jitter_m=0.001"]
    shown = loaded(file, changes)
    text = file.read_text().replace(
        "resolution: 8,", "resolution: 8, display: display.yaml, display_cos: 0.9,"
    )
    file.write_text(text)
    request = loaded(file, changes)
    prepared = prepare(request)
    theta = torch.randn(prepared.problem.sensor.theta_shape, generator=torch.manual_seed(0))
    seen = torch.logit(torch.tensor(dim.forward(torch.sigmoid(theta).numpy(), 0.9)), eps=1e-4).float()
    images = prepared.problem.sensor.sense(prepared.problem.start_states, theta).images
    torch.testing.assert_close(
        images, prepared.space.surrogate.sense(prepared.problem.start_states, seen).images
    )
    assert prepared.settings_hash != prepare(shown).settings_hash
    (attack,) = run_attack(request, tmp_path / "out", ProgressDisplay())
    assert load_attack(attack).required_face().subject == "board"
    assert check(loaded(file), 2, False, lambda fraction, text="": None).sound
    with pytest.raises(ConfigError, match="display: expected one object"):
        loaded(file, ["attack.together=true"])


def test_show_writes_the_texture_of_a_run_that_was_repeated(tmp_path, monkeypatch, capsys):
    file = tiny_request(tmp_path)
    for words in (
        ["run", file, "-o", tmp_path / "out"],
        ["run", file, "-o", tmp_path / "out"],
        ["show", tmp_path / "out" / "seed_0.attack.safetensors"],
    ):
        assert advnerf(monkeypatch, "attack", *words) == 0
    assert (tmp_path / "out" / "seed_0.texture.png").exists()
    assert load_attack(tmp_path / "out" / "seed_0.attack.safetensors").attack_id in capsys.readouterr().out


def test_the_check_confirms_the_gradient_and_says_so(tmp_path):
    found = check(loaded(tiny_request(tmp_path)), 3, False, lambda fraction, text="": None)
    assert found.frozen_error <= 1e-4
    assert found.sound
    assert found.verdict[0].startswith("gradient right")
    np.testing.assert_allclose(found.ticks.visible, 1.0)
    flat = dataclasses.replace(found, gradient_norm=0.0).verdict[0]
    assert flat.startswith("NO GRADIENT: an object is seen, but the policy's gradient in the picture is zero")
    still = dataclasses.replace(found.ticks, lambda_position=(0.0, 0.0), lambda_yaw=(0.0, 0.0))
    unmoved = dataclasses.replace(found, ticks=still).verdict[0]
    assert unmoved.startswith("NO GRADIENT: the objective does not change with the car's states")


AWAY = "objects=[{name: a, kind: panel, x_m: -3.5, y_m: 3.0, face: {size_m: 0.8, resolution: 4}}]"


def test_an_object_out_of_sight_has_no_gradient_and_the_check_says_so(tmp_path):
    found = check(loaded(tiny_request(tmp_path), [AWAY]), 2, False, lambda fraction, text="": None)
    assert not found.sound
    assert found.verdict[0].startswith("NO GRADIENT")


@pytest.mark.parametrize(
    "changes",
    [
        ["over.method=[random]"],
        ["attack.robustness.noise=0.01"],
        ["over.seed=[0, 1]", "attack.together=true"],
    ],
)
def test_a_search_of_an_object_out_of_sight_is_no_result(tmp_path, changes):
    request = loaded(tiny_request(tmp_path, evaluations=2), [AWAY, *changes])
    with pytest.raises(ConfigError, match=r"expected a in view of the searched drives, got \d+ ticks whose"):
        run_attack(request, tmp_path / "run", ProgressDisplay())
    assert not attack_file(tmp_path / "run", 0).exists()


def blind(file):
    """Give a policy weights of zero: it ignores what it sees."""
    policy = load_policy(file)
    with torch.no_grad():
        for weights in policy.policy.parameters():
            weights.zero_()
    save_policy(file, policy.policy, policy.view, {})


def test_a_policy_that_ignores_what_it_sees_is_a_result(tmp_path):
    file = tiny_request(tmp_path, evaluations=2)
    blind(tmp_path / "policy.safetensors")
    (found,) = run_attack(loaded(file, ["over.method=[random]"]), tmp_path / "run", ProgressDisplay())
    assert len(set(json.loads(found.with_name("seed_0.json").read_text())["predicted_total_cte_m"])) == 1


@pytest.mark.parametrize("method", ["gradient", "frame"])
def test_a_gradient_that_is_zero_finds_nothing_and_ends_the_search_at_once(tmp_path, method):
    """The search's starting noise was told as the attack that a gradient found, and the policy looked robust."""
    file = tiny_request(tmp_path, evaluations=50)
    blind(tmp_path / "policy.safetensors")
    with pytest.raises(ZeroGradientError, match=r"exactly zero for all \d+ parameters at the first drive"):
        run_attack(loaded(file, [f"over.method=[{method}]"]), tmp_path / "run", ProgressDisplay())
    assert not attack_file(tmp_path / "run", 0).exists()


def test_every_result_stands_beside_the_drive_without_attack(tmp_path, monkeypatch, capsys):
    file = tiny_request(tmp_path, evaluations=2)
    starts = "attack.start_poses=[[0.0, -1.65, 0.5], [0.0, -2.3, -0.4]]"  # they head away from the path
    changes = ["--set", starts]
    assert advnerf(monkeypatch, "attack", "run", file, "-o", tmp_path / "out", *changes) == 0
    printed = capsys.readouterr().out
    attack = load_attack(tmp_path / "out" / "seed_0.attack.safetensors")
    prepared = prepare(loaded(file, [starts]))
    _, totals = evaluate(prepared.problem, prepared.space.surrogate.plain_theta())
    clean = attack.clean_drive
    assert clean.total_cte_m == pytest.approx(totals.protocol_cte_m.tolist(), rel=1e-6)
    assert len(clean.total_cte_m) == 2
    assert not clean.drives
    beside = f"without attack {clean.mean_total_cte_m:.2f} m (NO DRIVE)"
    assert beside in printed
    assert "NO DRIVE: without an attack this policy does not drive here" in printed
    assert json.loads((tmp_path / "out" / "seed_0.json").read_text())["clean_drive"] == clean.to_dict()
    assert advnerf(monkeypatch, "attack", "run", file, "-o", tmp_path / "out", *changes) == 0
    assert beside in capsys.readouterr().out
    assert advnerf(monkeypatch, "attack", "show", tmp_path / "out" / "seed_0.attack.safetensors") == 0
    shown = capsys.readouterr().out
    assert "drive without attack" in shown
    assert "NO DRIVE" in shown
    quick = ("--directions", 2, "--no-memory", *changes)
    assert advnerf(monkeypatch, "attack", "check", file, "-o", tmp_path / "out", *quick) in (0, 1)
    checked = capsys.readouterr().out
    assert f"drive without attack: total CTE {clean.mean_total_cte_m:.2f} m over 3 ticks" in checked
    assert "NO DRIVE" in checked
    assert json.loads((tmp_path / "out" / "check.json").read_text())["clean"] == clean.to_dict()


def test_the_memory_of_a_gradient_is_that_of_one_start_in_another_process(tmp_path):
    ((ticks, mib),) = measured_mib(loaded(tiny_request(tmp_path), ["attack.starts=3"]), [2])
    assert ticks == 2
    assert 0.0 <= mib < 200.0


def test_a_policy_that_drives_gets_no_warning(tmp_path, monkeypatch, capsys):
    file = tiny_request(tmp_path, evaluations=1)  # three ticks on the straight: no network can leave it
    assert advnerf(monkeypatch, "attack", "run", file, "-o", tmp_path / "out") == 0
    printed = capsys.readouterr().out
    assert ", without attack 0." in printed
    assert "NO DRIVE" not in printed
