"""Pose attacks of a request, from its file to attack file, landscape and robustness map, by the command line too."""

import json

import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack
from nodes.experiment.node.poses import mapped
from nodes.experiment.node.prepare import prepare
from nodes.experiment.node.search import run_attack
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.tiny_request import loaded, tiny_request

BOUNDS = "bounds: {x_m: [0.9, 1.6], y_m: [-1.5, -1.2], yaw_rad: [2.8, 3.4]}"
PLACES = """\
space: {kind: places, keep_out_m: 0.3, samples: 2, steps: 2, colour_rate: 0.1}
maps:
  landscape: {points: [2, 2]}
  robustness: {sideways_m: [-0.1, 0.1], object_moves_m: [[0.0, 0.0], [0.1, 0.1]]}
"""


def request_file(folder, bounds=BOUNDS):
    file = tiny_request(folder)
    text = (
        file.read_text().replace("y_m: -1.7", "y_m: -1.3").replace("kind: panel,", f"kind: panel, {bounds},")
    )
    file.write_text(text + PLACES)
    return file


def test_commands_search_map_and_find_their_work_again(tmp_path, monkeypatch, capsys):
    file, folder = request_file(tmp_path), tmp_path / "out"
    attack_path = folder / "seed_0.attack.safetensors"
    assert advnerf(monkeypatch, "attack", "run", file, "-o", folder) == 0
    attack, content = load_attack(attack_path), attack_path.read_bytes()
    (found,) = attack.objects
    placement = found.placement
    assert attack.space == "places"
    assert 0.9 <= placement[0] <= 1.6
    assert -1.5 <= placement[1] <= -1.2
    assert attack.face is not None
    assert attack.face_object is found
    curve = json.loads((folder / "seed_0.json").read_text())
    assert len(curve["predicted_total_cte_m"]) == 4
    assert curve["attack_id"] == attack.attack_id
    np.testing.assert_allclose(curve["placements"], [placement])
    assert (folder / "seed_0.poses.png").stat().st_size > 1000
    assert advnerf(monkeypatch, "attack", "maps", file, "-o", folder, "--attack", attack_path) == 0
    for name in ("landscape", "robustness"):
        assert (folder / f"{name}.png").stat().st_size > 1000
    assert len(json.loads((folder / "landscape.json").read_text())["cells"]) == 4
    assert np.array(json.loads((folder / "robustness.json").read_text())["cells"]["1"]).shape == (3, 2)
    assert advnerf(monkeypatch, "attack", "run", file, "-o", folder) == 0
    assert attack_path.read_bytes() == content
    capsys.readouterr()
    # Another question in the same folder is refused in one line.
    assert advnerf(monkeypatch, "attack", "maps", file, "-o", folder) == 2
    assert "belongs to a map with other settings" in capsys.readouterr().err
    assert advnerf(monkeypatch, "attack", "maps", file, "-o", tmp_path / "b", "--set", "maps.object=3") == 2
    assert "expected an object of 0" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_run_ends_in_the_same_bytes_and_seeds_differ(tmp_path):
    request = loaded(request_file(tmp_path), ["over.seed=[0, 3]", "horizon=1", "space.steps=1"])
    whole = run_attack(request, tmp_path / "whole", ProgressDisplay())
    places = [load_attack(file).objects[0].placement for file in whole]
    assert places[0] != places[1]

    class Impatient(ProgressDisplay):
        def start(self, stage):
            def report(fraction, text=""):
                if fraction >= 0.5:
                    raise KeyboardInterrupt

            return report

    with pytest.raises(KeyboardInterrupt):
        run_attack(request, tmp_path / "killed", Impatient())
    assert [f.read_bytes() for f in run_attack(request, tmp_path / "killed", ProgressDisplay())] == [
        f.read_bytes() for f in whole
    ]


def test_poses_alone_keep_the_colours_they_are_given_and_random_ones_spend_as_much(tmp_path):
    file = request_file(tmp_path)
    (coloured,) = run_attack(loaded(file, ["horizon=1"]), tmp_path / "coloured", ProgressDisplay())
    alone = ["horizon=1", "space.colours=false", f"space.coloured_by={coloured}", "over.method=[random]"]
    request = loaded(file, alone)
    sensor = prepare(request).space.sensor
    assert sensor.theta_shape == (4,)
    (found,) = run_attack(request, tmp_path / "alone", ProgressDisplay())
    attack = load_attack(found)
    assert attack.method == "random"
    np.testing.assert_array_equal(attack.face_object.theta, load_attack(coloured).face_object.theta)
    assert attack.extra["evaluations"] == 4
    assert attack.config_sha256 != load_attack(coloured).config_sha256
    np.testing.assert_allclose(
        sensor.placements(mapped(request, found).theta), [attack.objects[0].placement], atol=1e-9
    )
    with pytest.raises(ConfigError, match="expected the colours of the request"):
        mapped(loaded(file, ["horizon=1", "space.colours=false"]), coloured)


def test_its_hash_knows_the_bounds_but_not_the_maps(tmp_path):
    file = request_file(tmp_path)
    before = prepare(loaded(file)).settings_hash
    assert prepare(loaded(file, ["maps.landscape.points=[9, 9]"])).settings_hash == before
    assert prepare(loaded(file, ["space.keep_out_m=0.2"])).settings_hash != before


@pytest.mark.parametrize(
    ("bounds", "changes", "what"),
    [
        ("bounds: {x_m: [2.0, 1.0]}", [], "expected the lower bound first"),
        ("bounds: {z_m: [0.0, 1.0]}", [], "z_m"),
        ("bounds: {scale: [0.5, 1.0]}", [], "no bounds of the scale of a panel"),
        (BOUNDS, ["space.coloured_by=scene.safetensors"], "expected space.colours false"),
        (
            BOUNDS,
            ["over.method=[cem]"],
            "expected a method that searches places, random or gradient, got cem",
        ),
        (BOUNDS, ["attack.robustness.smoothness=0.1"], "robustness.smoothness only where colours"),
    ],
)
def test_a_request_that_cannot_be_is_refused(tmp_path, bounds, changes, what):
    with pytest.raises(ConfigError, match=what):
        run_attack(loaded(request_file(tmp_path, bounds), changes), tmp_path / "out", ProgressDisplay())
    assert not (tmp_path / "out").exists()


def test_a_request_without_poses_and_bounds_on_the_lane_end_in_one_line(tmp_path, monkeypatch, capsys):
    assert advnerf(monkeypatch, "attack", "maps", tiny_request(tmp_path / "plain"), "-o", tmp_path / "a") == 2
    assert "expected space.kind places" in capsys.readouterr().err
    on_lane = request_file(tmp_path / "lane", BOUNDS.replace("[-1.5, -1.2]", "[-2.1, -1.9]"))
    assert advnerf(monkeypatch, "attack", "run", on_lane, "-o", tmp_path / "b") == 2
    said = capsys.readouterr().err
    assert "expected bounds with a place at least 0.3 m beside the path" in said
    assert "Traceback" not in said
