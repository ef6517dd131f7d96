"""The search spaces of an experiment, its objects or a face on a panel, and their presentation in the deployment."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.attack.search.poses import MultiStart
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds
from advnerf_core.attack.spaces.places import PlaceLimits, PlaceSpace, randomly_placed
from advnerf_core.attack.spaces.space import ColourSpace, NamedObject, ShapeSpace, Shown, Space
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import sha256_of
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.shape import ShapeLimits
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.scene.remembered import frame_bytes
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.world import World
from nodes.experiment.plan.object_kinds import MADE_HERE_M, PANEL, is_mesh, load_mesh_of
from nodes.experiment.plan.placed import PlacedObject
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
)
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.faces import PaintedScene, face_space, has_face
from nodes.experiment.show.frames import DeployedFrames
from nodes.experiment.show.light import light_on_panels
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import (
    GENERATOR_OF,
    object_file,
    panel_object,
    placed_objects,
    surrogate_of,
)
from nodes.lab.worlds.expert_drive import as_path


def colour_space(experiment: Experiment, surrogate: Surrogate | None = None) -> ColourSpace:
    """The colours of the voxel objects, in the learned scene; ``surrogate`` if it is made already."""
    behind = surrogate or surrogate_of(experiment, placed_objects(experiment))
    return ColourSpace(behind, _named_voxels(experiment), light_on_panels(experiment))


def make_space(experiment: Experiment, scene: World | None) -> Space:
    """The space of the experiment's section ``space``.

    Args:
        experiment: Its scene and objects must be there, for meshes nothing.
        scene: The open deployment scene; needed where `over_the_world`.
    """
    wanted = experiment.config.space
    if has_face(experiment):
        return face_space(experiment)
    if isinstance(wanted, ColoursConfig):
        return colour_space(experiment)
    if isinstance(wanted, PlacesConfig):
        return _place_space(experiment, wanted)
    assert scene is not None, "meshes are searched over the pictures of an open scene"
    fields = mesh_objects(experiment, wanted)
    frames = DeployedFrames(scene, experiment.view)
    surrogate = Surrogate(frames, experiment.view.pinhole, experiment.mount, fields, depth_tolerance_m=0.0)
    named = [
        NamedObject(thing.name, field.sha256) for thing, field in zip(experiment.objects, fields, strict=True)
    ]
    if isinstance(wanted, MeshTextureConfig):
        return ColourSpace(surrogate, named)
    limits = ShapeLimits(wanted.bound_m, wanted.smoothness, wanted.samples, wanted.boundary_samples)
    return ShapeSpace(surrogate, named, limits)


def dress(experiment: Experiment, scene: World, shown: Shown) -> Dressed:
    """An open deployment scene with the attacked objects; see `shown_there` for its colours."""
    if has_face(experiment):
        return PaintedScene(experiment, scene)
    return stand_in(experiment.view, scene, shown.objects, experiment.config.carrier.kind == "native")


def shown_there(experiment: Experiment, shown: Shown, attack: AttackFile | None) -> Tensor | None:
    """Parameters for an attacked deployment scene: colours of objects; for a face the displayed colours, which a screen changes, or None.

    A composed object gets the seen colours; an object in the world's own light gets the painted ones.
    """
    if attack is None or attack.face is None:
        native = experiment.config.carrier.kind == "native" and shown.painted is not None
        return (shown.painted if native else shown.colours) if shown.objects else None
    return torch.from_numpy(np.array(attack.face_object.theta))


def over_the_world(experiment: Experiment) -> bool:
    """Whether attacks are searched over the world's own pictures, as those on meshes: nothing is learned for them."""
    return isinstance(experiment.config.space, (MeshTextureConfig, MeshShapeConfig))


def mesh_objects(experiment: Experiment, wanted: MeshTextureConfig | MeshShapeConfig) -> list[MeshField]:
    """The experiment's objects as meshes, in their plain colours and shapes."""
    found = []
    for thing in experiment.objects:
        if wanted.ball_m is None:
            mesh = (
                load_mesh_of(thing.kind)
                if is_mesh(thing.kind)
                else stand(GENERATORS[GENERATOR_OF[thing.kind]]())
            )
        else:
            mesh = sphere(wanted.ball_m, wanted.ball_rgb)
        found.append(MeshField(unwrapped(mesh, wanted.texels), thing.T_world_from_object, thing.scale))
    return found


def place_limits(experiment: Experiment, wanted: PlacesConfig) -> PlaceLimits:
    """Where each object may stand: about its place in the configuration, at its size, in no lane."""
    return PlaceLimits(bounds_of(experiment.objects, wanted), lanes_of(experiment), wanted.colours)


def bounds_of(things: Sequence[PlacedObject], wanted: PlacesConfig) -> list[PoseBounds]:
    """Bounds of each object about its place in the configuration."""
    found = []
    for thing in things:
        turn_rad = np.pi if thing.kind == "hydrant" else wanted.turn_rad
        x, y, yaw = (
            (at - reach, at + reach)
            for at, reach in (
                (thing.x_m, wanted.move_m),
                (thing.y_m, wanted.move_m),
                (thing.yaw_rad, turn_rad),
            )
        )
        found.append(PoseBounds(x_m=x, y_m=y, yaw_rad=yaw))
    return found


def lanes_of(experiment: Experiment) -> KeepOut:
    """All lanes, driven or not: objects stand at the height of the pavement."""
    return KeepOut(tuple(as_path(lane) for lane in experiment.world.lanes), experiment.world.off_track_m)


def random_placements(experiment: Experiment, count: int, seed: int) -> list[tuple[VoxelGridObject, ...]]:
    """The objects at random allowed places, ``count`` times."""
    if not count:
        return []
    return randomly_placed(
        placed_objects(experiment), place_limits(experiment, PlacesConfig(kind="places")), count, seed
    )


def geometry_sha256(experiment: Experiment, kind: str) -> str:
    """Hash of the object file of a kind; for a panel, the hash of the panel at scale 1."""
    if kind == PANEL:
        return panel_object(experiment, MADE_HERE_M[PANEL][1]).sha256
    path = object_file(experiment, kind)
    return _file_sha256(path, path.stat().st_mtime_ns)


def _place_space(experiment: Experiment, wanted: PlacesConfig) -> PlaceSpace:
    surrogate, attack = surrogate_of(experiment, placed_objects(experiment)), experiment.config.attack
    # The gradient is that of the frames that were driven past: the scene in them is not rendered a second time.
    one_evaluation = experiment.config.horizon * attack.starts * frame_bytes(surrogate.camera)
    remembering = surrogate.remembering(min(one_evaluation, int(attack.cache_mib * 2**20)))
    budget = MultiStart(wanted.samples, wanted.steps, colour_rate=wanted.colour_rate)
    return PlaceSpace(remembering, _named_voxels(experiment), place_limits(experiment, wanted), budget)


def _named_voxels(experiment: Experiment) -> list[NamedObject]:
    return [NamedObject(thing.name, geometry_sha256(experiment, thing.kind)) for thing in experiment.objects]


@lru_cache(maxsize=8)
def _file_sha256(path: Path, changed_ns: int) -> str:
    del changed_ns  # part of the cache's key
    return sha256_of(path)
