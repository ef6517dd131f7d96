"""Cells of every space: searched, driven in both domains, kept with their attack file, and not done again."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from advnerf_core.report.cells import cell_from
from advnerf_core.report.clips import ClipTrack, read_clip
from nodes.experiment.pages.report import how_it_was_run
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.sections import RetrainConfig
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    MapsConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
)
from nodes.experiment.run.cells import has_learned_scene, is_predictable, run_cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space, mesh_objects
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps import attack, films, run
from nodes.experiment.steps.attack import surrogate_part
from nodes.experiment.steps.deploy import DRIVES, cell_data
from nodes.experiment.steps.keys import NoSuchCellError, settings_hash
from nodes.experiment.steps.pose_maps import draw_maps
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.support.glb import mesh_from_glb

PLACES = Cell("right", "hardened", "random", 0)
ONE = PlacesConfig(kind="places", samples=1, steps=1)
MESHES = [
    MeshTextureConfig(kind="mesh_texture", texels=8, ball_m=0.5),
    MeshShapeConfig(kind="mesh_shape", texels=8, ball_m=0.5, bound_m=0.3, samples=1),
]


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


def searching(trained: Experiment, space: Any, **changes: Any) -> Experiment:
    """The experiment with a space, and drives short enough for a test."""
    config = trained.config.model_copy(update={"horizon": 2, "space": space, **changes})
    return replace(trained, config=config)


@pytest.fixture
def mitsuba() -> None:
    """Skips where shapes cannot be rendered."""
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


def whole(experiment: Experiment, scene: Any, cell: Cell, folder: Path) -> dict[str, Any]:
    """A cell but for its film, in a scene of the test's; its drives without attack are in ``folder / "clean"``."""
    space, clean = make_space(experiment, scene), folder / "clean"
    surrogate_part(experiment, space, cell.clean, clean, silent)
    at = clean if cell.method == "none" else folder
    surrogate_part(experiment, space, cell, at, silent)
    return cell_data(experiment, space, scene, cell, at, clean, print)


@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize("space", MESHES, ids=lambda space: space.kind)
def test_meshes_are_searched_over_the_pictures_of_the_world(
    space: Any, trained: Experiment, wall: Any, tmp_path: Path
) -> None:
    experiment, cell = searching(trained, space), Cell("straight", "hardened", "gradient", 0)
    data = whole(experiment, wall, cell, tmp_path)
    result = cell_from(
        {**data, "settings_hash": "h", "machine": "m", "date": "d", "seconds": 1.0}, "the cell"
    )
    assert data["extra"]["evaluations"] == experiment.config.attack.evaluations
    assert result.deployed is not None
    assert all(np.isfinite(drives.total_cte_m).all() for drives in (result.surrogate, result.deployed))
    file = load_attack(tmp_path / attack.ATTACK)
    assert (file.space, file.attack_id) == (space.kind, data["attack_id"])
    plain = mesh_objects(experiment, space)
    for found, before in zip(file.objects, plain, strict=True):
        again = mesh_from_glb(found.glb)
        moved = np.abs(np.sort(again.vertices, axis=0) - np.sort(before.mesh.vertices, axis=0)).max()
        assert (moved < 1e-6) == (space.kind == "mesh_texture")
    # What the file holds is what was driven past.
    restored = make_space(experiment, wall).restored(file)
    there = attack.past(
        attack.attack_problem(
            experiment,
            make_space(experiment, wall),
            load_victim(experiment, "hardened"),
            "straight",
            0,
        ),
        make_space(experiment, wall),
        restored,
    )
    there = attack.from_measured_starts(experiment, "straight", there)
    _, _, scores = attack.learned_drives(experiment, there, restored.colours)
    assert [score.total_cte_m for score in scores] == list(result.surrogate.total_cte_m)
    assert not (tmp_path / "state.safetensors").exists()


@pytest.mark.usefixtures("mitsuba")
def test_without_an_attack_meshes_are_their_own_base(trained: Experiment, wall: Any, tmp_path: Path) -> None:
    experiment = searching(trained, MeshTextureConfig(kind="mesh_texture", texels=8))
    data = whole(experiment, wall, Cell("right", "naive", "none", 0), tmp_path)
    assert data["attack_id"] is None
    for domain in ("surrogate", "deployed"):
        assert data[domain]["total_cte_m"] == data[domain]["none_total_cte_m"]


@pytest.mark.parametrize("method", ["random", "gradient"])
def test_places_are_searched_and_the_file_says_where_things_stand(
    trained: Experiment, wall: Any, tmp_path: Path, method: str
) -> None:
    experiment, cell = searching(trained, ONE, horizon=4), Cell("right", "hardened", method, 0)
    data = whole(experiment, wall, cell, tmp_path)
    assert data["extra"]["evaluations"] == 1
    file = load_attack(tmp_path / attack.ATTACK)
    assert file.space == "places"
    hand = np.array([[thing.x_m, thing.y_m] for thing in experiment.objects])
    there = np.array([each.placement[:2] for each in file.objects])
    assert 0.0 < np.abs(there - hand).max() <= ONE.move_m + 1e-9
    # The surrogate's own prediction is what is driven again, from where it was searched.
    space = make_space(experiment, wall)
    problem = attack.attack_problem(experiment, space, load_victim(experiment, "hardened"), "right", 0)
    restored = space.restored(file)
    _, _, scores = attack.learned_drives(experiment, attack.past(problem, space, restored), restored.colours)
    assert np.mean([score.total_cte_m for score in scores]) == pytest.approx(
        file.predicted_total_cte_m,
        rel=1e-5,  # before it was rounded to half precision
    )
    plain = json.loads((tmp_path / "clean" / DRIVES).read_text())
    assert plain["total_cte_m"] == data["deployed"]["none_total_cte_m"]


def test_places_alone_keep_the_plain_colours_and_are_filmed(
    trained: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulated junction itself."""
    shown = []  # what is filmed, before the codec: x264 gives the same pictures other bytes in one run of ten

    def write_clip(file: Path, tracks: list[ClipTrack], *rest: Any) -> Path:
        shown.extend(tracks)
        return films_write_clip(file, tracks, *rest)

    films_write_clip = films.write_clip
    monkeypatch.setattr(films, "write_clip", write_clip)
    folder = shutil.copytree(trained.folder, tmp_path / "run")
    alone = PlacesConfig(kind="places", samples=1, steps=1, colours=False)
    experiment = replace(searching(trained, alone), folder=folder)
    cell = run_cell(experiment, PLACES, tmp_path / "moved", silent)
    plain = run_cell(experiment, Cell("right", "hardened", "none", 0), tmp_path / "plain", silent)
    assert plain["deployed"]["total_cte_m"] == cell["deployed"]["none_total_cte_m"]
    plain_film, film = (read_clip(tmp_path / each["extra"]["clip"]) for each in (plain, cell))
    assert len(plain_film) == len(film) == experiment.config.horizon + 1
    # A cell that was finished without a film is filmed when it is asked for again, and not searched.
    (tmp_path / "moved" / "clip.mp4").unlink()
    assert run_cell(experiment, PLACES, tmp_path / "moved", silent) == cell
    moved, plain_drive, again = shown
    np.testing.assert_array_equal(moved.frames, again.frames)  # the same drive
    assert not np.array_equal(moved.frames, plain_drive.frames)
    own, file = (load_attack(tmp_path / "moved" / attack.ATTACK) for _ in range(2))
    voxels = make_space(experiment, None)
    assert torch.equal(voxels.restored(own).colours, voxels.plain.colours)
    coloured = searching(experiment, ONE)
    run_cell(coloured, PLACES, tmp_path / "other", silent)
    other = load_attack(tmp_path / "other" / attack.ATTACK)
    assert [each.placement for each in other.objects] == [
        each.placement for each in file.objects
    ]  # the same draws
    assert not np.array_equal(other.objects[0].theta, own.objects[0].theta)


def test_a_cell_depends_on_its_space_and_on_its_victim(trained: Experiment) -> None:
    experiment = searching(trained, ONE)
    same = settings_hash(experiment, PLACES)
    assert settings_hash(searching(trained, ONE), PLACES) == same
    others = [
        settings_hash(searching(trained, ONE.model_copy(update={"move_m": 0.2})), PLACES),
        settings_hash(searching(trained, ONE.model_copy(update={"colours": False})), PLACES),
        settings_hash(experiment, Cell("right", "naive", "random", 0)),
        settings_hash(experiment, Cell("right", "hardened", "random", 1)),
        settings_hash(searching(trained, MESHES[0]), PLACES),
        settings_hash(searching(trained, ColoursConfig(kind="colours")), PLACES),
    ]
    assert len({same, *others}) == 7
    for wrong in (
        ("up", "hardened", "random", 0),
        ("right", "retrained", "random", 0),
        ("right", "hardened", "luck", 0),
    ):
        with pytest.raises(NoSuchCellError, match="expected a"):
            settings_hash(experiment, Cell(*wrong))


def test_a_cell_of_colours_depends_on_the_world_and_not_on_what_else_is_searched(trained: Experiment) -> None:

    def digest(*changes: str, victim: str = "hardened") -> str:
        experiment = load_experiment(trained.file, "tiny", list(changes), trained.folder)
        return settings_hash(experiment, Cell("right", victim, "random", 0))

    same = digest()
    for free in (
        "name=mine",
        "over.method=[none,random]",
        "over.seed=[0,1,2]",
        "attack.cache_mib=64",
        "retrain={}",
    ):
        assert digest(free) == same
    needed = ("world.car.turn_rate_lag_s=0.2", "attack.evaluations=9", "held_cap_m=5", "policy.seed=1")
    assert len({same, digest(victim="naive"), *(digest(change) for change in needed)}) == 6
    with pytest.raises(NoSuchCellError, match="expected a victim of hardened, got 'naive'"):
        digest("policy.naive_steps=0", victim="naive")


def test_the_gate_judges_learned_scenes_and_predictions_need_objects_where_they_were_placed(
    trained: Experiment,
) -> None:
    judged = {
        space.kind: has_learned_scene(searching(trained, space))
        for space in (ColoursConfig(kind="colours"), ONE, *MESHES)
    }
    assert judged == {"colours": True, "places": True, "mesh_texture": False, "mesh_shape": False}
    predicted = {
        space.kind: is_predictable(searching(trained, space))
        for space in (ColoursConfig(kind="colours"), ONE, *MESHES)
    }
    assert predicted == {"colours": True, "places": False, "mesh_texture": False, "mesh_shape": False}


def test_a_defence_that_nothing_asks_for_is_told(
    trained: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = trained.config.model_copy(update={"retrain": RetrainConfig(pays_m=9.0)})
    monkeypatch.setattr(run, "make_ready", lambda *arguments, **options: {})  # ends as no attack pays
    with pytest.raises(
        ConfigError, match=r"no attack costs more than retrain.pays_m = 9 m per tick .*nothing was retrained"
    ):
        run.prepare_victims(replace(trained, config=config))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["space.kind=places", "space.moves_m=1"], "unknown key"),
        (["space.kind=places", "space.samples=many"], "input should be a valid integer"),
        (["space.kind=colour"], "'colours', 'places', 'mesh_texture', 'mesh_shape'"),
        (["space.kind=mesh_shape", "space.bound_m=0"], "greater than 0"),
        (["space.kind=places", "space.samples=0"], "greater than or equal to 1"),
        (["space.kind=places", "space.move_m=.nan"], "finite number"),
        (["space=0"], "space"),
        (["space.move_m=1"], "space.kind is missing; add it"),
    ],
)
def test_a_wrong_space_is_one_clear_error(
    tiny_file: Callable[..., Path], tmp_path: Path, changes: list[str], says: str
) -> None:
    with pytest.raises(ConfigError) as error:
        load_experiment(tiny_file(), "tiny", changes, tmp_path)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_the_retrained_victim_is_that_of_the_first_round(trained: Experiment, tmp_path: Path) -> None:
    folder = shutil.copytree(trained.folder, tmp_path / "run")
    experiment = replace(searching(trained, ONE, retrain=RetrainConfig()), folder=folder)
    asked = Cell("left", "retrained", "none", 0)
    unknown = settings_hash(experiment, asked)  # it is not trained yet
    (folder / "retrain" / "round0").mkdir(parents=True)
    shutil.copy(folder / "policy" / "naive.safetensors", folder / "retrain" / "round0" / "policy.safetensors")
    assert settings_hash(experiment, asked) != unknown
    cell = run_cell(experiment, asked, tmp_path / "retrained", silent)
    naive = run_cell(experiment, Cell("left", "naive", "none", 0), tmp_path / "naive", silent)
    assert json.dumps(naive["deployed"]) == json.dumps(cell["deployed"])  # the very same weights


def test_maps_are_of_what_the_cell_found(trained: Experiment, tmp_path: Path) -> None:
    moves = {"sideways_m": [0.0, 0.3], "object_moves_m": [[0.0, 0.0], [0.0, 0.2]]}
    small = MapsConfig.model_validate({"landscape": {"points": [2, 2]}, "robustness": moves})
    experiment = searching(trained, ONE, maps=small)
    assert settings_hash(experiment, PLACES) == settings_hash(searching(trained, ONE), PLACES)
    run_cell(experiment, PLACES, tmp_path, silent)
    asked = (experiment, PLACES)
    pictures = draw_maps(*asked, 1, tmp_path, silent)
    assert [cv2.imread(str(picture)) is not None for picture in pictures] == [True, True]
    rows = json.loads((tmp_path / f"robustness_{trained.objects[1].name}.json").read_text())["cells"]
    # The first start past objects that nobody has moved is the drive that was searched.
    assert rows["0"][0][0] == pytest.approx(
        load_attack(tmp_path / attack.ATTACK).predicted_total_cte_m, rel=1e-5
    )
    assert len(rows) == 2
    kept = pictures[0].with_suffix(".json").stat().st_mtime_ns
    draw_maps(*asked, 1, tmp_path, silent)
    assert pictures[0].with_suffix(".json").stat().st_mtime_ns == kept
    with pytest.raises(NoSuchCellError, match="expected an object of 0 to 4, got 5"):
        draw_maps(*asked, 5, tmp_path, silent)
    assert draw_maps(experiment, PLACES.clean, 1, tmp_path, silent) == []


@pytest.mark.parametrize(
    ("space", "searched"),
    [
        (ColoursConfig(kind="colours"), "The colours of "),
        (ONE, "The places of "),
        (MESHES[0], "The textures of "),
        (MESHES[1], "The shapes of "),
    ],
)
def test_the_page_says_what_was_searched(trained: Experiment, space: Any, searched: str) -> None:
    experiment = searching(trained, space)
    text = how_it_was_run(experiment)
    assert searched in text
    kinds = {thing.kind for thing in experiment.objects}
    assert kinds
    assert all(kind.replace("_", " ") in text for kind in kinds)
