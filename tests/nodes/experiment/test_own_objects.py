"""Objects of a user's: a mesh or what `advnerf scene object build` wrote stands in an experiment by the name of its file."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically, write_json
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.mesh_files import load_mesh
from advnerf_core.objects.voxel.model import load_object, save_object
from nodes.experiment.engine.artefact import Artefact, digest_of, write_artefact
from nodes.experiment.engine.stages import key_of
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.object_kinds import extent_m, footprint_m
from nodes.experiment.run.plan import statuses
from nodes.experiment.show import objects
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.keys import settings_hash
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from tests.nodes.experiment.conftest import write_file

LENGTH_M, WIDTH_M, HEIGHT_M = 0.6, 2.4, 1.5
# On the pavement of the junction's corner.
STANDS = {"x_m": 12.0, "y_m": -12.0, "yaw_rad": 0.0}


def billboard(file: Path, length_m: float = LENGTH_M) -> Path:
    """A red box whose base is in its middle; GLB has y up and z to the front."""
    box = trimesh.creation.box((WIDTH_M, HEIGHT_M, length_m))
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([200, 20, 20, 255], (8, 1)))
    box.export(file)
    return file


def experiment_in(folder: Path, *kinds: str) -> Experiment:
    things = [{"name": f"thing{index}", "kind": kind, **STANDS} for index, kind in enumerate(kinds)]
    file = write_file(folder, objects=things)
    return load_experiment(file, "tiny", ["object.mesh_resolution=24"], folder / "run")


def settings(experiment: Experiment, name: str) -> dict[str, object]:
    return dict(next(stage for stage in stages_of(experiment) if stage.name == name).settings.keyed)


def test_a_mesh_and_a_built_object_stand_where_they_are_put(tmp_path: Path) -> None:
    mesh = load_mesh(billboard(tmp_path / "billboard.glb"))
    save_object(
        tmp_path / "mine.object.safetensors", build_from_mesh(mesh, "mine", 16, 0, {"mesh": "billboard.glb"})
    )
    experiment = experiment_in(tmp_path, "billboard.glb", "mine.object.safetensors")
    kind = experiment.config.objects[0].kind
    assert footprint_m(kind) == pytest.approx((LENGTH_M, WIDTH_M))
    assert extent_m(kind) == pytest.approx((LENGTH_M, WIDTH_M, HEIGHT_M))
    folder = experiment.stage_folder("object")
    folder.mkdir(parents=True)
    objects.run(experiment, folder, lambda *_: None)
    assert sorted(each.name for each in folder.iterdir()) == [
        "billboard.object.safetensors",
        "mine.object.safetensors",
    ]
    for name, voxels in (("billboard", 24), ("mine", 16)):
        size_m = load_object(folder / f"{name}.object.safetensors").size_m
        assert size_m == pytest.approx([LENGTH_M, WIDTH_M, HEIGHT_M], abs=2.1 * WIDTH_M / voxels)
    for field in objects.placed_objects(experiment):
        assert field.T_world_from_object[:2, 3].tolist() == [12.0, -12.0]
        assert field.free_count > 50
    assert [each["kind"] for each in objects.describe(experiment)] == [
        "billboard.glb",
        "mine.object.safetensors",
    ]


def test_what_is_in_the_file_counts_and_not_where_it_lies(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    billboard(tmp_path / "a" / "billboard.glb")
    shutil.copy(tmp_path / "a" / "billboard.glb", tmp_path / "b")
    first, second = (experiment_in(tmp_path / name, "billboard.glb") for name in ("a", "b"))
    for stage in ("object", "policy"):
        assert settings(first, stage) == settings(second, stage)
    billboard(tmp_path / "b" / "billboard.glb", length_m=0.5)
    changed = experiment_in(tmp_path / "b", "billboard.glb")
    assert settings(changed, "object") != settings(first, "object")


def test_experiments_without_files_depend_on_their_kinds_alone(tmp_path: Path) -> None:
    found = settings(experiment_in(tmp_path, "hydrant"), "object")
    assert (found["kinds"], found["files"]) == (["hydrant"], {})


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("bilboard.glb", "which is not there"),
        ("hydrnt", r"did you mean hydrant\?.*one of your own is a file of 'advnerf scene object build'"),
        ("billboard.xyz", "expected a kind of object of .*; one of your own"),
        ("broken.stl", "expected the section mesh, with a unit or height_m"),
        ("broken.glb", "broken.glb"),
    ],
)
def test_a_kind_that_is_none_is_said_with_its_line(tmp_path: Path, kind: str, message: str) -> None:
    for name in ("broken.glb", "broken.stl"):
        (tmp_path / name).write_bytes(b"glTF")
    with pytest.raises(AdvnerfError, match=message):
        experiment_in(tmp_path, kind)


def test_a_long_object_may_not_reach_into_a_lane(tmp_path: Path) -> None:
    billboard(tmp_path / "billboard.glb", length_m=20.0)
    with pytest.raises(AdvnerfError, match="thing0 reaches into a lane"):
        experiment_in(tmp_path, "billboard.glb")


def test_voxels_have_no_mesh_to_search(tmp_path: Path) -> None:
    mesh = load_mesh(billboard(tmp_path / "billboard.glb"))
    save_object(
        tmp_path / "mine.object.safetensors", build_from_mesh(mesh, "mine", 16, 0, {"mesh": "billboard.glb"})
    )
    file = write_file(tmp_path, objects=[{"name": "a", "kind": "mine.object.safetensors", **STANDS}])
    with pytest.raises(AdvnerfError, match=r"got voxels .* name the mesh itself"):
        load_experiment(file, "tiny", ["space={kind: mesh_texture}"], tmp_path / "run")


def test_cells_of_an_old_mesh_are_not_done(tmp_path: Path) -> None:
    """Before the stage is made of the new one, and again once the old one is back."""
    cell, states = Cell("right", "hardened", "none", 0), []
    billboard(tmp_path / "billboard.glb")
    experiment = experiment_in(tmp_path, "billboard.glb")
    records: dict[str, Artefact] = {}
    for stage in stages_of(experiment):
        folder = experiment.stage_folder(stage.name)
        write_atomically(folder / "made.txt", stage.name)
        records[stage.name] = Artefact(
            key_of(stage, records), digest_of(folder), 1.0, stage.settings.resolved
        )
        write_artefact(folder, records[stage.name])
    drives = {"total_cte_m": [6.0], "off_track": [True], "none_total_cte_m": [2.0]}
    found = {
        **vars(cell.inside),
        "settings_hash": settings_hash(experiment, cell),
        "surrogate": drives,
        "seconds": 1.0,
    }
    write_json(experiment.cell_result(cell), {**found, "machine": "m", "date": "d"})
    for length_m in (LENGTH_M, 1.5 * LENGTH_M, LENGTH_M):
        billboard(tmp_path / "billboard.glb", length_m)
        (status,) = statuses(experiment_in(tmp_path, "billboard.glb"), [cell])
        states.append((status.state, status.text))
    why = "what object, policy was made from changed; advnerf experiment run makes it anew"
    assert states == [("done", ""), ("changed", why), ("done", "")]
