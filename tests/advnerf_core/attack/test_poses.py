import dataclasses
from functools import partial

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from advnerf_core.attack.artifact import AttackFile, AttackFileError
from advnerf_core.attack.health import central_slopes, frozen_loss, random_directions, slopes_of
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.search.poses import MultiStart, multi_start, placed_problem, random_poses
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import (
    KeepOut,
    PoseBounds,
    PoseBoundsError,
    PoseSpace,
    footprint,
    placed,
)
from advnerf_core.attack.spaces.places import PlaceLimits, PlaceSpace, randomly_placed
from advnerf_core.attack.spaces.space import NamedObject, SpaceError
from advnerf_core.fields.soft_edges import with_soft_edges
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.geometry import planar_pose
from advnerf_core.render.soft_pose import placement_of
from tests.support.attack_toy import T_WORLD_FROM_FACE, toy_problem
from tests.support.placed_toy import SQUARE, box, moving


def untimed(history):
    return [dataclasses.replace(evaluation, seconds=0.0) for evaluation in history]


@pytest.mark.parametrize("objects", [1, 2])
def test_the_gradient_of_poses_and_colours_is_that_of_finite_differences_with_frozen_camera_poses(objects):
    problem = moving(objects=objects)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(3))
    theta[problem.sensor.pose_count :] *= 0.1  # where the loss is nearly linear over the differences
    result = adjoint_gradient(problem, theta)
    loss = partial(frozen_loss, problem, rollout=result.rollout)
    # Poses weigh more than colours, so they get directions of their own.
    along = random_directions(theta, 6, 0)
    along[:3, problem.sensor.pose_count :] = 0.0
    along[:3] /= along[:3].norm(dim=1, keepdim=True)
    expected = central_slopes(loss, theta, along, 1e-5)
    assert np.abs(expected[:3]).max() > 1e-5
    np.testing.assert_allclose(
        slopes_of(result.gradient, along), expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max()
    )


def test_memory_of_a_render_is_that_of_covered_pixels_and_time_batches_do_not_change_the_gradient():
    problem = moving(4)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(1))
    rendered = problem.sensor.sense(problem.start_states, theta)
    assert rendered.nbytes < 12 * rendered.images.nbytes
    whole = adjoint_gradient(problem, theta).gradient
    for options in ({"time_batch": 1}, {"time_batch": 3, "cache_bytes": 0}):
        other = adjoint_gradient(dataclasses.replace(problem, **options), theta).gradient
        torch.testing.assert_close(other, whole, rtol=1e-9, atol=1e-12)


def judge(problem, theta):
    """Totals of a search's result."""
    return evaluate(*placed_problem(problem, theta))[1]


def test_soft_edges_look_like_the_true_ones_and_the_judge_uses_the_true_ones():
    problem = moving(free_colours=False)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(1))
    surrogate, colours = problem.sensor.sharp(theta)
    sharp = surrogate.sense(problem.start_states, colours).images
    soft = problem.sensor.sense(problem.start_states, theta).images
    assert float((soft - sharp).abs().mean()) < 0.01
    np.testing.assert_allclose(placement_of(surrogate.objects[0]), problem.sensor.placements(theta)[0])
    expected = evaluate(dataclasses.replace(problem, sensor=surrogate), colours)[1]
    assert torch.equal(judge(problem, theta).protocol_cte_m, expected.protocol_cte_m)


def opacity_along(field, start_m, end_m, count=400):
    """Opacity of parallel rays through an object from its front (down its x axis) at places across it."""
    places = np.linspace(start_m, end_m, count)
    shape, pitch = field.slots.shape, (field.box_max - field.box_min) / field.slots.shape
    depth = np.linspace(field.box_min[0], field.box_max[0], 600)
    points = np.stack(np.broadcast_arrays(depth[:, None], places, 0.0), -1)
    where = ((points - field.box_min) / pitch - 0.5).reshape(-1, 3).T
    density = map_coordinates(field.density, where, order=1, mode="nearest").reshape(len(depth), count)
    assert field.density.shape == shape
    return places, -np.expm1(-density.sum(0) * (depth[1] - depth[0]))


def test_a_soft_face_is_half_opaque_at_its_edge_and_as_soft_as_was_asked_for():
    soft = with_soft_edges(cube_face_object(0.8, 80), 0.08)
    places, opacity = opacity_along(soft, 0.3, 0.5)
    middle, inner, outer = (places[np.argmin(np.abs(opacity - share))] for share in (0.5, 0.9, 0.1))
    assert middle == pytest.approx(0.4, abs=2e-3)
    assert outer - inner == pytest.approx(0.8 * 0.08, abs=4e-3)
    assert opacity[0] > 0.999


def test_a_soft_body_keeps_its_outline_and_its_colours():
    field = cube_face_object(0.6, 24, depth_m=0.6, one_sided=False)
    soft = with_soft_edges(field, 0.1)
    places, opacity = opacity_along(soft, 0.1, 0.4)
    assert 0.27 < places[np.argmin(np.abs(opacity - 0.5))] < 0.35
    assert set(np.unique(soft.slots)) == set(np.unique(field.slots))
    for width in (0.0, np.nan):
        with pytest.raises(ValueError, match="positive width"):
            with_soft_edges(field, width)
    empty = dataclasses.replace(field, density=np.zeros(field.slots.shape))
    with pytest.raises(ValueError, match="more than half opaque"):
        with_soft_edges(empty)


def test_no_evaluation_leaves_the_bounds_or_stands_on_the_lane():
    problem = moving(
        1, objects=2, bounds=PoseBounds(x_m=(2.0, 3.0), y_m=(-2.6, -1.2), yaw_rad=(-np.pi, np.pi))
    )
    space, seen = problem.sensor.space, []
    sharp = problem.sensor.sharp

    def recorded(theta):
        seen.append(problem.sensor.unit(theta).clone())
        return sharp(theta)

    problem.sensor.sharp = recorded
    multi_start(problem, MultiStart(samples=3, steps=4, pose_rate=0.8))
    random_poses(problem, 6)
    assert len(seen) == 18
    assert len(torch.unique(torch.stack(seen), dim=0)) >= 12  # where nothing is seen of an object, it stays
    for unit in seen:
        for each in placed(space.objects, space.placements(unit)):
            assert _distance_by_hand(each) >= 0.3 - 2e-3
        placements = space.placements(unit)
        assert bool((placements[:, :2] >= torch.tensor([[2.0, -2.6], [2.6, -0.9]]) - 1e-6).all())
        assert bool((placements[:, :2] <= torch.tensor([[3.0, -1.2], [3.1, 0.2]]) + 1e-6).all())
        np.testing.assert_allclose(placements[1, 2:], [0.0, 1.0])


def _distance_by_hand(each):
    """Least distance of points all over an object's footprint from the path."""
    low, high = each.scale * each.box_min, each.scale * each.box_max
    x, y = np.meshgrid(np.linspace(low[0], high[0], 60), np.linspace(low[1], high[1], 60))
    points = (
        np.stack([x, y, np.zeros_like(x)], -1) @ each.T_world_from_object[:3, :3].T
        + each.T_world_from_object[:3, 3]
    )
    return np.abs(SQUARE.project(points[..., :2]).cte_m).min()


def test_the_distance_from_the_lane_is_that_of_the_footprint():
    lane = KeepOut((SQUARE,), 0.2)
    for each in (box(2.9, 0.3, 0.4), box(0.2, 0.5, 2.0), box(-2.7, -2.5, 1.0)):
        assert lane.distance_m(placement_of(each), footprint(each)) == pytest.approx(
            _distance_by_hand(each), abs=5e-3
        )
    across = box(2.2, 0.0)
    assert lane.distance_m(placement_of(across), footprint(across)) == pytest.approx(-0.2, abs=0.03)
    assert KeepOut((), 0.5).distance_m(placement_of(across), footprint(across)) == np.inf


def test_a_step_onto_the_lane_ends_beside_it_and_a_whole_turn_has_no_ends():
    space = PoseSpace(
        [box(2.9, 0.0)], [PoseBounds(x_m=(1.0, 3.0), yaw_rad=(-np.pi, np.pi))], KeepOut((SQUARE,), 0.25)
    )
    before = space.unit(torch.tensor([[2.9, 0.0, 0.0, 1.0]]))
    after = space.project(torch.tensor([[0.4, 0.0, 0.02, 0.0]]), before)
    assert space.allows(after)
    assert float(space.placements(after)[0, 0]) == pytest.approx(2.65, abs=0.05)
    turned = space.project(before + torch.tensor([0.0, 0.0, 1.5, 0.0]), before)
    assert float(turned[0, 2]) == pytest.approx(-0.5)
    np.testing.assert_allclose(
        space.unit(torch.tensor([[2.9, 0.0, 7.0, 1.0]]))[0, 2], (7.0 - 2 * np.pi) / np.pi
    )


def test_the_searches_spend_their_evaluations_and_multi_start_starts_over():
    problem = moving(2)
    seen = []
    climbed = multi_start(
        problem, MultiStart(samples=2, steps=3), run=SearchRun(1, on_evaluation=seen.append)
    )
    assert seen == list(climbed.history)
    assert [e.iteration for e in seen] == list(range(6))
    assert climbed.best.predicted_total_cte_m == max(e.predicted_total_cte_m for e in seen)
    # What is compared, kept and promised is the drive past the true edges.
    np.testing.assert_allclose(
        float(judge(problem, climbed.theta).protocol_cte_m.mean()), climbed.best.predicted_total_cte_m
    )
    guessed = random_poses(problem, 3, run=SearchRun(1))
    np.testing.assert_allclose(
        float(judge(problem, guessed.theta).protocol_cte_m.mean()), guessed.best.predicted_total_cte_m
    )
    # The second sample does not depend on what became of the first one.
    alone = multi_start(problem, MultiStart(samples=2, steps=1), run=SearchRun(1))
    np.testing.assert_allclose(alone.history[1].loss_m, climbed.history[3].loss_m)
    assert len(random_poses(problem, 6, run=SearchRun(1)).history) == 6


@pytest.mark.parametrize("free_colours", [True, False])
@pytest.mark.parametrize("search", ["multi_start", "random"])
def test_a_stopped_search_goes_on_to_the_bit(search, free_colours, tmp_path):
    problem, path = moving(2, free_colours=free_colours), tmp_path / "state.safetensors"
    settings = {"budget": MultiStart(2, 3)} if search == "multi_start" else {"evaluations": 6}
    searched = multi_start if search == "multi_start" else random_poses

    def run(**kept):
        return searched(problem, **settings, run=SearchRun(4, **kept))

    whole = run()
    for stop in (1, 2, 4):

        def interrupt(evaluation, stop=stop):
            if evaluation.iteration == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run(state_path=path, on_evaluation=interrupt)
    resumed = run(state_path=path)
    assert untimed(resumed.history) == untimed(whole.history)
    assert torch.equal(resumed.theta, whole.theta)
    with pytest.raises(SearchStateError, match="other settings"):
        run(state_path=path, settings_hash="another scene")
    other = moving(2, free_colours=free_colours, clearance_m=0.2)
    with pytest.raises(SearchStateError, match="other settings"):
        searched(other, **settings, run=SearchRun(4, path))


@pytest.mark.parametrize(
    ("bounds", "what"),
    [
        ({"x_m": (2.0, 1.0)}, "x_m: expected finite bounds, lower before upper"),
        ({"y_m": (0.0, np.inf)}, "y_m: expected finite bounds"),
        ({"scale": (0.0, 1.0)}, "scale: expected bounds above 0"),
    ],
)
def test_bounds_that_are_none_are_refused(bounds, what):
    with pytest.raises(PoseBoundsError, match=what):
        PoseBounds(**bounds)


def test_what_leaves_no_place_or_does_not_fit_is_refused():
    space = PoseSpace([box(2.0, 0.0)], [PoseBounds(x_m=(1.9, 2.1), y_m=(-0.3, 0.3))], KeepOut((SQUARE,), 0.3))
    with pytest.raises(
        PoseBoundsError, match=r"object 0: expected bounds with a place at least 0\.3 m beside"
    ):
        space.draw(torch.Generator().manual_seed(0))
    with pytest.raises(PoseBoundsError, match="clear of the lane"):
        space.unit(torch.tensor([[2.0, 0.0, 0.0, 1.0]]))
    with pytest.raises(PoseBoundsError, match="expected bounds for each of 1 object"):
        PoseSpace([box(2.0, 0.0)], [])
    with pytest.raises(PoseBoundsError, match="clearance"):
        KeepOut((SQUARE,), -1.0)
    problem = toy_problem(2)
    with pytest.raises(ValueError, match="surrogate's own"):
        PlacedSensor(problem.sensor, space)
    with pytest.raises(TypeError, match="expected a problem with a PlacedSensor"):
        multi_start(problem)
    with pytest.raises(ValueError, match="expected placements"):
        placed([box(0.0, 0.0)], torch.zeros(2, 4))
    with pytest.raises(ValueError, match="samples and steps"):
        MultiStart(samples=0)
    with pytest.raises(ValueError, match="at least one evaluation"):
        random_poses(moving(2), 0)


def test_placed_objects_keep_height_and_tilt():
    field = cube_face_object(0.8, 4, T_world_from_object=T_WORLD_FROM_FACE)
    (moved,) = placed([field], torch.tensor([[1.0, 2.0, 0.5, 0.9]], dtype=torch.float64))
    np.testing.assert_allclose(moved.T_world_from_object, planar_pose(1.0, 2.0, 0.5) + _lift(0.42))
    assert moved.scale == 0.9


def _lift(z_m):
    lift = np.zeros((4, 4))
    lift[2, 3] = z_m
    return lift


def space_of(problem, budget, colours=True):
    sensor = problem.sensor
    named = [NamedObject(f"box{k}", str(k)) for k in range(len(sensor.surrogate.objects))]
    limits = PlaceLimits(sensor.space.bounds, sensor.space.keep_out, colours)
    return PlaceSpace(sensor.surrogate, named, limits, budget)


def attack_of(space, problem, method, seed=7):
    result = space.search(method, problem, SearchSettings(), SearchRun(seed))
    face = AttackFile(
        method=method,
        space=space.name,
        objects=space.attacked(result.theta),
        face=None,
        camera=space.surrogate.camera,
        scene_sha256="",
        policy_sha256="",
        config_sha256="",
        seed=seed,
        predicted_total_cte_m=None,
        software_version="0",
    )
    return result, face


def test_an_attack_file_of_places_gives_what_a_deployment_shows():
    problem = moving(2, objects=2)
    space = space_of(problem, MultiStart(2, 2))
    surrogate, placed_there = space.surrogate, dataclasses.replace(problem, sensor=space.sensor)
    result, attack = attack_of(space, placed_there, "gradient")
    expected = multi_start(problem, MultiStart(2, 2), run=SearchRun(7))
    assert torch.equal(result.theta, expected.theta)
    assert attack.space == "places"
    found = space.restored(attack)
    places = space.sensor.placements(result.theta)
    turned = places.clone()
    turned[:, 2] = torch.remainder(places[:, 2] + torch.pi, 2 * torch.pi) - torch.pi
    np.testing.assert_allclose(
        torch.stack([placement_of(each) for each in found.objects]), turned, atol=1e-12
    )
    np.testing.assert_allclose([each.placement for each in attack.objects], turned, atol=1e-12)
    seen = dataclasses.replace(problem, sensor=found.seen_by(surrogate))
    # The file holds float32, the toy computes in float64.
    totals = [evaluate(seen, found.colours)[1], judge(problem, expected.theta)]
    torch.testing.assert_close(*(each.protocol_cte_m for each in totals), rtol=1e-6, atol=1e-6)
    # Composed into a deployment's image: opaque objects at the found places, hidden by what is nearer.
    T = surrogate.camera_poses(problem.start_states)
    rgb, depth_m = surrogate.scene_frames(T)
    deployed = surrogate.with_objects(found.objects, opaque=True)
    shown = deployed.overlay(rgb, depth_m, T, found.colours)
    assert torch.equal(shown, deployed.render(T, found.colours).images)
    assert float((shown - rgb.permute(0, 3, 1, 2)).abs().max()) > 0.1
    hidden = deployed.overlay(rgb, torch.full_like(depth_m, 0.1), T, found.colours)
    assert torch.equal(hidden, rgb.permute(0, 3, 1, 2))


def test_places_alone_keep_the_colours_and_other_methods_are_refused():
    problem = moving(2, objects=2)
    alone = space_of(problem, MultiStart(2, 2), colours=False)
    result, attack = attack_of(alone, dataclasses.replace(problem, sensor=alone.sensor), "random")
    assert len(result.history) == 4
    torch.testing.assert_close(alone.restored(attack).colours, alone.plain.colours, rtol=1e-6, atol=1e-6)
    with pytest.raises(SpaceError, match="random or gradient, got cem"):
        alone.search("cem", problem, SearchSettings(), SearchRun())
    others = dataclasses.replace(attack, objects=attack.objects[::-1])
    with pytest.raises(AttackFileError, match="expected an attack on box0, box1, got attack"):
        alone.restored(others)


def test_the_scene_of_a_drive_is_rendered_once_for_its_gradient_too():
    placed_one = moving(2)
    surrogate, rendered = placed_one.sensor.surrogate, []

    def counted(poses, pinhole):
        rendered.extend(poses)
        return background(poses, pinhole)

    background, surrogate.background = surrogate.background, counted
    found = {}
    for kept_bytes in (0, 2**20):
        rendered.clear()
        space = placed_one.sensor.space
        sensor = PlacedSensor(surrogate.remembering(kept_bytes), space)
        result = multi_start(
            dataclasses.replace(placed_one, sensor=sensor), MultiStart(1, 2), run=SearchRun(7)
        )
        found[kept_bytes] = (result.theta, len(rendered))
    frames = placed_one.steps * len(placed_one.start_states)
    # Two evaluations with gradients; what is kept are the frames of one drive.
    assert found[0][1] - found[2**20][1] >= 2 * (frames - len(placed_one.start_states))
    assert torch.equal(found[0][0], found[2**20][0])


def test_objects_for_retraining_are_at_allowed_places():
    sensor = moving(1, objects=2).sensor
    limits = PlaceLimits(sensor.space.bounds, sensor.space.keep_out)
    made = randomly_placed(sensor.space.objects, limits, 3, seed=1)
    places = torch.stack([torch.stack([placement_of(each) for each in one]) for one in made])
    assert len(torch.unique(places, dim=0)) == 3
    for placements in places:
        sensor.space.unit(placements)  # refuses what is not allowed


def test_a_placement_on_its_bound_comes_back_from_where_rounding_put_it():
    """Searches end on bounds; (highest - middle) / half is one bit above 1 for some of them."""
    beyond = 0
    for k in range(200):
        x_m, move_m = 2.0 + 0.0137 * k, 0.9 + 0.011 * k
        space = PoseSpace([box(x_m, 0.0)], [PoseBounds(x_m=(x_m - move_m, x_m + move_m))], None)
        for sign in (-1.0, 1.0):
            unit = torch.tensor([[sign, 0.0, 0.0, 0.0]], dtype=torch.float64)
            placed = space.placements(unit)
            beyond += bool(((placed - space.middle)[0, 0] / space.half[0, 0]).abs() > 1.0)
            back = space.unit(placed)
            assert back.abs().max() <= 1.0
            torch.testing.assert_close(back, unit, rtol=0.0, atol=1e-12)
    assert beyond > 0
