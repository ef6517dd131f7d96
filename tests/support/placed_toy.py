"""A closed loop with movable objects, small enough for tests: a painted room, a face and a box, and a policy that is cheap to ask."""

import dataclasses

import torch

from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, PoseSpace
from advnerf_core.driving.path import Path
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.geometry import make_transform, rotation_z
from advnerf_core.scene.surrogate import Surrogate
from tests.support.attack_toy import MOUNT, VIEW, painted_room, toy_problem

SQUARE = Path.rounded_square(4.0, 1.1)
BOUNDS = PoseBounds(x_m=(2.6, 3.4), y_m=(-2.2, -1.2), yaw_rad=(2.7, 3.3), scale=(0.7, 1.1))


def box(x_m, y_m, yaw_rad=0.0, size_m=0.4):
    """A cube whose face looks along its heading; its footprint reaches ``size_m`` behind the face."""
    pose = make_transform(rotation_z(yaw_rad), [x_m, y_m, 0.3])
    return cube_face_object(size_m, 3, T_world_from_object=pose, depth_m=size_m, one_sided=False)


class Leaning(torch.nn.Module):
    """A smooth policy that is cheap to ask: it steers by a fixed pattern of the picture."""

    stateless = True

    def __init__(self):
        super().__init__()
        rows, columns = torch.meshgrid(torch.linspace(0, 5, 22), torch.linspace(0, 9, 66), indexing="ij")
        self.pattern = torch.stack([torch.sin(columns + k * rows) for k in (0.5, 1.0, 2.0)]) / 40.0

    def forward(self, images, goals=None):
        return 0.25 * torch.tanh((images.double() * self.pattern).sum((1, 2, 3)))


LENS = VIEW.resized(66, 22)


def moving(steps=3, free_colours=True, bounds=BOUNDS, objects=1, clearance_m=0.3, **options):
    problem = toy_problem(steps, resolution=12, policy=Leaning().eval(), **options)
    fields = [problem.sensor.objects[0], box(2.9, -0.4)][:objects]
    surrogate = Surrogate(painted_room, LENS, MOUNT, fields, dtype=torch.float64)
    each = [bounds, PoseBounds(x_m=(2.6, 3.1), y_m=(-0.9, 0.2))][:objects]
    space = PoseSpace(fields, each, KeepOut((SQUARE,), clearance_m))
    return dataclasses.replace(problem, sensor=PlacedSensor(surrogate, space, free_colours))
