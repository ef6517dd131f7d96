"""Places and meshes as kinds of a campaign's cells: their settings, what they depend on, and which victims there are."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.clips import ClipTrack, read_clip
from nodes.experiment.campaign.kinds import load_kind, settings_hash
from nodes.experiment.junction import films, mesh_cells, pose_cells, run
from nodes.experiment.junction.cells import CellError
from nodes.experiment.junction.config import RetrainConfig
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.mesh_cells import MeshExperiment
from nodes.experiment.junction.policy import victim_file
from nodes.experiment.junction.pose_cells import PoseExperiment
from nodes.experiment.junction.pose_maps import PoseMapSettings, draw_maps
from nodes.experiment.junction.poses import PoseSettings
from nodes.runtime.errors import ConfigError

PLACES = ("right", "hardened", "random", 0)


def silent(fraction: float, text: str = "") -> None:
    """Takes progress."""


def posed(trained: Experiment, **settings: Any) -> PoseExperiment:
    config = trained.config.model_copy(update={"horizon": 2})
    poses = PoseSettings(samples=1, steps=1, **settings)
    return PoseExperiment(config, trained.file, trained.folder, trained.setting, poses)


def test_settings_of_cells_are_told_apart_from_those_of_the_experiment(
    tiny_file: Callable[..., Path], tmp_path: Path
) -> None:
    changes = ["poses.move_m=0.5", "horizon=4", "poses.colours=false"]
    found = pose_cells.load_experiment(tiny_file(), "tiny", changes, tmp_path)
    assert found.poses == PoseSettings(move_m=0.5, colours=False)
    assert found.config.horizon == 4
    meshes = mesh_cells.load_experiment(
        tiny_file(), "tiny", ["meshes.target=shape", "meshes.limits.bound_m=0.7", "meshes.ball_m=0.6"], tmp_path
    )
    assert (meshes.meshes.target, meshes.meshes.limits.bound_m, meshes.meshes.ball_m) == ("shape", 0.7, 0.6)
    assert mesh_cells.load_experiment(tiny_file(), "tiny", [], tmp_path).meshes.limits.bound_m == 0.4
    smoother = mesh_cells.load_experiment(tiny_file(), "tiny", ["meshes.limits.smoothness=10"], tmp_path).meshes
    assert (smoother.limits.smoothness, smoother.limits.bound_m) == (10.0, 0.4)  # the rest stays as it was


def test_places_and_meshes_are_not_attacked_on_a_carla_server(tmp_path: Path) -> None:
    file = Path(__file__).parents[3] / "launch" / "carla.experiment.yaml"
    for module in (pose_cells, mesh_cells):
        with pytest.raises(ConfigError, match="steps one world at a time"):
            module.load_experiment(file, "full", [], tmp_path)


def test_a_defence_that_nothing_asks_for_is_told(trained: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    config = trained.config.model_copy(update={"retrain": RetrainConfig(pays_ratio=9.0)})
    monkeypatch.setattr(run, "run_experiment", lambda *arguments, **options: {})  # ends as no attack pays
    with pytest.raises(ConfigError, match=r"no attack reaches retrain.pays_ratio = 9 .*nothing was retrained"):
        run.prepare_victims(replace(trained, config=config), silent)


@pytest.mark.parametrize(
    ("module", "change", "says"),
    [
        (
            pose_cells,
            "poses.moves_m=1",
            "unknown key poses.moves_m; valid keys here: poses.move_m, poses.turn_rad",
        ),
        (pose_cells, "poses.samples=many", "--set poses.samples=many: poses.samples: input should be a valid integer"),
        (mesh_cells, "meshes.target=colour", "meshes.target: input should be 'texture' or 'shape'"),
        (mesh_cells, "meshes.limits.bound_m=0", "expected a bound above zero"),
        (
            mesh_cells,
            "meshes.limits.bound=1",
            "unknown key meshes.limits.bound; valid keys here: meshes.limits.bound_m",
        ),
        (pose_cells, "poses.samples=0", "at least one sample and step"),
        (pose_cells, "poses.move_m=.nan", "moves and turns of at least zero"),
        (pose_cells, "poses=0", "expected keys below poses, got 0"),
        (pose_cells, "poses .move_m=1", "unknown key poses"),
        (mesh_cells, "meshes.ball_m=0", "a radius and a rate above zero"),
        (mesh_cells, "meshes=shape", "expected keys below meshes, got 'shape'"),
        (mesh_cells, "poses.move_m=1", "unknown key poses"),
    ],
)
def test_a_wrong_setting_is_one_clear_error(
    tiny_file: Callable[..., Path], tmp_path: Path, module: Any, change: str, says: str
) -> None:
    with pytest.raises(ConfigError) as error:
        module.load_experiment(tiny_file(), "tiny", [change], tmp_path)
    assert says in str(error.value)


def test_a_cell_depends_on_what_is_searched_and_on_its_victim(trained: Experiment, tmp_path: Path) -> None:
    kind, experiment = load_kind("intersection_poses"), posed(trained)
    same = settings_hash(kind, experiment, *PLACES)
    assert settings_hash(kind, posed(trained), *PLACES) == same
    others = [
        settings_hash(kind, posed(trained, move_m=0.2), *PLACES),
        settings_hash(kind, posed(trained, colours=False), *PLACES),
        settings_hash(kind, experiment, "right", "naive", "random", 0),
        settings_hash(kind, experiment, "right", "hardened", "random", 1),
        settings_hash(load_kind("intersection_meshes"), meshed(trained), "right", "hardened", "random", 0),
    ]
    assert len({same, *others}) == 6
    less = trained.config.model_copy(update={"attack": trained.config.attack.model_copy(update={"cache_mib": 64.0})})
    for cells in (posed, meshed):
        asked = (kind if cells is posed else load_kind("intersection_meshes"), cells(trained), *PLACES)
        assert settings_hash(asked[0], cells(replace(trained, config=less)), *PLACES) == settings_hash(*asked)
    for wrong in (
        ("up", "hardened", "random", 0),
        ("right", "retrained", "random", 0),
        ("right", "hardened", "cem", 0),
    ):
        with pytest.raises(CellError, match="expected a"):
            settings_hash(kind, experiment, *wrong)


def test_a_cell_of_colours_depends_on_the_world_and_not_on_what_else_is_searched(
    trained: Experiment, tmp_path: Path
) -> None:
    kind = load_kind("intersection")

    def digest(*changes: str, victim: str = "hardened") -> str:
        experiment = kind.load(trained.file, "tiny", list(changes), trained.folder)
        return settings_hash(kind, experiment, "right", victim, "random", 0)

    same = digest()
    for free in ("name=mine", "attack.methods=[random]", "attack.seeds=[0,1,2]", "attack.cache_mib=64", "retrain={}"):
        assert digest(free) == same
    needed = ("world.car.turn_rate_lag_s=0.2", "attack.evaluations=9", "held_cap_m=5", "policy.seed=1")
    assert len({same, digest(victim="naive"), *(digest(change) for change in needed)}) == 6
    with pytest.raises(CellError, match="expected a victim of hardened, got 'naive'"):
        digest("policy.naive_steps=0", victim="naive")


def meshed(trained: Experiment) -> MeshExperiment:
    return MeshExperiment(trained.config, trained.file, trained.folder, trained.setting)


def test_a_cell_of_places_alone_keeps_the_plain_colours(
    trained: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulated junction itself; the colour cell of the same name in the run folder is not taken for it."""
    shown = []  # what is filmed, before the codec: x264 gives the same pictures other bytes in one run of ten

    def write_clip(file: Path, tracks: list[ClipTrack], *rest: Any) -> Path:
        shown.extend(tracks)
        return films_write_clip(file, tracks, *rest)

    films_write_clip = films.write_clip
    monkeypatch.setattr(films, "write_clip", write_clip)
    folder = shutil.copytree(trained.folder, tmp_path / "run")
    experiment = replace(posed(trained, colours=False), folder=folder)
    (folder / "deploy" / "right_hardened_random_0.cell.json").write_text("{}")
    kind = load_kind("intersection_poses")
    assert kind.finished(experiment, *PLACES) is None
    cell = kind.run_cell(experiment, *PLACES, tmp_path / "moved", silent)
    plain = pose_cells.run_cell(experiment, "right", "hardened", "none", 0, tmp_path / "plain", silent)
    assert plain["deployed"]["total_cte_m"] == cell["deployed"]["none_total_cte_m"]
    plain_film, film = (read_clip(tmp_path / each["extra"]["clip"]) for each in (plain, cell))
    assert len(plain_film) == len(film) == experiment.config.horizon + 1
    assert not np.array_equal(plain_film[0], film[0])
    # A cell that was finished without a film is filmed when it is asked for again, and not searched.
    (tmp_path / "moved" / "clip.mp4").unlink()
    assert kind.run_cell(experiment, *PLACES, tmp_path / "moved", silent) == cell
    moved, plain_drive, again = shown
    np.testing.assert_array_equal(moved.frames, again.frames)  # the same drive
    np.testing.assert_array_equal(moved.cte_m, again.cte_m)
    assert not np.array_equal(moved.frames, plain_drive.frames)
    assert read_clip(tmp_path / "moved" / "clip.mp4").shape == film.shape
    coloured = pose_cells.run_cell(replace(experiment, poses=posed(trained).poses), *PLACES, tmp_path / "other", silent)
    assert coloured["extra"]["placements"] == cell["extra"]["placements"]  # the same places are drawn
    assert coloured["extra"]["colours"] != cell["extra"]["colours"]
    assert kind.predicts is False
    assert kind.fidelity is not None
    assert load_kind("intersection_meshes").fidelity is None


def test_the_retrained_victim_is_that_of_the_first_round(trained: Experiment, tmp_path: Path) -> None:
    folder = shutil.copytree(trained.folder, tmp_path / "run")
    config = trained.config.model_copy(update={"horizon": 2, "retrain": RetrainConfig()})
    experiment = PoseExperiment(config, trained.file, folder, "tiny", PoseSettings(samples=1, steps=1))
    kind, asked = load_kind("intersection_poses"), ("left", "retrained", "none", 0)
    unknown = settings_hash(kind, experiment, *asked)  # it is not trained yet
    (folder / "retrain" / "round0").mkdir(parents=True)
    shutil.copy(folder / "policy" / "naive.safetensors", folder / "retrain" / "round0" / "policy.safetensors")
    assert settings_hash(kind, experiment, *asked) != unknown
    cell = kind.run_cell(experiment, *asked, tmp_path, silent)
    assert cell == kind.run_cell(experiment, *asked, tmp_path, silent)
    naive = kind.run_cell(experiment, "left", "naive", "none", 0, tmp_path, silent)
    assert json.dumps(naive["deployed"]) == json.dumps(cell["deployed"])  # the very same weights


def test_maps_are_of_what_the_cell_found(trained: Experiment, tmp_path: Path) -> None:
    experiment = posed(trained)
    cell = pose_cells.run_cell(experiment, *PLACES, tmp_path, silent)
    victim = load_policy(victim_file(trained, "hardened"))
    asked = (experiment, victim, "right", 0, cell["extra"])
    small = PoseMapSettings(points=(2, 2), sideways_m=(0.0, 0.3), object_moves_m=((0.0, 0.0), (0.0, 0.2)))
    pictures = draw_maps(*asked, 1, tmp_path, silent, experiment.poses, small)
    assert [cv2.imread(str(picture)) is not None for picture in pictures] == [True, True]
    rows = json.loads((tmp_path / f"robustness_{trained.world.objects[1].name}.json").read_text())["cells"]
    # The first start past objects that nobody has moved is the cell's own drive.
    assert rows["0"][0][0] == pytest.approx(np.mean(cell["surrogate"]["total_cte_m"]), rel=1e-6)
    assert len(rows) == 2
    kept = pictures[0].with_suffix(".json").stat().st_mtime_ns
    draw_maps(*asked, 1, tmp_path, silent, experiment.poses, small)
    assert pictures[0].with_suffix(".json").stat().st_mtime_ns == kept
    with pytest.raises(CellError, match="expected an object of 0 to 4, got 5"):
        draw_maps(*asked, 5, tmp_path, silent, experiment.poses, small)
    with pytest.raises(CellError, match="placed the objects"):
        draw_maps(experiment, victim, "right", 0, {}, 1, tmp_path, silent, experiment.poses, small)
