"""Attack, retraining and attack again, on the simulated junction itself, in its smallest size."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack
from advnerf_core.learning.frames import Frames, FrameStore
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.sections import RetrainConfig
from nodes.experiment.plan.victims import HARDENED, RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_spec
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps import attack, retrain

SMALL = RetrainConfig(rounds=1, pays_m=-9.0, stills=2, drives=1, drive_steps=2, placements=1, steps=2)


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


def old_frames(experiment: Experiment, count: int = 24) -> Frames:
    images = np.random.default_rng(0).integers(0, 255, (count, 66, 200, 3)).astype(np.uint8)
    goals = np.tile(np.eye(3, dtype=np.float32)[0], (count, 1))
    return Frames(images, np.zeros((count, 3)), np.zeros(count, np.float32), goals, np.zeros(count, bool))


@pytest.fixture
def attacked(trained: Experiment, tmp_path: Path) -> Experiment:
    """A run folder with a little of what the victim was trained on; the loop searches by itself."""
    folder = tmp_path / "run"
    shutil.copytree(trained.folder, folder)
    config = trained.config.model_copy(update={"retrain": SMALL})
    experiment = replace(trained, folder=folder, config=config)
    FrameStore(folder / "policy" / "frames").append("stills", old_frames(experiment))
    return experiment


def test_the_unseen_start_is_a_metre_back_and_to_the_left(trained: Experiment) -> None:
    for scenario, reference in trained.references.items():
        start = retrain.unseen_start(trained, scenario)[0].numpy()
        ahead = np.array([np.cos(start[2]), np.sin(start[2])])
        assert trained.paths[scenario].project(start[:2] + ahead).cte_m == pytest.approx(0.35, abs=1e-9)
        assert start[2] == reference.drive_start[2]


@pytest.mark.slow
def test_a_round_of_retraining_and_the_attack_on_it(attacked: Experiment) -> None:
    folder = attacked.stage_folder("retrain")
    retrain.run(attacked, folder, silent)
    found = json.loads((folder / "retrain.json").read_text())
    assert len(found["rounds"]) == 2  # the original, and the one that was retrained
    assert found["rounds"][0]["victim"] == load_victim(attacked, HARDENED).sha256
    retrained = load_victim(attacked, RETRAINED)
    assert found["rounds"][1]["victim"] == retrained.sha256
    assert found["final_policy"] == "retrain/round0/policy.safetensors"  # in the run folder, wherever that is
    assert retrained.metadata["fine_tuned_from"] == found["rounds"][0]["victim"]
    for name in attacked.config.paths:
        row = found["old_attacks"][name]
        assert row["ratio"] == pytest.approx(row["retrained_attacked_m"] / row["original_undisturbed_m"])
        assert abs(found["rounds"][0]["surrogate"][name]) < 6.0  # a mean per tick
    # what it learned from: both domains, all drives, the colours that were found, and random ones where the objects were moved
    store = FrameStore(folder / "round0" / "frames")
    assert sorted(store.names()) == sorted(
        f"{domain}-{name}{moved}"
        for domain in ("deployed", "surrogate")
        for name in attacked.config.paths
        for moved in ("", "-moved0")
    )
    picture = cv2.imread(str(folder / "curve.png"))
    assert picture is not None
    assert picture.std() > 10.0
    assert sorted(file.parent.name for file in folder.glob("*/excess.json")) == ["round0", "round1"]
    # once more: everything is there, nothing is collected, trained or searched again
    times = {file: file.stat().st_mtime_ns for file in folder.rglob("*.npy")}
    before = load_victim(attacked, RETRAINED).sha256
    retrain.run(attacked, folder, silent)
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*.npy")} == times
    assert load_victim(attacked, RETRAINED).sha256 == before
    # one more round goes on from the one that is there
    twice = SMALL.model_copy(update={"rounds": SMALL.rounds + 1, "pays_m": -9.0})
    more = replace(attacked, config=attacked.config.model_copy(update={"retrain": twice}))
    retrain.run(more, folder, silent)
    grown = json.loads((folder / "retrain.json").read_text())
    assert grown["rounds"][:2] == found["rounds"]
    assert len(grown["rounds"]) == 3
    assert grown["old_attacks"] == found["old_attacks"]
    assert times.items() <= {file: file.stat().st_mtime_ns for file in folder.rglob("*.npy")}.items()


@pytest.mark.slow
def test_an_attack_that_does_not_pay_ends_it(attacked: Experiment) -> None:
    config = attacked.config.model_copy(update={"retrain": SMALL.model_copy(update={"pays_m": 1e6})})
    experiment = replace(attacked, config=config)
    folder = attacked.stage_folder("retrain")
    retrain.run(experiment, folder, silent)
    found = json.loads((folder / "retrain.json").read_text())
    assert len(found["rounds"]) == 1
    assert found["old_attacks"] == {}
    assert not Path(victim_spec(attacked, RETRAINED)).exists()
    seed = attacked.config.seeds[0]
    file = attacked.cell_folder(Cell("left", HARDENED, "gradient", seed)) / attack.ATTACK
    assert load_attack(file).objects
