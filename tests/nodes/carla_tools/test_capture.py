"""Photographs of a junction from the scripted server: a data set that our own reader takes, in the scene's frame."""

import json

import numpy as np
import pytest

from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import transform_points
from hardware.worlds import CarlaConfig, CarlaScene
from hardware.worlds.carla.config import JunctionConfig
from hardware.worlds.carla.errors import CarlaUnreachable
from hardware.worlds.carla.frames import SceneFrame
from hardware.worlds.carla.junction import find_drives
from hardware.worlds.carla.photos import photo_poses
from hardware.worlds.paths import ReferencePath
from nodes.lab.carla.capture import CaptureRequest, capture
from nodes.runtime.errors import ConfigError

REQUEST = CaptureRequest(photos=12, held_out=3, seed=4)


def run(library, settings, folder, request=REQUEST, **changes):
    return capture(
        CarlaConfig.model_validate({**settings, **changes}),
        request,
        folder,
        lambda share, text="": None,
        library,
    )


def test_images_and_poses_belong_together(library, settings, tmp_path):
    assert run(library, settings, tmp_path / "set") == (15, 0)
    frame = SceneFrame(**json.loads((tmp_path / "set" / "drives.json").read_text())["frame"])
    for name, count, size in (("photos", 12, (64, 36)), ("held_out", 3, (84, 46))):
        views = load_transforms(tmp_path / "set" / name, require_all=True).load()
        assert len(views.rgb) == count
        for rgb, T, pinhole in zip(views.rgb, views.T_world_from_camera, views.pinholes, strict=True):
            assert (pinhole.width, pinhole.height) == size
            d = pinhole.directions()
            down = -(d @ T[:3, :3].T)[..., 2]
            t = np.where(down > 0.03, T[2, 3] / np.maximum(down, 0.03), np.inf)
            near = t < 30.0
            points = transform_points(T, d * np.where(near, t, 0.0)[..., None])
            mirrored = transform_points(frame.T_mirrored_from_world, points) * [1.0, -1.0, 1.0]
            # JPEG at 95 % blurs colours a little; a pose that is wrong by a metre is wrong by two counts everywhere.
            error = np.abs(library.world.colour(mirrored)[..., :2] - rgb[..., :2].astype(float))[near]
            assert np.median(error) <= (2.0 if name == "photos" else 1.0)


def test_photographs_are_along_the_lanes_and_above(carla, TJunction):
    drives = find_drives(carla.Map("written", TJunction().text()), carla, JunctionConfig())
    T = np.array(photo_poses(drives, CarlaConfig(), 300, np.random.default_rng(1)))
    raised = T[:, 2, 3] > 2.5
    assert raised.sum() == 60
    assert (
        0.0 < np.median(np.degrees(np.arcsin(-T[~raised, 2, 2]))) < 16.0
    )  # about the driving camera's 8 degrees
    # Every camera is over the asphalt, or as far beside it as it is ahead of a car that has turned in its lane.
    x, y = T[:, 0, 3], T[:, 1, 3]
    assert (
        (np.abs(y) < 3.5 + 3.2)
        | ((y < 0.0) & (np.abs(x) < 3.5 + 3.2))
        | ((np.hypot(x, y) < 15.0) & (y < 0.0))
    ).all()
    for path in drives.paths.values():
        start = np.hypot(x - path.start_pose[0], y - path.start_pose[1])
        assert (start < 12.0).sum() > 5
    repeated = photo_poses(drives, CarlaConfig(), 30, np.random.default_rng(1))
    np.testing.assert_array_equal(repeated, T[:30])


def test_a_stopped_capture_goes_on_to_the_same_result(library, settings, tmp_path):
    run(library, settings, tmp_path / "whole")
    library.world.script = {library.world.ticks + 9: "hang"}
    with pytest.raises(CarlaUnreachable):
        run(library, settings, tmp_path / "set")
    assert not (tmp_path / "set" / "photos" / "transforms.json").exists()
    taken, there = run(library, settings, tmp_path / "set")
    assert there > 0
    assert taken + there == 15
    files = sorted(
        path.relative_to(tmp_path / "whole") for path in (tmp_path / "whole").rglob("*.*") if path.is_file()
    )
    for file in files:
        assert (tmp_path / "set" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


def test_another_capture_is_not_mixed_in(library, settings, tmp_path):
    run(library, settings, tmp_path / "set")
    with pytest.raises(ConfigError, match="holds a capture with other settings"):
        run(library, settings, tmp_path / "set", CaptureRequest(photos=12, held_out=3, seed=5))
    with pytest.raises(ConfigError, match="holds a capture with other settings"):
        run(library, settings, tmp_path / "set", render={"settle_ticks": 0, "weather": "WetNoon"})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty and holds no capture"):
        run(library, settings, tmp_path / "other")


def test_drives_are_written_as_plain_data(library, settings, tmp_path):
    run(library, settings, tmp_path / "set", CaptureRequest(photos=1, held_out=0))
    data = json.loads((tmp_path / "set" / "drives.json").read_text())
    with CarlaScene(CarlaConfig.model_validate(settings), library) as scene:
        assert json.loads(json.dumps(scene.drives.to_dict())) == data
    assert ReferencePath.from_dict(data["paths"]["left"]).goal == (0.0, 0.0, 1.0)
