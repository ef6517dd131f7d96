import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.pose_maps import PoseMapError, landscape, robustness_map
from advnerf_core.attack.pose_plots import draw_landscape, draw_placements, draw_robustness
from advnerf_core.attack.spaces.placement import placed
from tests.support.placed_toy import SQUARE, moving

GRID = ([2.2, 2.7, 3.2], [-2.0, -1.4], [2.9])


@pytest.fixture(scope="module")
def problem():
    return moving(2, objects=2)


@pytest.fixture(scope="module")
def theta(problem):
    return problem.sensor.initial_theta(torch.Generator().manual_seed(2))


def direct(problem, theta, placements, colours=None, **changes):
    surrogate = problem.sensor.surrogate
    moved = surrogate.with_objects(placed(surrogate.objects, placements))
    colours = problem.sensor.colours(theta) if colours is None else colours
    return evaluate(dataclasses.replace(problem, sensor=moved, **changes), colours)


def test_a_landscape_is_the_drive_at_each_point_and_nothing_on_the_lane(problem, theta):
    found = landscape(problem, theta, GRID)
    assert found.total_cte_m.shape == (3, 2, 1)
    placements = problem.sensor.placements(theta)
    for i, j in ((1, 0), (2, 1)):
        placements[0, :3] = torch.tensor([GRID[0][i], GRID[1][j], 2.9])
        expected = direct(problem, theta, placements)[1].protocol_cte_m.mean()
        assert found.total_cte_m[i, j, 0] == pytest.approx(float(expected), rel=1e-9)
    assert np.isnan(found.total_cte_m[0]).any()
    picture = cv2.imdecode(np.frombuffer(draw_landscape(found, [SQUARE], {"here": (2.7, -1.8)}), np.uint8), 1)
    assert picture.std() > 10


def test_a_robustness_map_compares_with_plain_colours_at_the_same_poses(problem, theta):
    starts, moves = (
        [(-1.1, -1.75, 0.05), (-0.9, -2.3, -0.05)],
        [(0.0, 0.0, 0.0), (0.2, -0.1, 0.3), (-2.5, 0.0, 0.0)],
    )
    found = robustness_map(problem, theta, starts, moves)
    placements = problem.sensor.placements(theta)
    placements[0, :3] += torch.tensor(moves[1])
    rollout, totals = direct(problem, theta, placements)
    np.testing.assert_allclose(found.total_cte_m[1], totals.protocol_cte_m)
    np.testing.assert_allclose(
        found.worst_cte_m[1], np.abs(SQUARE.project(rollout.states[..., :2].numpy()).cte_m).max(0)
    )
    plain = direct(problem, theta, placements, problem.sensor.surrogate.plain_theta())[1]
    np.testing.assert_allclose(found.plain_cte_m[1], plain.protocol_cte_m)
    assert np.isnan(found.total_cte_m[2]).all()
    assert cv2.imdecode(np.frombuffer(draw_robustness(found), np.uint8), 1).std() > 10
    drives = {"none": rollout.states[:, 0, :2].numpy()}
    top = draw_placements(problem.sensor.space, placements, [SQUARE], drives)
    assert cv2.imdecode(np.frombuffer(top, np.uint8), 1).std() > 10


def test_files_of_maps_are_json_where_an_object_is_on_the_lane(problem, theta, tmp_path):
    files = tmp_path / "landscape.json", tmp_path / "robustness.json"
    made = [
        landscape(problem, theta, GRID, file=files[0]),
        robustness_map(
            problem, theta, [(-1.1, -1.75, 0.05)], [(0.0, 0.0, 0.0), (-2.5, 0.0, 0.0)], 0, files[1]
        ),
    ]
    for file, found in zip(files, made, strict=True):
        assert np.isnan(found.total_cte_m).any()
        assert "null" in file.read_text()
        json.loads(file.read_text(), parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    again = landscape(problem, theta, GRID, file=files[0])
    np.testing.assert_array_equal(again.total_cte_m, made[0].total_cte_m)


@pytest.mark.parametrize("kind", ["landscape", "robustness"])
def test_a_stopped_map_goes_on_to_the_bit_and_finished_cells_are_not_driven_again(
    problem, theta, tmp_path, kind
):
    def make(file=None, on_cell=None, **settings):
        if kind == "landscape":
            return landscape(problem, theta, GRID, file=file, on_cell=on_cell, **settings)
        starts = [(-1.1, -1.75, 0.05)]
        return robustness_map(
            problem, theta, starts, [(0.1 * k, 0, 0) for k in range(4)], 0, file, on_cell, **settings
        )

    class StoppedError(Exception):
        pass

    def stop(done, count):
        if done == 3:
            raise StoppedError

    file = tmp_path / "map.json"
    with pytest.raises(StoppedError):
        make(file, stop)
    assert len(json.loads(file.read_text())["cells"]) == 3
    asked, sense = [], problem.sensor.surrogate.camera_poses
    problem.sensor.surrogate.camera_poses = lambda states: (asked.append(len(states)), sense(states))[1]
    try:
        resumed = make(file)
        count = len(asked)
        make(file)
        assert len(asked) == count
    finally:
        del problem.sensor.surrogate.camera_poses
    np.testing.assert_array_equal(resumed.total_cte_m, make().total_cte_m)
    with pytest.raises(PoseMapError, match="other settings"):
        make(file, settings_hash="another scene")
    file.write_text("{")
    with pytest.raises(PoseMapError, match="delete it"):
        make(file)


def test_what_is_no_map_is_refused(problem, theta):
    with pytest.raises(PoseMapError, match=r"object of 0..1, got 2"):
        landscape(problem, theta, GRID, 2)
    with pytest.raises(PoseMapError, match="lists of finite numbers"):
        landscape(problem, theta, ([], [0.0], [0.0]))
    with pytest.raises(PoseMapError, match="starts"):
        robustness_map(problem, theta, [(0.0, 0.0)], [(0.0, 0.0, 0.0)])
    with pytest.raises(PoseMapError, match=r"object of 0..1, got -1"):
        robustness_map(problem, theta, [(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)], -1)
    with pytest.raises(TypeError, match="PlacedSensor"):
        landscape(dataclasses.replace(problem, sensor=problem.sensor.surrogate), theta, GRID)
