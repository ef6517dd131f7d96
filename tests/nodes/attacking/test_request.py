import contextlib
from collections.abc import Iterator
from typing import Annotated, Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from advnerf_core.errors import AdvnerfError
from nodes.experiment.node.prepare import load_request, prepare, request_text
from nodes.experiment.node.request import parse_request
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.placed import PlacedObject
from nodes.experiment.show.own_scene import own_objects
from nodes.runtime.errors import ConfigError
from tests.support.tiny_request import loaded, tiny_request, with_objects


def test_paths_are_relative_to_the_file_and_a_request_survives_its_own_text(tmp_path):
    file = tiny_request(tmp_path / "here")
    (tmp_path / "here" / "policy.safetensors").rename(tmp_path / "policy.safetensors")
    changes = ["victims.mine.policy=../policy.safetensors", "over.seed=[3, 4]", "horizon=7"]
    request = load_request(file, changes, tmp_path / "run")
    assert request.config.victims["mine"].policy == str(tmp_path / "policy.safetensors")
    assert request.given_scene == tmp_path / "here" / "scene.safetensors"
    assert (request.config.seeds, request.config.horizon) == ((3, 4), 7)
    text = request_text(request)
    assert parse_request(text, folder=tmp_path / "elsewhere") == text
    kept = tmp_path / "elsewhere" / "kept.experiment.yaml"
    kept.parent.mkdir()
    kept.write_text(text)
    again = load_request(kept, folder=tmp_path / "run")
    assert request_text(again) == text
    assert prepare(again).settings_hash == prepare(request).settings_hash


def test_a_scene_elsewhere_is_the_same_place(tmp_path):
    first, second = (loaded(tiny_request(tmp_path / name)) for name in ("a", "b"))
    assert first.given_scene != second.given_scene
    assert first.world_settings == second.world_settings


def test_a_panel_looks_where_it_says_and_may_be_tilted():
    panel = PlacedObject(
        name="a", kind="panel", x_m=3.0, y_m=-1.5, z_m=0.1, yaw_rad=3.0, face={"size_m": 0.8}
    )
    np.testing.assert_allclose(panel.T_world_from_face[:3, 3], [3.0, -1.5, 0.5])
    np.testing.assert_allclose(panel.T_world_from_face[:3, 0], [np.cos(3.0), np.sin(3.0), 0.0])
    tilted = panel.model_copy(update={"pitch_rad": 0.2, "roll_rad": 0.1}).T_world_from_face
    np.testing.assert_allclose(tilted[:3, :3].T @ tilted[:3, :3], np.eye(3), atol=1e-12)
    assert tilted[2, 0] == pytest.approx(-np.sin(0.2)), "its front looks down"
    assert tilted[2, 1] == pytest.approx(np.cos(0.2) * np.sin(0.1)), "its left edge is up"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["horizn=3"], r"--set horizn=3: unknown key horizn; valid keys here: .*horizon"),
        (["attack.metod=random"], r"unknown key attack.metod; valid keys here: cache_mib"),
        (
            ["over.method=[annealing]"],
            r"over.method.0: expected an attack method of random, .*, cem, .*; got 'annealing'; one of your own",
        ),
        (["name=../other"], "name: expected a name without /, as it becomes that of a folder"),
        (["name=reference"], "name: expected printed characters, .* and not reference"),
        (["name=' a'"], "name: expected printed characters, none of them a space at an end"),
        (["name=" + 101 * "a"], "at most 100 bytes"),
        (["over.seed=0"], "over.seed: expected a list in brackets, got 0"),
        (["attack=3"], "attack: expected keys and values, got 3"),
        (["space={cells: 3}"], "space.kind is missing; add it"),
        (["attack.evaluations=0"], r"attack.evaluations: .* greater than or equal to 1"),
        (["objects=[]"], "expected objects whose places are given"),
        (["objects=[{name: a, kind: panel}]"], r"objects.0.*x_m"),
        (["objects=[{name: a, kind: gone.object.safetensors, x_m: 0, y_m: 0}]"], "which is not there"),
        (["objects=[{name: a, kind: cube, x_m: 0, y_m: 0, levels: 3}]"], "expected levels of an object file"),
        (
            ["attack.start_poses=[[0, 0, 0]]", "attack.goals=[[1, 0], [0, 1]]"],
            "expected no attack.goals, or one for each of 1 start_poses, got 2",
        ),
        (["attack.response.delay_s=.nan"], "attack.response.delay_s"),
        (["attack.start_poses=[[1.2, -1.8, 0], [120, -180, 0]]"], r"on the track, at most 0.4 m .* x = 120 m, y = -180 m"),
        (["attack.robustness.jitter_m=10"], "jitter_m: expected at most 1 m, not cm or mm, got 10"),
        (["attack.robustness.noise=25"], "attack.robustness.noise: input should be less than or equal to 1, got 25"),
        (["attack.response.slew_radps=180"], "slew_radps: expected at most 100 rad/s, not degrees/s, got 180"),
        (["objects=[{name: a, kind: panel, x_m: 0, y_m: 0, bounds: {yaw_rad: [0, 90]}}]"], "yaw_rad.1: expected radians"),
        (["over.method=[gradient, random]"], "expected one method of attack in over.method"),
        (["over.method=[none]"], "expected one method of attack in over.method"),
        (["over.attack.evaluations=[2, 3]"], "expected no variants"),
        (["gate=steering"], "expected gate null"),
        (["deploy.through=world"], "expected deploy.through nothing"),
        (["victims={}"], "expected victims that exist"),
        (["world={kind: scene, file: scene.safetensors}"], "expected a calibration folder, or files for camera, vehicle, room"),
        (["world.file=gone.safetensors"], "file: expected a file or folder relative to this file, got gone.safetensors"),
        (["world.file=policy.safetensors"], "expected format .* in .*policy.safetensors"),
        (["world.heigt=1"], "unknown key .*heigt"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_error_that_says_where(tmp_path, change, message):
    with pytest.raises(AdvnerfError, match=message):
        loaded(tiny_request(tmp_path), change)


# Places of a world, which is as large as a town, and ways along its paths.
_OF_A_WORLD = {"x_m", "y_m", "z_m", "driven_m", "drives_from_m"}


def _lengths_of(model: type[BaseModel], seen: set[type]) -> Iterator[tuple[str, Any]]:
    seen.add(model)
    for name, field in model.model_fields.items():
        if name.endswith("_m") and name not in _OF_A_WORLD:
            yield f"{model.__name__}.{name}", Annotated[(field.annotation, *field.metadata, None)]
        inside = [field.annotation]
        for part in inside:
            inside += get_args(part)
            if isinstance(part, type) and issubclass(part, BaseModel) and part not in seen:
                yield from _lengths_of(part, seen)


def test_no_length_of_an_experiment_may_be_in_millimetres():
    found = dict(_lengths_of(ExperimentConfig, set()))
    assert {"ExperimentConfig.held_cap_m", "PlacesConfig.move_m", "FaceConfig.size_m"} <= found.keys()
    for name, annotation in found.items():
        adapter, passed = TypeAdapter(annotation), 0
        for shape in (lambda m: m, lambda m: (m,), lambda m: ((m, m),)):
            with contextlib.suppress(ValidationError):
                adapter.validate_python(shape(0.5))
                passed += 1
                with pytest.raises(ValidationError, match="not cm or mm"):
                    adapter.validate_python(shape(500.0))
        assert passed, name


def test_the_error_names_file_and_line(tmp_path):
    file = with_objects(tiny_request(tmp_path), "{name: a, kind: panel, x_m: 1.0, y_m: 0.0, yaw: 1.0}")
    message = r"tiny.experiment.yaml:6: unknown key objects.0.*yaw; valid keys here: .*yaw_rad"
    with pytest.raises(ConfigError, match=message):
        loaded(file)


def test_an_experiment_in_a_world_is_no_request(tmp_path):
    with pytest.raises(ConfigError, match=r"expected world \{kind: scene, file: ...\}"):
        parse_request("name: a\nworld: {kind: lab}\npaths: [track]\n")


def test_goals_are_told_from_each_start(tmp_path):
    file = tiny_request(tmp_path)
    starts = ["attack.start_poses=[[0, -2, 0], [0.1, -2, 0]]", "attack.goals=[[1, 0], [0, 1]]"]
    with pytest.raises(ConfigError, match=r"vectors of length 0 for this policy \(0: none\), got lengths 2"):
        prepare(loaded(file, starts))


def test_what_own_scenes_take_is_refused_in_a_world(tmp_path):
    import yaml

    from nodes.experiment.steps.run import load_experiment

    cube = {"name": "a", "kind": "cube", "x_m": 3.0, "y_m": 3.0}
    data = {"name": "a", "world": {"kind": "lab"}, "paths": ["track"], "objects": [cube]}
    file = tmp_path / "a.experiment.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match="only in a learned scene of your own"):
        load_experiment(file, None, [], tmp_path / "run")


def test_objects_without_a_target_show_nothing_in_the_room(tmp_path):
    file = with_objects(tiny_request(tmp_path), "{name: a, kind: panel, x_m: 1.0, y_m: -1.5}")
    prepared = prepare(loaded(file))
    assert prepared.space.mount is None
    (own,) = own_objects(prepared.experiment)
    assert own.field.theta_shape == (64, 64, 3)
