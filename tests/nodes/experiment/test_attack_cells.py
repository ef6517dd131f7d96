"""Searches on five objects at once, their files, the cells of the transfer table and its figures."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.robustness import Disturbances
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.driving.rollout import drive
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.report.result_page import text_table
from advnerf_core.scene.surrogate import Surrogate
from hardware.cameras.effects import CameraEffects
from nodes.experiment.pages import report
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.sections import RobustnessConfig
from nodes.experiment.plan.victims import NAIVE
from nodes.experiment.run.cells import run_cell, search_cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_spec
from nodes.experiment.show.learned_scene import load_field
from nodes.experiment.show.spaces import colour_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps import attack, frozen, run
from nodes.experiment.steps.attack import load_shown, surrogate_part
from nodes.experiment.steps.deploy import DRIVES, cell_data
from nodes.experiment.steps.films import film_cell
from nodes.experiment.steps.keys import (
    NoSuchCellError,
    cell_settings,
    clean_folder,
    search_key,
    settings_hash,
    take_search,
)
from nodes.runtime.errors import ConfigError
from tests.support.strangers import spiral_code, spiral_theta, write_spiral

PLACE = ("right", "hardened")
GRADIENT = Cell("right", "hardened", "gradient", 0)


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


@pytest.fixture
def fresh(trained: Experiment, tmp_path: Path) -> Experiment:
    """The same experiment, its own attack and deploy folders."""
    folder = tmp_path / "run"
    shutil.copytree(trained.folder, folder)
    return replace(trained, folder=folder)


def finished(experiment: Experiment, scene: Any, cell: Cell) -> dict[str, Any]:
    """A cell in the experiment's own folder, but for its film, in a scene of the test's."""
    folder, space = experiment.cell_folder(cell), colour_space(experiment)
    clean = clean_folder(experiment, cell, folder)
    surrogate_part(experiment, space, cell.clean, clean, silent)
    at = clean if cell.method == "none" else folder
    surrogate_part(experiment, space, cell, at, silent)
    data = cell_data(experiment, space, scene, cell, at, clean, print)
    kept = {**data, "settings_hash": "h", "machine": "m", "date": "d", "seconds": 1.0}
    experiment.cell_result(cell).write_text(json.dumps(kept))
    return data


def test_cells_are_all_methods_of_all_drives(trained: Experiment) -> None:
    names = [cell.name for cell in trained.cells]
    assert len(set(names)) == len(names) == 2 * 3 * 4  # victims, drives, none and three methods
    assert names[:3] == ["straight_hardened_none_0", "right_hardened_none_0", "left_hardened_none_0"]
    more = changed(trained, "over", seed=(0, 1, 2))
    assert sum(cell.victim == NAIVE for cell in more.cells) == 3 * 4
    assert (
        len(more.cells) == (3 * 3 + 1) * 3 + 3 * 4
    )  # none once, as all seeds are measured from the same starts


@pytest.mark.parametrize("method", ["gradient", "random", "cem"])
def test_search_is_kept_and_its_file_brings_the_colours_back(fresh: Experiment, method: str) -> None:
    cell = replace(GRADIENT, method=method)
    folder = fresh.cell_folder(cell)
    space = colour_space(fresh)
    found = surrogate_part(fresh, space, cell, folder, silent)
    assert len(found["curve_total_cte_m"]) == 2
    file = load_attack(folder / attack.ATTACK)
    theta = space.restored(file).colours
    problem = attack.attack_problem(fresh, space, load_victim(fresh, cell.victim), cell.scenario, cell.seed)
    again = attack.past(problem, space, space.restored(file))
    _, _, scores = attack.learned_drives(fresh, again, theta)
    assert scores[0].total_cte_m == pytest.approx(
        max(found["curve_total_cte_m"])
    )  # the best evaluation, driven again
    # It is measured from a start that it was not searched from.
    assert found["states"][0][0] == pytest.approx(fresh.measured_starts(cell.scenario)[0].tolist())
    assert found["states"][0][0] != problem.start_states[0].tolist()
    # Drives whose attack is gone are no search.
    (folder / attack.ATTACK).unlink()
    assert surrogate_part(fresh, space, cell, folder, silent)["attack_id"] == found["attack_id"]
    assert load_attack(folder / attack.ATTACK).attack_id == file.attack_id
    assert theta.shape == space.sensor.theta_shape
    assert [thing.name for thing in file.objects] == [thing.name for thing in fresh.objects]
    assert file.attack_id == found["attack_id"]
    moved = (theta - space.plain.colours).abs().max()
    assert moved > (1e-5 if method == "gradient" else 1.0)
    assert not (folder / "state.safetensors").exists()
    # What is there is not searched again.
    marked = {**found, "seconds": -1.0}
    (folder / attack.SEARCHED).write_text(json.dumps(marked))
    assert surrogate_part(fresh, space, cell, folder, silent) == marked


def test_a_method_of_a_file_runs_a_cell_and_appears_in_the_tables(
    fresh: Experiment, wall: Any, tmp_path: Path
) -> None:
    spiral_file, file = write_spiral(tmp_path), Path(shutil.copy(fresh.file, tmp_path))
    changes = ["over.method=[none,spiral.py:Spiral, gradient]", "paths=[right]", "policy.naive_steps=0"]
    experiment = run.load_experiment(file, "tiny", changes, fresh.folder)
    names = [f"right_hardened_{method}_0" for method in ("none", "Spiral", "gradient")]
    assert [cell.name for cell in experiment.cells] == names
    space = colour_space(experiment)
    for cell in experiment.cells:
        finished(experiment, wall, cell)
    spiral = experiment.cells[1]
    out = experiment.cell_folder(spiral)
    shown = load_shown(space, out, spiral)
    found = shown.colours
    thetas = [spiral_theta(tuple(space.sensor.theta_shape), number) for number in range(2)]
    assert any(np.array_equal(found, in_half_precision(theta)) for theta in thetas)
    assert load_attack(out / attack.ATTACK).method == "Spiral"
    assert film_cell(experiment, wall, space, spiral, out, out).exists()
    table = text_table(report.table_of(experiment))
    assert [row[2] for row in table.rows if row[2]] == ["plain object", "gradient", "Spiral"]
    assert "Spiral" in report.how_it_was_run(experiment)

    # What its code is decides, not where it lies.
    def digest() -> str:
        return settings_hash(experiment, Cell.of(*PLACE, f"{spiral_file}:Spiral", 0))

    before = digest()
    spiral_file.write_text(spiral_code() + "# changed\n")
    assert digest() != before


def test_a_stopped_search_goes_on_and_refuses_another_victim(fresh: Experiment) -> None:
    folder, space = fresh.folder / "whole", colour_space(fresh)
    whole = surrogate_part(fresh, space, GRADIENT, folder, silent)

    def stop(fraction: float, text: str = "") -> None:
        raise KeyboardInterrupt

    other = fresh.folder / "again"
    with pytest.raises(KeyboardInterrupt):
        surrogate_part(fresh, space, GRADIENT, other, stop)
    stopped = (other / "state.safetensors").read_bytes()
    assert surrogate_part(fresh, space, GRADIENT, other, silent)["states"] == whole["states"]
    naive = fresh.folder / "naive"
    naive.mkdir()
    (naive / "state.safetensors").write_bytes(stopped)
    with pytest.raises(SearchStateError, match="other settings"):
        surrogate_part(fresh, space, replace(GRADIENT, victim=NAIVE), naive, silent)


def test_cell_has_both_domains_over_their_own_clean_drive(fresh: Experiment, wall: Any) -> None:
    cell, folder = finished(fresh, wall, GRADIENT), fresh.cell_folder(GRADIENT)
    clean = clean_folder(fresh, GRADIENT, folder)
    learned = {at: json.loads((at / attack.SEARCHED).read_text()) for at in (folder, clean)}
    assert cell["surrogate"]["total_cte_m"] == learned[folder]["total_cte_m"]
    assert cell["surrogate"]["none_total_cte_m"] == learned[clean]["total_cte_m"]
    driven = np.array(json.loads((folder / DRIVES).read_text())["states"][0])
    cte_m = fresh.paths["right"].project(driven[1:, :2]).cte_m
    assert cell["deployed"]["total_cte_m"] == pytest.approx([np.abs(cte_m).sum()])
    assert (clean / DRIVES).exists()
    assert cell["extra"]["blocked_tick"] == [None]
    assert cell["deployed"]["none_total_cte_m"] == json.loads((clean / DRIVES).read_text())["total_cte_m"]
    # A control that was driven elsewhere is not driven here.
    (clean / DRIVES).unlink()
    arguments = (fresh, colour_space(fresh), wall, GRADIENT, folder, clean, print, (0.25,))
    assert cell_data(*arguments)["deployed"] == {**cell["deployed"], "none_total_cte_m": [0.25]}
    assert not (clean / DRIVES).exists()
    assert finished(fresh, wall, GRADIENT) == cell
    # Once there, it is not driven again: here it would end where it starts.
    blocking = replace(wall, blocked_beyond_m=-1e3)
    assert finished(fresh, blocking, GRADIENT) == cell
    (folder / DRIVES).unlink()
    held = finished(fresh, blocking, GRADIENT)
    assert held["extra"]["blocked_tick"] == [1]


def test_without_objects_the_car_drives_as_in_the_bare_scene(fresh: Experiment, wall: Any) -> None:
    control, clean = replace(GRADIENT, method="empty"), GRADIENT.clean
    found, plain = (finished(fresh, wall, cell) for cell in (control, clean))
    assert (found["attack_id"], found["surrogate"]["none_total_cte_m"]) == (
        None,
        plain["surrogate"]["total_cte_m"],
    )
    # The bare scene and policy, put together by hand.
    bare = Surrogate(load_field(fresh), fresh.view.pinhole, fresh.mount)
    policy = load_victim(fresh, control.victim).policy
    starts = fresh.measured_starts(control.scenario)
    goals = torch.tensor([fresh.goal(control.scenario)], dtype=torch.float32).expand(len(starts), -1)
    driven = drive(policy, bare.observe(None), fresh.dynamics, starts, fresh.config.horizon, goals)
    kept = json.loads((fresh.cell_folder(control) / attack.SEARCHED).read_text())["states"]
    assert np.array(kept) == pytest.approx(driven.states.transpose(0, 1).numpy())
    # Deployed, the first command is that of the world's own picture.
    wall.reset(*map(float, starts[0]))
    image = images_to_tensor(fresh.view.image(wall.observe()[0]))
    first = json.loads((fresh.cell_folder(control) / DRIVES).read_text())["commands"][0][0]
    with torch.no_grad():
        assert first == pytest.approx(float(policy(image, goals[:1])[0]), abs=1e-6)
    assert found["kept"]["deployed"][0] != plain["kept"]["deployed"][0]


def in_half_precision(theta: torch.Tensor) -> Any:
    """What is driven past of a theta that was found, by NumPy."""
    return theta.numpy().astype(np.float16).astype(np.float32)


def test_a_search_bears_what_it_is_asked_to_and_is_measured_undisturbed(fresh: Experiment) -> None:
    asked = {"noise": 0.2, "gain": 0.5, "draws": 2}
    bearing = changed(fresh, "attack", robustness=RobustnessConfig(**asked))
    space = colour_space(bearing)
    found = surrogate_part(bearing, space, GRADIENT, bearing.cell_folder(GRADIENT), silent)
    victim = load_victim(bearing, GRADIENT.victim)
    problem = attack.attack_problem(bearing, space, victim, "right", 0)
    starts = bearing.start_states("right", 0)
    assert torch.equal(problem.start_states, starts.repeat_interleave(2, dim=0))
    # The same search by hand.
    disturbed = replace(problem, disturbances=Disturbances(noise=0.2, gain=0.5, seed=0))
    budget = bearing.config.attack.evaluations
    by_hand = gradient_attack(disturbed, budget, bearing.config.attack.learning_rate, run=SearchRun(0))
    colours = space.restored(load_attack(bearing.cell_folder(GRADIENT) / attack.ATTACK)).colours
    assert np.array_equal(colours, in_half_precision(by_hand.theta))
    # Measured is a drive in which nothing is drawn.
    plain = attack.attack_problem(fresh, space, victim, "right", 0)
    shown = space.restored(load_attack(bearing.cell_folder(GRADIENT) / attack.ATTACK))
    measured = attack.from_measured_starts(fresh, "right", attack.past_field(fresh, plain, space, shown))
    assert np.array_equal(found["states"], attack.learned_drives(fresh, measured, shown.colours)[0])
    # What no search belongs to does not depend on it, and a setting that changes nothing is not there.
    assert cell_settings(bearing, GRADIENT.clean) == cell_settings(fresh, GRADIENT.clean)
    assert cell_settings(bearing, GRADIENT) != cell_settings(fresh, GRADIENT)
    assert "robustness" not in cell_settings(fresh, GRADIENT).keyed["attack"]
    assert cell_settings(fresh, GRADIENT).resolved["attack"]["robustness"]["draws"] == 1
    junction = Path(__file__).parents[3] / "launch" / "junction.experiment.yaml"
    wrong = ["attack.robustness.smoothness=1", "space={kind: places}"]
    with pytest.raises(ConfigError, match="smoothness only where colours are searched"):
        run.load_experiment(junction, "demo", wrong, fresh.folder / "x")


def test_drives_are_measured_in_the_field_or_as_searches_see_it(fresh: Experiment) -> None:
    baked = changed(fresh, "measure", scene="baked")
    space, control = colour_space(fresh), replace(GRADIENT, method="none")
    problem = attack.attack_problem(fresh, space, load_victim(fresh, control.victim), "right", 0)
    searched = attack.past(problem, space, space.plain).sensor.background
    assert attack.past_field(baked, problem, space, space.plain).sensor.background is searched
    assert attack.past_field(fresh, problem, space, space.plain).sensor.background is not searched
    assert cell_settings(baked, control) != cell_settings(fresh, control)


def test_cells_that_differ_in_their_deployment_alone_share_one_search(fresh: Experiment) -> None:
    folder = fresh.folder / "together"
    first = search_cell(fresh, GRADIENT, folder / "ideal", silent)
    noisy = changed(fresh, "deploy", camera=CameraEffects(read_noise=0.01))
    drawn = []
    clean = search_cell(noisy, GRADIENT, folder / "noisy", lambda fraction, text="": drawn.append(text))
    assert not any("total CTE" in text for text in drawn)
    assert clean != first
    for name in (attack.ATTACK, attack.SEARCHED):
        assert (folder / "noisy" / name).read_bytes() == (folder / "ideal" / name).read_bytes()
    assert (clean / attack.SEARCHED).read_bytes() == (first / attack.SEARCHED).read_bytes()
    # What is searched otherwise is searched anew, and what has begun its own search goes on with it.
    other = changed(fresh, "attack", learning_rate=0.2)
    assert search_key(other, GRADIENT) != search_key(fresh, GRADIENT) == search_key(noisy, GRADIENT)
    assert search_key(noisy, replace(GRADIENT, seed=1)) != search_key(noisy, GRADIENT)
    assert take_search(other, GRADIENT, folder / "other") is None
    assert take_search(noisy, GRADIENT, folder / "noisy") is None
    # A search that is not finished is not taken.
    (folder / "ideal" / attack.SEARCHED).unlink()
    (folder / "noisy" / attack.SEARCHED).unlink()
    assert take_search(noisy, GRADIENT, folder / "third") is None


def test_an_attack_may_be_deployed_in_another_world_of_the_same_paths(fresh: Experiment) -> None:
    slow = {**fresh.config.world, "car": {**fresh.config.world.get("car", {}), "turn_rate_lag_s": 0.5}}
    there, folder = changed(fresh, "deploy", world=slow), fresh.folder / "together"
    here = run_cell(fresh, GRADIENT, folder / "here", silent)
    found = run_cell(there, GRADIENT, folder / "there", silent)
    assert found["attack_id"] == here["attack_id"]
    assert found["surrogate"] == here["surrogate"]
    assert found["deployed"] != here["deployed"]
    # It counts as what the cell depends on, and the search does not.
    assert settings_hash(there, GRADIENT) != settings_hash(fresh, GRADIENT)
    assert search_key(there, GRADIENT) == search_key(fresh, GRADIENT)
    other = changed(fresh, "deploy", world={**fresh.config.world, "camera": {"horizontal_fov_deg": 60.0}})
    with pytest.raises(
        ConfigError, match=r"deploy\.world: expected a world with the paths.* with other camera"
    ):
        run_cell(other, GRADIENT, folder / "other", silent)


def test_the_driving_camera_may_be_a_real_one(fresh: Experiment, wall: Any) -> None:
    def commands(**effects: Any) -> Any:
        experiment = changed(fresh, "deploy", camera=CameraEffects(**effects))
        for file in experiment.folder.rglob(DRIVES):
            file.unlink()
        finished(experiment, wall, GRADIENT)
        return json.loads((experiment.cell_folder(GRADIENT) / DRIVES).read_text())["commands"][0]

    ideal = commands()
    # A camera that changes next to nothing takes the other way to the same pictures.
    assert commands(gain_sigma=1e-9) == ideal
    assert commands(gain_sigma=0.5) != ideal
    # Of a lost frame the policy sees the one before.
    assert len(set(commands(lost=0.999))) == 1
    assert "deploy" not in cell_settings(fresh, GRADIENT).keyed
    noisy = changed(fresh, "deploy", camera=CameraEffects(read_noise=0.01))
    assert cell_settings(noisy, GRADIENT).keyed["deploy"]["camera"] == {"read_noise": 0.01}


def changed(experiment: Experiment, section: str, **values: Any) -> Experiment:
    """The experiment with other values in one section of its configuration."""
    other = getattr(experiment.config, section).model_copy(update=values)
    return replace(experiment, config=experiment.config.model_copy(update={section: other}))


def test_the_control_without_objects_is_asked_for(trained: Experiment, tmp_path: Path) -> None:
    more = changed(trained, "over", method=("none", "empty", "random", "cem", "gradient"))
    assert {cell.name for cell in more.cells} - {cell.name for cell in trained.cells} == {
        f"{drive}_{victim}_empty_0"
        for drive in ("straight", "right", "left")
        for victim in ("hardened", "naive")
    }
    room = Path(__file__).parents[3] / "launch" / "room.experiment.yaml"
    with pytest.raises(
        ConfigError,
        match=r"no control empty in over\.method \(set deploy\.empty_scene instead\) with carrier\.kind overlay",
    ):
        run.load_experiment(room, "full", ["over.method=[none,empty,gradient]"], tmp_path)


def test_a_cell_is_filmed_frame_by_frame(fresh: Experiment, wall: Any) -> None:
    finished(fresh, wall, GRADIENT)
    folder = fresh.cell_folder(GRADIENT)
    with av.open(str(film_cell(fresh, wall, colour_space(fresh), GRADIENT, folder, folder))) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) >= fresh.config.horizon
    assert frames[0].std() > 5  # something is to be seen


def test_unknown_cells_are_refused(trained: Experiment, tmp_path: Path) -> None:
    for wrong in (("back", "hardened", "none"), ("left", "nobody", "none"), ("left", "hardened", "luck")):
        with pytest.raises(NoSuchCellError, match=r"expected an? (path|victim|attack method) of"):
            run_cell(trained, Cell(*wrong, 0), tmp_path, silent)
    assert not list(tmp_path.iterdir())


def test_another_policy_after_the_attack_is_refused(fresh: Experiment) -> None:
    folder = fresh.cell_folder(GRADIENT)
    frozen.freeze(fresh, GRADIENT, folder)
    frozen.check_frozen(fresh, GRADIENT, folder)
    shutil.copy(Path(victim_spec(fresh, NAIVE)), Path(victim_spec(fresh, "hardened")))
    with pytest.raises(frozen.FrozenChangedError, match="expected policy as frozen"):
        frozen.check_frozen(fresh, GRADIENT, folder)


def test_table_is_over_the_clean_drive_of_the_same_domain(fresh: Experiment) -> None:
    for cell in fresh.cells:
        factor = {"none": 1.0, "random": 1.1, "cem": 1.5, "gradient": 3.0}[cell.method]
        parts = {
            domain: {
                "total_cte_m": [factor * clean],
                "off_track": [factor > 2.0],
                "none_total_cte_m": [clean],
            }
            for domain, clean in (("surrogate", 4.0), ("deployed", 6.0))
        }
        known = {"victim": cell.victim, "scenario": cell.scenario, "method": cell.method, "seed": cell.seed}
        made = {"settings_hash": "h", "machine": "m", "date": "d", "seconds": 1.0, "extra": {"horizon": 10}}
        fresh.cell_result(cell).write_text(json.dumps({**known, **made, **parts}))
    table = report.table_of(fresh)
    assert len(table.rows) == 2 * 3 * 2 * 4
    first = [
        row
        for row in table.rows
        if (row.victim, row.scenario, row.domain) == ("hardened", "straight", "deployed")
    ]
    assert [row.method for row in first] == ["none", "random", "cem", "gradient"]
    # Of no attack its mean |CTE|; of the others the excess over it.
    excess = [row.excess.excess_m for row in first if row.excess is not None]
    assert excess == pytest.approx([0.6, 0.06, 0.3, 1.2])
    assert [row.off_track for row in first] == [0, 0, 0, 1]
    lost = fresh.cell_result(Cell("left", "naive", "cem", 0))
    lost.unlink()
    row = report.table_of(fresh).find("left", "naive", "cem", "deployed")
    assert row is not None
    assert row.missing == (0,)


def test_attack_differs_between_seeds_and_repeats_itself(trained: Experiment) -> None:
    surrogate = colour_space(trained).surrogate
    first, again, other = (surrogate.initial_theta(torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
