"""From a request to everything a search needs, and from its result to the attack file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.artifact import (
    COLOURS,
    MESH_SHAPE,
    MESH_TEXTURE,
    AttackedObject,
    AttackFace,
    AttackFile,
    face_texture,
)
from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.methods import method_digest
from advnerf_core.attack.objectives import load_objective, objective_entry, objective_key
from advnerf_core.attack.on_device import said_of_device
from advnerf_core.attack.problem import Totals
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.search.search import draw_start_states
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.driving.dynamics import Ackermann, Dynamics
from advnerf_core.files import sha256_of
from advnerf_core.objects.mesh.glb import glb_bytes
from advnerf_core.objects.mesh.shape import ShapeSensor
from advnerf_core.objects.mesh.surface import TexturedMesh
from advnerf_core.policies.load import load_any_policy
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.scene.field import load_scene
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate, split_theta
from calibration.display_colour import DisplayCalibration
from calibration.schema import CameraCalibration, RoomCalibration, VehicleCalibration, load_calibration
from nodes.experiment.engine.artefact import Settings, hash_of
from nodes.experiment.node.meshes import found_meshes, shape_sensor
from nodes.experiment.node.objects import LoadedObject, place
from nodes.experiment.node.request import AttackRequest
from nodes.lab.policy_camera import require_camera
from nodes.runtime.errors import ConfigError

# Raised when what a search finds changes with the same request, or a default of requests does.
VERSION = 2  # 2: starts are drawn as those of experiments
# What a search does not depend on: where files lie, its name, length and memory, and what is an input of `request_hash`.
FREE: Mapping[str, Any] = {
    **dict.fromkeys(("name", "scene", "policy", "calibration", "camera", "vehicle", "room"), True),
    "search": {"evaluations", "cache_mib", "time_batch", "seeds", "together", "method", "objective"},
    "poses": {"attack", "landscape", "robustness"},
    "objects": {"__all__": {"file": True, "target": True, "display": True, "mesh": {"file"}}},
}


@dataclass(frozen=True, eq=False)
class Prepared:
    """An attack, ready to be searched for.

    Attributes:
        request: What was asked for.
        problem: What the searches take.
        surrogate: The learned scene with the objects, as the policy's camera sees it.
        policy: The victim with its view and hash.
        objects: The objects with what is known of them beyond their geometry.
        hashes: SHA-256 of scene, policy, objects and request (``config``); a search state carries their hash.
        seed: Seed of starts, search and disturbances.
    """

    request: AttackRequest
    problem: AttackProblem
    surrogate: Surrogate
    policy: LoadedPolicy
    objects: tuple[LoadedObject, ...]
    hashes: dict[str, str]
    seed: int

    @property
    def settings_hash(self) -> str:
        """Names everything that must not change between a search and its resumption."""
        return hash_of(self.hashes)

    def with_seed(self, seed: int) -> Prepared:
        """The same with another seed: other starts, other draws."""
        room = load_calibration(RoomCalibration, self.request.calibration_file("room"))
        starts = start_states(self.request, room, self.problem.dynamics, seed)
        problem = replace(
            self.problem, start_states=starts, disturbances=self.request.robustness.disturbances(seed)
        )
        return replace(self, problem=problem, seed=seed)

    @property
    def plain_theta(self) -> Tensor:
        """Parameters of the objects as they are without an attack."""
        if isinstance(self.problem.sensor, ShapeSensor):
            return torch.zeros(self.problem.sensor.theta_shape)
        return self.surrogate.plain_theta()

    @cached_property
    def clean_drive(self) -> CleanDrive:
        """The victim's drive past the plain objects, from the same starts in the same scene."""
        return clean_drive(self.problem, self.plain_theta)

    def make_attack_file(
        self,
        result: SearchResult,
        totals: Totals | None = None,
        clean: CleanDrive | None = None,
    ) -> AttackFile:
        """The attack file of a search's result; its predictions are the best evaluation's own unless others are given."""
        predicted, value = result.best.predicted_total_cte_m, result.best.value
        if totals is not None:
            predicted, value = float(totals.protocol_cte_m.mean()), float(totals.values.mean())
        objects = self.attacked_objects(result.theta)
        extra = {
            "name": self.request.name,
            "horizon": self.problem.steps,
            "evaluations": len(result.history),
            "start_states": self.problem.start_states[:, :3].tolist(),
            "objects_sha256": self.hashes["objects"],
            **objective_entry(self.request.search.objective, self.problem.objective, value),
        }
        if identity := self.policy.metadata.get("not_fixed"):
            extra["policy_not_fixed"] = identity
        if self.request.shape is not None:
            extra["shape"] = self.request.shape.model_dump(mode="json")
        return AttackFile(
            method=self.request.search.method_name,
            space=self._space,
            objects=objects,
            face=self._face(objects),
            camera=self.surrogate.camera,
            scene_sha256=self.hashes["scene"],
            policy_sha256=self.hashes["policy"],
            config_sha256=self.hashes["config"],
            seed=self.seed,
            predicted_total_cte_m=predicted,
            software_version=version("advnerf"),
            extra={**extra, **said_of_device()},
            clean_drive=clean or self.clean_drive,
        )

    def attacked_objects(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """All objects with their colours, or what their shapes were made of, as an attack file keeps them."""
        sensor = self.problem.sensor
        if isinstance(sensor, ShapeSensor):
            parts = list(theta.detach().split([len(each.mesh.vertices) for each in sensor.meshes]))
        else:
            parts = [part.detach() for part in split_theta(self.surrogate.objects, theta)]
        rows = zip(self.objects, parts, self.meshes(theta), strict=True)
        return tuple(
            AttackedObject(
                each.name,
                part.numpy().astype(np.float32),
                each.field.T_world_from_object,
                each.field.scale,
                each.sha256,
                b"" if mesh is None else glb_bytes(mesh),
            )
            for each, part, mesh in rows
        )

    def meshes(self, theta: Tensor) -> list[TexturedMesh | None]:
        """The meshes that were found; None for an object that is none."""
        return found_meshes(self.problem.sensor, self.surrogate.objects, theta)

    @property
    def _space(self) -> str:
        if isinstance(self.problem.sensor, ShapeSensor):
            return MESH_SHAPE
        return MESH_TEXTURE if all(wanted.mesh is not None for wanted in self.request.objects) else COLOURS

    def _face(self, objects: Sequence[AttackedObject]) -> AttackFace | None:
        """The first face that can be deployed; None if no object has one."""
        for number, (placed, found) in enumerate(zip(self.objects, objects, strict=True)):
            if (face := placed.face) is not None:
                texture = face_texture(found.theta)
                return AttackFace(texture, face.size_m, face.subject, face.corners_in_subject, number)
        return None


def prepare(request: AttackRequest, seed: int | None = None) -> Prepared:
    """Load scene, policy, calibration and objects of a request; ``seed`` is the first of the request if not given.

    Raises:
        AdvnerfError: A file is missing, damaged, or does not fit the others.
    """
    seed = request.search.seeds[0] if seed is None else seed
    loaded = load_any_policy(str(request.policy))
    camera = load_calibration(CameraCalibration, request.calibration_file("camera"))
    room = load_calibration(RoomCalibration, request.calibration_file("room"))
    require_camera(loaded.view, camera, str(request.policy), request.calibration_file("camera"))
    objects = tuple(place(wanted) for wanted in request.objects)
    surrogate = Surrogate(
        FieldRenderer.from_file(request.scene),
        loaded.view.pinhole,
        camera.mount,
        [each.field for each in objects],
        depth_tolerance_m=request.depth_tolerance_m,
    )
    dynamics = make_dynamics(request)
    hashes = {
        "scene": str(load_scene(request.scene)[2]["scene_hash"]),
        "policy": loaded.sha256,
        "objects": hash_of([each.sha256 for each in objects]),
        "config": request_hash(request),
    }
    problem = _problem(request, loaded, surrogate, dynamics, room, seed)
    return Prepared(request, problem, surrogate, loaded, objects, hashes, seed)


def request_hash(request: AttackRequest) -> str:
    """Hash of what a request asks for; not of where its files lie, nor of its name, length and memory."""
    search = request.search
    files = [request.calibration_file(name) for name in ("camera", "vehicle", "room")]
    files += [wanted.display for wanted in request.objects if wanted.display is not None]
    settings = Settings.of(
        request,
        None,
        FREE,
        version=VERSION,
        method=[search.method_name, method_digest(search.method)],
        objective=objective_key(search.objective),
        files=[sha256_of(file) for file in files],
    )
    return settings.key


def make_dynamics(request: AttackRequest) -> Dynamics:
    """The surrogate's car: as calibrated, behind the delay, lag and slew limit that were asked for."""
    vehicle = load_calibration(VehicleCalibration, request.calibration_file("vehicle"))
    limits = (vehicle.limits.steering_min_rad, vehicle.limits.steering_max_rad)
    wanted = request.dynamics
    if wanted.delay_s == wanted.lag_s == 0.0 and wanted.slew_radps is None:
        return Ackermann(vehicle.wheelbase_m, wanted.speed_mps, wanted.dt_s, limits)
    return ActuatedAckermann(
        vehicle.wheelbase_m,
        wanted.speed_mps,
        wanted.dt_s,
        wanted.delay_s,
        wanted.lag_s,
        wanted.slew_radps,
        limits,
    )


def start_states(request: AttackRequest, room: RoomCalibration, dynamics: Dynamics, seed: int) -> Tensor:
    """Start states ``[B, n]`` of one seed."""
    starts = request.starts
    if starts.poses:
        poses = torch.tensor(starts.poses, dtype=torch.float64)
    else:
        nominal, first = starts.nominal or room.start_pose, seed == 0 or starts.nominal_start
        poses = draw_start_states(nominal, starts.count, starts.sigma, seed, nominal_first=first)
    # Drives of one start pose differ by what is drawn in them.
    poses = poses.repeat_interleave(request.robustness.repeats, dim=0)
    return torch.nn.functional.pad(poses, (0, dynamics.state_size - 3))


def _problem(
    request: AttackRequest,
    loaded: LoadedPolicy,
    surrogate: Surrogate,
    dynamics: Dynamics,
    room: RoomCalibration,
    seed: int,
) -> AttackProblem:
    starts, search = start_states(request, room, dynamics, seed), request.search
    return AttackProblem(
        loaded.policy,
        sensor_of(request, surrogate),
        dynamics,
        room.reference_path,
        starts,
        request.horizon,
        goals=_goals(request, loaded, len(starts)),
        time_batch=search.time_batch,
        cache_bytes=int(search.cache_mib * 2**20),
        fence_m=float(np.abs(np.array(room.fence_m)).min()),
        off_track_m=room.off_track_m,
        disturbances=request.robustness.disturbances(seed),
        regulariser=request.robustness.regulariser(surrogate.objects),
        objective=load_objective(search.objective),
    )


def sensor_of(request: AttackRequest, surrogate: Surrogate) -> Surrogate | DisplayedSensor | ShapeSensor:
    """The surrogate: seen through the monitor's colours where a monitor shows the face; with free shapes where these are attacked."""
    if request.shape is not None:
        return shape_sensor(surrogate, request.shape)
    wanted = request.objects[0]
    if wanted.display is None:
        return surrogate
    return DisplayedSensor(
        surrogate, load_calibration(DisplayCalibration, wanted.display).display, wanted.display_cos
    )


def _goals(request: AttackRequest, loaded: LoadedPolicy, starts: int) -> Tensor | None:
    wanted = loaded.policy.goal_size
    if any(len(goal) != wanted for goal in request.goals) or bool(wanted) != bool(request.goals):
        lengths = [len(goal) for goal in request.goals]
        raise ConfigError(
            f"goals: expected vectors of length {wanted} for this policy (0: none), got lengths {lengths}"
        )
    if not request.goals:
        return None
    goals = torch.tensor(request.goals, dtype=torch.float32)
    return goals.repeat_interleave(starts // len(goals), dim=0)
