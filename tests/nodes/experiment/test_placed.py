"""Where the objects of the junction's experiment stand: beside the lanes, on the pavement, and large in the policy's view."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from advnerf_core.geometry import invert_transform, planar_pose
from advnerf_core.objects.voxel.generators import GENERATORS, hydrant, small_car
from advnerf_core.objects.voxel.rasterise import draw_mesh
from hardware.worlds.junction.config import IntersectionConfig
from hardware.worlds.junction.scene import Intersection
from nodes.experiment.plan.object_kinds import MADE_HERE_M
from nodes.experiment.plan.placed import PlacedObject, in_a_lane
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.overview import from_above
from nodes.experiment.steps.run import load_experiment

LAUNCH = Path(__file__).parents[3] / "launch" / "junction.experiment.yaml"
CONFIG = IntersectionConfig()


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    return load_experiment(LAUNCH, "full", [], tmp_path_factory.mktemp("run"))


def hydrant_at(x_m: float, y_m: float, scale: float = 1.0) -> PlacedObject:
    return PlacedObject(name="one", kind="hydrant", x_m=x_m, y_m=y_m, scale=scale)


def test_object_sizes_are_those_of_the_generated_meshes() -> None:
    for kind, mesh in (("hydrant", hydrant()), ("small_car", small_car())):
        low, high = mesh.box
        covered = 2.0 * np.maximum(np.abs(low[:2]), np.abs(high[:2]))
        size = np.array(MADE_HERE_M[kind][:2])
        assert (covered <= size + 1e-6).all()
        assert (covered >= 0.8 * size).all()
        assert low[2] == pytest.approx(0.0, abs=0.01)
        assert high[2] == pytest.approx(MADE_HERE_M[kind][2])


def test_the_ground_that_an_object_covers_is_that_of_its_own_size(tmp_path: Path) -> None:
    """The report draws it, of what a learned scene alone takes as well."""
    trimesh.creation.box((200.0, 100.0, 400.0)).export(tmp_path / "box.stl")

    def covered_m(kind: str, **own: object) -> tuple[float, float]:
        corners = np.array(
            PlacedObject.model_validate(
                {"name": "one", "kind": kind, "x_m": 1.0, "y_m": 2.0} | own
            ).corners_m()
        )
        np.testing.assert_allclose(corners.mean(axis=0), [1.0, 2.0])
        length, width = np.ptp(corners, axis=0)
        return float(length), float(width)

    file = str(tmp_path / "box.stl")
    assert covered_m(file, mesh={"unit": "mm"}, scale=2.0) == pytest.approx((0.4, 0.2))
    assert covered_m(file, mesh={"height_m": 0.8}) == pytest.approx((0.4, 0.2))
    assert covered_m(file, mesh={"height_m": 0.8, "up": "y"}) == pytest.approx((3.2, 1.6))
    assert covered_m("hydrant", mesh={"height_m": 1.5}) == pytest.approx((0.96, 0.96))
    assert covered_m("ball", mesh={"height_m": 0.35}) == pytest.approx((0.35, 0.35))
    assert covered_m("panel", face={"size_m": 0.5}, scale=2.0) == pytest.approx((0.2, 1.0))
    assert covered_m("cube", face={"size_m": 0.5}) == pytest.approx((0.5, 0.5))


def test_five_objects_stand_clear_of_every_lane(experiment: Experiment) -> None:
    assert [thing.kind for thing in experiment.objects] == ["small_car"] * 2 + ["hydrant"] * 3
    for thing in experiment.objects:
        T = thing.T_world_from_object
        np.testing.assert_allclose(T[:3, 3], [thing.x_m, thing.y_m, CONFIG.road.kerb_height_m])
        corners = np.array(thing.corners_m())
        for share in np.linspace(0.0, 1.0, 30):
            edges = corners + share * (np.roll(corners, -1, axis=0) - corners)
            assert not any(CONFIG.on_road(*point) for point in edges)


@pytest.mark.parametrize(
    ("thing", "told"),
    [
        (hydrant_at(-10.0, -3.6), r"one reaches into a lane at \(-1\d\.\d\d, -3\.36\); move it"),
        (
            PlacedObject(name="one", kind="small_car", x_m=-12.0, y_m=-1.7, scale=2.0),
            "reaches into a lane",
        ),  # over its middle
        (PlacedObject(name="one", kind="small_car", x_m=-12.0, y_m=5.0, yaw_rad=1.57), "reaches into a lane"),
        (PlacedObject(name="one", kind="small_car", x_m=-12.0, y_m=5.0), None),
        (hydrant_at(-10.0, -3.8), None),
        (hydrant_at(-10.0, -3.8, 2.0), "reaches into a lane"),
    ],
)
def test_what_stands_in_a_lane_is_found(
    experiment: Experiment, thing: PlacedObject, told: str | None
) -> None:
    first = hydrant_at(9.0, 5.0)
    found = in_a_lane([first, thing], experiment.world)
    assert (found is None) == (told is None)
    # The asphalt itself says the same.
    corners = np.array(thing.corners_m())
    shares = np.linspace(0.0, 1.0, 200)[:, None, None]
    edges = (corners + shares * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2)
    assert any(CONFIG.on_road(*point) for point in edges) == (told is not None)
    if found is not None and told is not None:
        index, message = found
        assert index == 1
        with pytest.raises(ValueError, match=told):
            raise ValueError(message)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            "objects=[{name: one, kind: hydrant, x_m: 6, y_m: 8, yaw_rad: 180}]",
            r"yaw_rad: .*at most a turn of 6\.2832, got 180; .* is 3\.1416",
        ),
        ("attack.response={delay_s: 160}", r"delay_s: .*5"),
        ("over.seed=[-1]", "over.seed.*0"),
        ("deploy.starts=6", r"deploy\.starts to be at most measure\.starts = 5, .* got 6"),
    ],
)
def test_numbers_that_no_experiment_can_mean_are_refused_at_once(
    tmp_path: Path, change: str, told: str
) -> None:
    with pytest.raises(ValueError, match=told):
        load_experiment(LAUNCH, "full", [change], tmp_path)


def test_an_object_in_a_lane_is_told_with_its_line(tmp_path: Path) -> None:
    text = LAUNCH.read_text().replace("x_m: -3.95, y_m: -14.0", "x_m: -2.0, y_m: -14.0")
    file = tmp_path / "moved.experiment.yaml"
    file.write_text(text)
    line = 1 + next(number for number, each in enumerate(text.splitlines()) if "hydrant_south" in each)
    with pytest.raises(
        ValueError, match=rf"moved\.experiment\.yaml:{line}: .*hydrant_south reaches into a lane"
    ):
        load_experiment(file, "full", [], tmp_path / "run")


def test_objects_have_different_names_and_known_kinds(tmp_path: Path) -> None:
    twice = json.dumps([hydrant_at(9.0, 5.0).model_dump(), hydrant_at(-9.0, 5.0).model_dump()])
    with pytest.raises(ValueError, match="different names of objects, got one, one"):
        load_experiment(LAUNCH, "full", [f"objects={twice}"], tmp_path)
    with pytest.raises(ValidationError, match="small_car"):
        PlacedObject(name="one", kind="tree", x_m=0.0, y_m=0.0)  # type: ignore[arg-type]


def test_every_drive_sees_the_objects_large_enough(experiment: Experiment) -> None:
    """Share of the policy's view that the objects cover over the drive, hidden parts left out: at least 4 % on average."""
    view = experiment.view
    meshes = {"small_car": GENERATORS["car"](), "hydrant": GENERATORS["hydrant"]()}
    with experiment.open_world() as world:
        for name, path in experiment.references.items():
            poses = [path.pose_at(float(s)) for s in np.arange(0.0, 36.0, 3.0)]
            eyes = np.array([planar_pose(*pose) @ experiment.mount for pose in poses])
            frames = np.stack([world.observe_at(*pose)[1] for pose in poses])
            rows = slice(view.crop_top_px, view.crop_top_px + view.crop_height_px)
            covered = np.zeros((len(poses), view.crop_height_px, view.camera.width), dtype=bool)
            for thing in experiment.objects:
                T = invert_transform(thing.T_world_from_object) @ eyes
                T[:, :3, 3] /= thing.scale
                drawn = draw_mesh(meshes[thing.kind], T, view.camera, supersample=1)[..., 3] > 0.5
                nearest = (invert_transform(eyes) @ [thing.x_m, thing.y_m, 0.0, 1.0])[:, 2] - 2.0
                covered |= (drawn & (frames > nearest[:, None, None]))[:, rows]
            assert covered.mean() >= 0.04, name


def test_the_picture_from_above_shows_paths_and_objects(experiment: Experiment) -> None:
    with experiment.open_world() as world:
        picture = from_above(experiment, world)
        bare = world.overview()[0]  # type: ignore[attr-defined]
    for rgb in ((40, 110, 230), (235, 140, 20), (200, 40, 170), (240, 30, 30)):
        assert (np.abs(picture.astype(int) - rgb).max(axis=-1) < 12).sum() > 50
    assert not np.array_equal(picture, bare)


def test_a_world_without_a_view_from_above_has_no_such_picture(
    experiment: Experiment, wall: Intersection
) -> None:
    assert from_above(experiment, wall) is None
