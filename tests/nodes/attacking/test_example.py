"""The request that is shipped says what the experiment does."""

import pathlib

import numpy as np

from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, PoseSpace
from advnerf_core.driving.path import Path
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import GENERATORS
from hardware.worlds.lab.config import LabConfig
from nodes.experiment.node.request import load_request
from nodes.experiment.show.faces import FACE_OFFSET_M

EXAMPLE = pathlib.Path(__file__).parents[3] / "launch" / "corner.attack.yaml"


def test_the_shipped_request_attacks_the_board_where_it_stands():
    request = load_request(EXAMPLE, [])
    assert (request.horizon, request.search.method) == (40, "gradient")
    (face,) = request.objects
    in_front = LabConfig().board.T_world_from_face.copy()
    in_front[:3, 3] += FACE_OFFSET_M * in_front[:3, 0]
    np.testing.assert_allclose(face.pose, in_front, atol=2e-4)


def test_the_shipped_poses_leave_the_hydrant_room_beside_the_lane():
    request = load_request(EXAMPLE.with_name("hydrant_poses.attack.yaml"), [])
    assert request.poses is not None
    assert request.poses.evaluations == 50
    (wanted,), (bounds,) = request.objects, request.poses.bounds
    mesh = build_from_mesh(GENERATORS["hydrant"](), "hydrant", 16, steps=0)
    limits = [PoseBounds(bounds.x_m, bounds.y_m, bounds.yaw_rad, bounds.scale)]
    lane = KeepOut((Path.rounded_square(4.0, 1.1),), request.poses.keep_out_m)
    space = PoseSpace([mesh.placed(wanted.pose)], limits, lane)
    assert space.allows(space.unit(space.nominal))
