"""The search spaces of an experiment, its objects or a face on a panel, and their presentation in the deployment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.search.poses import MultiStart
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds
from advnerf_core.attack.spaces.places import PlaceLimits, PlaceSpace, randomly_placed
from advnerf_core.attack.spaces.space import ColourSpace, NamedObject, ShapeSpace, Shown, Space, colours_of
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.shape import ShapeLimits
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.scene.remembered import frame_bytes
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.world import World
from nodes.experiment.plan.object_kinds import MADE_HERE_M, PANEL
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
from nodes.experiment.show.light import light_on_panels
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import (
    object_file,
    panel_object,
    placed_objects,
    surface_of,
    surrogate_of,
)
from nodes.experiment.show.own_scene import display_of, mount_of, own_objects
from nodes.experiment.show.standing import DeployedFrames
from nodes.lab.located import content_sha256
from nodes.lab.worlds.expert_drive import as_path
from nodes.runtime.errors import ConfigError


def colour_space(experiment: Experiment, surrogate: Surrogate | None = None) -> ColourSpace:
    """The colours of the objects, in the learned scene; ``surrogate`` if it is made already."""
    behind, named = surrogate or _surrogate(experiment), named_objects(experiment)
    if experiment.given_scene is None:
        return ColourSpace(behind, named, light_on_panels(experiment))
    light, cos_angle = display_of(experiment)
    return ColourSpace(behind, named, light, cos_angle, mount_of(experiment))


def make_space(experiment: Experiment, scene: World | None) -> Space:
    """The space of the experiment's section ``space``; the open deployment scene is needed if `over_the_world`.

    The experiment's scene and objects must exist, except for meshes over the world's own pictures.
    """
    wanted = experiment.config.space
    if has_face(experiment):
        return face_space(experiment)
    if isinstance(wanted, PlacesConfig):
        return _place_space(experiment, wanted)
    if over_the_world(experiment):
        assert scene is not None, "meshes are searched over the pictures of an open scene"
        surrogate, named = _over_pictures(experiment, scene)
    else:
        surrogate, named = _surrogate(experiment), named_objects(experiment)
    if isinstance(wanted, ColoursConfig):
        return colour_space(experiment, surrogate)
    if isinstance(wanted, MeshTextureConfig):
        return ColourSpace(surrogate, named)
    limits = ShapeLimits(wanted.bound_m, wanted.smoothness, wanted.samples, wanted.boundary_samples)
    return ShapeSpace(surrogate, named, limits)


def _over_pictures(experiment: Experiment, scene: World) -> tuple[Surrogate, list[NamedObject]]:
    """The objects as meshes over the pictures of an open scene."""
    wanted = experiment.config.space
    assert isinstance(wanted, (MeshTextureConfig, MeshShapeConfig)), "others are searched in a learned scene"
    fields, frames = mesh_objects(experiment, wanted), DeployedFrames(scene, experiment.view)
    surrogate = Surrogate(frames, experiment.view.pinhole, experiment.mount, fields, depth_tolerance_m=0.0)
    things = zip(experiment.objects, fields, strict=True)
    return surrogate, [NamedObject(thing.name, field.sha256) for thing, field in things]


def _surrogate(experiment: Experiment) -> Surrogate:
    """The objects in the learned scene."""
    if experiment.given_scene is not None:
        return surrogate_of(experiment, [each.field for each in own_objects(experiment)])
    return surrogate_of(experiment, placed_objects(experiment))


def dress(experiment: Experiment, scene: World, shown: Shown) -> Dressed:
    """An open deployment scene with the attacked objects; see `shown_there` for its colours."""
    if has_face(experiment):
        return PaintedScene(experiment, scene)
    return stand_in(experiment, scene, shown.objects, experiment.config.carrier.kind == "native")


def shown_there(experiment: Experiment, shown: Shown, attack: AttackFile | None) -> Tensor | None:
    """Parameters for an attacked deployment scene: colours of objects; for a face the displayed colours, which a screen changes, or None.

    A composed object gets the seen colours; an object in the world's own light gets the painted ones.
    """
    if attack is None or attack.face is None:
        native = experiment.config.carrier.kind == "native" and shown.painted is not None
        return (shown.painted if native else shown.colours) if shown.objects else None
    return torch.from_numpy(np.array(attack.face_object.theta))


def over_the_world(experiment: Experiment) -> bool:
    """Whether attacks are searched over the world's own pictures, as for meshes, without a learned scene."""
    of_meshes = isinstance(experiment.config.space, (MeshTextureConfig, MeshShapeConfig))
    return of_meshes and experiment.given_scene is None


def mesh_objects(experiment: Experiment, wanted: MeshTextureConfig | MeshShapeConfig) -> list[MeshField]:
    """The experiment's objects as meshes, in their plain colours and shapes."""
    found = []
    for thing in experiment.objects:
        mesh = surface_of(thing.kind) if wanted.ball_m is None else sphere(wanted.ball_m, wanted.ball_rgb)
        found.append(MeshField(unwrapped(mesh, wanted.texels), thing.T_world_from_object, thing.scale))
    return found


def place_limits(experiment: Experiment, wanted: PlacesConfig) -> PlaceLimits:
    """Where each object may stand: within its own bounds, or about its place in the configuration, at its size; in no lane."""
    bounds, lanes = bounds_of(experiment.objects, wanted), lanes_of(experiment, wanted.keep_out_m)
    return PlaceLimits(bounds, lanes, wanted.colours, edge_width=wanted.edge_width)


def bounds_of(things: Sequence[PlacedObject], wanted: PlacesConfig) -> list[PoseBounds]:
    """Bounds of each object: its own, or about its place in the configuration."""
    found = []
    for thing in things:
        if thing.bounds is not None:
            found.append(PoseBounds(**thing.bounds.model_dump()))
            continue
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


def lanes_of(experiment: Experiment, clearance_m: float | None = None) -> KeepOut:
    """All lanes, driven or not, and how far from their middles objects stay; half a lane by default."""
    lanes, world = tuple(as_path(lane) for lane in experiment.world.lanes), experiment.world
    return KeepOut(lanes, world.off_track_m if clearance_m is None else clearance_m)


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
    return content_sha256(object_file(experiment, kind))


def named_objects(experiment: Experiment) -> list[NamedObject]:
    """Descriptions of the objects in the learned scene for attack files."""
    if experiment.given_scene is not None:
        return [each.named for each in own_objects(experiment)]
    return [NamedObject(thing.name, geometry_sha256(experiment, thing.kind)) for thing in experiment.objects]


def _place_space(experiment: Experiment, wanted: PlacesConfig) -> PlaceSpace:
    surrogate, attack = _surrogate(experiment), experiment.config.attack
    # The gradient comes from the frames of the drive: their background is not rendered a second time.
    one_evaluation = experiment.config.horizon * attack.starts * frame_bytes(surrogate.camera)
    remembering = surrogate.remembering(min(one_evaluation, int(attack.cache_mib * 2**20)))
    budget = MultiStart(wanted.samples, wanted.steps, wanted.pose_rate, wanted.colour_rate)
    limits = place_limits(experiment, wanted)
    if wanted.coloured_by is not None:
        limits = replace(limits, kept_colours=_colours_in(wanted.coloured_by, surrogate))
    mount = None if experiment.given_scene is None else mount_of(experiment)
    return PlaceSpace(remembering, named_objects(experiment), limits, budget, mount)


def _colours_in(file: Path, surrogate: Surrogate) -> Tensor:
    """Colours that an attack file holds of the same objects, wherever they stand there.

    Raises:
        AttackFileError: The file is not an attack file.
        ConfigError: The file has other objects.
    """
    attack = load_attack(file)
    shapes = [each.theta.shape for each in attack.objects]
    expected = [tuple(field.theta_shape) for field in surrogate.objects]
    if shapes != expected:
        raise ConfigError(
            f"{file}: expected colours of shapes {expected} for the objects of the experiment, got {shapes}"
        )
    return colours_of(attack, torch.float64).reshape(surrogate.theta_shape)
