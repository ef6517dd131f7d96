"""Attacks on meshes at the junction, over the frames of a scene in closed form."""

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from nodes.experiment.show.standing import DeployedFrames


@pytest.fixture(scope="module", autouse=True)
def mitsuba_works():
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


def quiet(fraction, text=""):
    pass


def test_deployed_frames_are_what_the_policy_sees_with_depth(trained, wall):
    frames = DeployedFrames(wall, trained.view)
    pose = planar_pose(-24.0, -1.75, 0.1) @ wall.T_car_from_camera
    rgb, depth_m = frames(pose[None], trained.view.pinhole)
    image, depth = wall.observe_at(-24.0, -1.75, 0.1)
    np.testing.assert_array_equal(np.round(255 * rgb[0]).astype(np.uint8), trained.view.image(image))
    # Depth is that of a ray of the policy's own camera, up to the pixels of the finer image.
    mean = cv2.resize(depth[trained.view.window], (200, 66), interpolation=cv2.INTER_AREA)
    flat = np.abs(depth_m[0] / mean - 1.0) < 0.05
    assert flat.mean() > 0.9
    with pytest.raises(ValueError, match="policy's view"):
        frames(pose[None], wall.camera_pinhole)
