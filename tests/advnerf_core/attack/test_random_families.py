"""The random methods: equal budgets, all carriers of colours, resumption, and what they refuse."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.methods import METHODS, SearchRun, SearchSettings
from advnerf_core.attack.problem import NoColoursError
from advnerf_core.attack.search import textures
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.display import DisplayModel
from advnerf_core.fields.colour_grid import ColourGridError, colour_grid
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.scene.surrogate import Surrogate
from tests.support.attack_toy import MOUNT, T_WORLD_FROM_FACE, VIEW, face, painted_room, toy_problem

FAMILIES = ("random_coarse", "random_levels", "random_pink", "random_natural")
SETTINGS = SearchSettings(4, sigma=5.0, cells=2)


@pytest.fixture(scope="module")
def problem():
    return toy_problem(2, resolution=12, dtype=torch.float32)


def voxels():
    slots = np.arange(4 * 4 * 4, dtype=np.int32).reshape(4, 4, 4)
    return VoxelGridObject(
        slots=slots,
        theta_shape=(64, 3),
        fixed_colours=np.zeros((0, 3)),
        box_min=np.full(3, -0.2),
        box_max=np.full(3, 0.2),
        T_world_from_object=T_WORLD_FROM_FACE,
    )


def mesh():
    return MeshField(unwrapped(sphere(0.3, (0.5, 0.5, 0.5), 1), 8), T_WORLD_FROM_FACE)


def seeing(problem, *objects):
    sensor = Surrogate(painted_room, VIEW, MOUNT, list(objects), dtype=torch.float32)
    return dataclasses.replace(problem, sensor=sensor)


class Recording:
    """A sensor that notes what it is shown."""

    def __init__(self, sensor):
        self.theta_shape, self.objects, self.plain_theta = (
            sensor.theta_shape,
            sensor.objects,
            sensor.plain_theta,
        )
        self._sensor, self.thetas = sensor, []

    def sense(self, states, theta):
        self.thetas.append(theta.clone())
        return self._sensor.sense(states, theta)


def drawn(problem, method, settings=SETTINGS, run=None):
    recording = Recording(problem.sensor)
    seen = dataclasses.replace(problem, sensor=recording, steps=1)
    result = METHODS[method].search(seen, settings, run or SearchRun(seed=1))
    return result, torch.stack(recording.thetas)


def test_random_is_white_noise_as_ever(problem):
    generator = torch.Generator().manual_seed(1)
    expected = torch.stack([5.0 * torch.randn(12, 12, 3, generator=generator) for _ in range(4)])
    assert torch.equal(drawn(problem, "random")[1], expected)


@pytest.mark.parametrize("method", FAMILIES)
def test_every_family_draws_and_keeps_the_best(problem, method):
    result, thetas = drawn(problem, method, dataclasses.replace(SETTINGS, evaluations=30))
    assert thetas.shape == (30, 12, 12, 3)
    assert thetas.std().item() == pytest.approx(5.0, rel=0.15)
    assert result.best.predicted_total_cte_m == max(e.predicted_total_cte_m for e in result.history)
    assert torch.equal(result.theta, thetas[result.best.iteration])
    white = drawn(problem, "random", dataclasses.replace(SETTINGS, evaluations=30))[1]
    rough = (thetas[:, 1:] - thetas[:, :-1]).square().mean() / thetas.square().mean()
    assert rough < 0.8 * (white[:, 1:] - white[:, :-1]).square().mean() / white.square().mean()


@pytest.mark.parametrize("method", FAMILIES)
def test_objects_draw_one_after_the_other_each_on_its_own_grid(problem, method):
    objects = [voxels(), mesh(), face(6)]
    _, thetas = drawn(seeing(problem, *objects), method)
    families = dict(
        zip(FAMILIES, (textures.coarse(2), textures.levels, textures.pink, textures.natural), strict=True)
    )
    generator = torch.Generator().manual_seed(1)
    expected = torch.cat([families[method](colour_grid(each), generator) for each in objects])
    assert torch.equal(thetas[0], 5.0 * expected)


@pytest.mark.parametrize("carrier", [voxels, mesh], ids=["voxels", "mesh"])
@pytest.mark.parametrize("method", FAMILIES)
def test_any_carrier_of_colours_is_searched(problem, method, carrier):
    carried = seeing(problem, carrier())
    result = METHODS[method].search(carried, SETTINGS, SearchRun())
    assert result.theta.shape == carried.sensor.theta_shape
    assert len(result.history) == 4


@pytest.mark.parametrize("method", [*FAMILIES, "gradient_coarse", "frame"])
def test_a_face_behind_a_display_is_searched_too(problem, method):
    display = DisplayModel(np.tile([0.0, 1.0], (3, 1)), 0.8 * np.eye(3), np.full(3, 0.01))
    shown = dataclasses.replace(problem, sensor=DisplayedSensor(problem.sensor, display))
    result = METHODS[method].search(shown, SETTINGS, SearchRun())
    assert result.theta.shape == (12, 12, 3)
    if method in FAMILIES:  # what is drawn is what is shown
        _, bare = drawn(problem, method, run=SearchRun())
        assert torch.equal(result.theta, bare[result.best.iteration])


@pytest.mark.parametrize("method", [*FAMILIES, "gradient_coarse", "frame"])
def test_a_killed_search_ends_as_one_that_was_left_alone(problem, tmp_path, method):
    class StoppedError(Exception):
        pass

    def stop(evaluation):
        if evaluation.iteration == 1:
            raise StoppedError

    search, path = METHODS[method].search, tmp_path / "state.safetensors"
    whole = search(problem, SETTINGS, SearchRun(seed=2))
    with pytest.raises(StoppedError):
        search(problem, SETTINGS, SearchRun(2, path, stop))
    seen = []
    resumed = search(problem, SETTINGS, SearchRun(2, path, seen.append))
    assert [e.iteration for e in seen] == [2, 3]
    assert torch.equal(resumed.theta, whole.theta)
    assert [e.protocol_cte_m for e in resumed.history] == [e.protocol_cte_m for e in whole.history]
    others = [name for name in (*FAMILIES, "random", "gradient", "frame") if name != method]
    for other, settings in [(name, SETTINGS) for name in others] + [
        (method, dataclasses.replace(SETTINGS, sigma=4.0, learning_rate=0.2))
    ]:
        with pytest.raises(SearchStateError, match="other settings"):
            METHODS[other].search(problem, settings, SearchRun(2, path))


def test_what_has_no_grid_of_colours_is_refused(problem):
    sensor = ShapeSensor(Surrogate(painted_room, VIEW, MOUNT, [mesh()]), ShapeLimits(bound_m=0.2))
    shapes = dataclasses.replace(problem, sensor=sensor)
    summed = seeing(problem, with_summed_levels(voxels(), 2, 1, 2))
    for method in FAMILIES:
        with pytest.raises(NoColoursError, match=f"the method {method}, got the parameters of a ShapeSensor"):
            METHODS[method].search(shapes, SETTINGS, SearchRun())
        with pytest.raises(ColourGridError, match="use the method random"):
            METHODS[method].search(summed, SETTINGS, SearchRun())
        assert not METHODS[
            method
        ].reads_scale  # so that requests and spaces refuse shapes before anything is loaded
