"""The recorded victim: it comes with the code, it is labelled, and it is driven in the lab where live nodes do not get the time."""

import json

import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import Horizon
from advnerf_core.policies.load import load_driver
from nodes.lab import recorded_drive
from nodes.lab.recorded_victim import (
    FOLDER,
    LABEL,
    MISSING,
    NOW,
    FirstPicture,
    find_recorded,
    recorded_state,
)
from nodes.lab.trials.trial import SpoiledError


def test_a_policy_and_the_texture_that_was_found_for_it_come_with_the_code():
    victim = find_recorded()
    attack = load_attack(victim.attack)
    assert attack.method == "gradient"
    assert attack.required_face().subject == "board"
    assert load_driver(str(victim.policy)).sha256 == attack.policy_sha256
    assert attack.predicted_total_cte_m > 5.0


def test_an_installation_without_one_says_so_in_a_line(tmp_path, monkeypatch):
    said = []
    assert find_recorded(tmp_path) is None
    monkeypatch.setattr("nodes.lab.recorded_victim.find_recorded", lambda: None)
    with FirstPicture(tmp_path, said.append) as drive:
        assert drive._process is None
    assert said == [MISSING]
    assert recorded_state(tmp_path) is None


def test_a_drive_that_does_not_count_live_is_driven_in_the_lab_and_labelled(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded_drive, "_HORIZON", Horizon(6))
    folder, said = tmp_path / FOLDER, []

    def spoiled(victim, into, show):
        show(np.zeros((188, 336, 3), np.uint8))
        first = recorded_state(tmp_path)
        assert (first["label"], first["file"], first["film"]) == (LABEL, f"{FOLDER}/{NOW}", False)
        raise SpoiledError("late")

    monkeypatch.setattr(recorded_drive, "_through_nodes", spoiled)
    folder.mkdir()
    film = recorded_drive.drive_recorded(find_recorded(), folder, said.append)
    assert film.stat().st_size > 1000
    assert all(text.startswith(LABEL) for text in said)
    assert str(film) in said[-1]
    state = recorded_state(tmp_path)
    assert (state["label"], state["file"], state["film"]) == (LABEL, f"{FOLDER}/{film.name}", True)
    assert "In the simulated lab" in state["text"]
    # A second start of the experiment drives nothing again.
    again = []
    with FirstPicture(tmp_path, again.append) as drive:
        assert drive._process is None
    assert again == [f"{LABEL} Film of an earlier start: {film}"]


@pytest.mark.slow
@pytest.mark.live
def test_the_first_picture_and_the_film_come_beside_an_experiment(tmp_path):
    said = []
    with FirstPicture(tmp_path, said.append) as drive:
        assert drive._process.wait(600.0) == 0
    (film,) = (tmp_path / FOLDER).glob("clip.*")
    assert film.stat().st_size > 10_000
    assert (tmp_path / FOLDER / NOW).stat().st_size > 1000
    about = json.loads((tmp_path / FOLDER / "about.json").read_text())
    # The car sees the texture, whoever drives it.
    assert float(about["text"].partition("total CTE ")[2].partition(" m")[0]) > 5.0
