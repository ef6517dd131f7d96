"""The requests that are shipped say what the experiment does."""

import pathlib
import shutil

import numpy as np
import pytest

from advnerf_core.attack.spaces.placement import PoseSpace
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.model import save_object
from hardware.worlds.lab.config import LabConfig
from nodes.experiment.node.prepare import load_request
from nodes.experiment.show.faces import FACE_OFFSET_M
from nodes.experiment.show.spaces import place_limits
from tests.support.tiny_request import CALIBRATION, tiny_request

LAUNCH = pathlib.Path(__file__).parents[3] / "launch"


@pytest.fixture
def shipped(tmp_path):
    """What the requests name: as `make demo` and `advnerf scene object build` leave it, with a tiny scene and policy."""
    demo, tiny = tmp_path / "runs" / "demo", tiny_request(tmp_path / "tiny").parent
    for name in ("scene", "policy"):
        (demo / name).mkdir(parents=True)
        shutil.copy(tiny / f"{name}.safetensors", demo / name)
    shutil.copytree(CALIBRATION, demo / "capture" / "calibration")
    mesh = build_from_mesh(GENERATORS["hydrant"](), "hydrant", 16, steps=0)
    save_object(tmp_path / "runs" / "hydrant.object.safetensors", mesh)
    (tmp_path / "launch").mkdir()

    def read(name):
        shutil.copy(LAUNCH / name, tmp_path / "launch")
        return load_request(tmp_path / "launch" / name, folder=tmp_path / "run")

    return read


def test_the_shipped_request_attacks_the_board_where_it_stands(shipped):
    request = shipped("corner.experiment.yaml")
    assert (request.config.horizon, request.config.methods) == (40, ("gradient",))
    (face,) = request.objects
    in_front = LabConfig().board.T_world_from_face.copy()
    in_front[:3, 3] += FACE_OFFSET_M * in_front[:3, 0]
    np.testing.assert_allclose(face.T_world_from_face, in_front, atol=2e-4)


def test_the_shipped_poses_leave_the_hydrant_room_beside_the_lane(shipped):
    request = shipped("hydrant_poses.experiment.yaml")
    assert request.config.space.evaluations == 50
    (thing,), limits = request.objects, place_limits(request, request.config.space)
    mesh = build_from_mesh(GENERATORS["hydrant"](), "hydrant", 16, steps=0)
    space = PoseSpace([mesh.placed(thing.T_world_from_object)], limits.bounds, limits.keep_out)
    assert limits.keep_out.clearance_m == 0.35
    assert space.allows(space.unit(space.nominal))
