"""Where a junction of CARLA's is photographed from."""

import numpy as np

from hardware.worlds import CarlaConfig, CarlaScene


def test_photographs_are_along_the_lanes_and_above(library, settings):
    with CarlaScene(CarlaConfig.model_validate(settings), library) as scene:
        drives, photo_poses = scene.drives, scene.photo_poses
        T = np.array(photo_poses(300, np.random.default_rng(1)))
        repeated = photo_poses(30, np.random.default_rng(1))
    raised = T[:, 2, 3] > 2.2
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
    np.testing.assert_array_equal(repeated, T[:30])
