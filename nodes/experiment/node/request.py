"""The request for an attack: a ``*.attack.yaml`` file, or the same text in a message, strict in what it accepts.

Paths are relative to the file. Everything has a default except the scene, the policy and where the camera, the car and the room
were calibrated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from advnerf_core.attack.methods import METHODS, alternatives
from advnerf_core.documents import Document, dump_yaml, parse_yaml, read_yaml
from advnerf_core.geometry import Array, make_transform, rotation_z
from advnerf_core.places import expanded
from advnerf_core.plugins import name_in_results
from advnerf_core.policies.load import is_factory
from advnerf_core.strict import StrictModel, validate
from nodes.experiment.node.mesh_request import MeshRequest, ShapeRequest
from nodes.experiment.node.pose_request import PosesRequest
from nodes.experiment.plan.method_names import MethodReference
from nodes.experiment.plan.robustness_config import RobustnessConfig
from nodes.experiment.plan.search_config import SearchBudget
from nodes.runtime.config import apply_overrides

Count = Annotated[int, Field(ge=1)]
NotNegative = Annotated[float, Field(ge=0)]
AboveZero = Annotated[float, Field(gt=0)]
Row = tuple[float, float, float, float]
Unit = Annotated[float, Field(ge=0, le=1)]
_RIGID_TOLERANCE = 1e-6
SHAPE_METHODS = alternatives(name for name, row in METHODS.items() if row.reads_scale)


class ObjectRequest(StrictModel):
    """One object: where it is, and which of its colours are free.

    A ``face`` is a thin slab seen from its front only, as a projected or displayed texture is; a ``cube`` has one textured face
    and plain sides; a ``file`` is what ``advnerf scene object build`` wrote; a ``mesh`` is a textured surface as it is. The frame of a face or cube has its origin in the middle of
    the textured face, x out of it, z up.
    """

    kind: Literal["face", "cube", "file", "mesh"] = "face"
    file: Path | None = Field(default=None, description="Object file; with kind 'file' only.")
    mesh: MeshRequest | None = Field(default=None, description="The mesh; with kind 'mesh' only.")
    T_world_from_object: tuple[Row, Row, Row, Row] | None = Field(
        default=None, description="Rigid pose, four rows."
    )
    x_m: float | None = Field(default=None, description="Position, instead of T_world_from_object [m].")
    y_m: float | None = None
    z_m: float | None = None
    yaw_rad: float | None = Field(default=None, description="Heading of the object's x axis [rad].")
    scale: AboveZero = Field(default=1.0, description="World metres per object unit.")
    size_m: AboveZero = Field(default=0.8, description="Edge of a face or cube, before scaling [m].")
    resolution: Annotated[int, Field(ge=2, le=128)] = Field(
        default=64, description="Cells along an edge of the face."
    )
    plain_rgb: tuple[Unit, Unit, Unit] = Field(
        default=(0.2, 0.62, 0.28), description="Colour of what is not attacked."
    )
    free: Literal["all", "face"] = Field(
        default="all",
        description="Which colours of an object file may change: all, or those on its deployed face.",
    )
    levels: Annotated[int, Field(ge=0, le=32)] = Field(
        default=0,
        description="Summed grids, coarse to fine, that give an object file's colours; 0: one value per voxel.",
    )
    target: Path | None = Field(
        default=None,
        description="Calibration file of the face that shows the attack: its subject and its corners.",
    )
    display: Path | None = Field(
        default=None,
        description="What 'advnerf car calibrate display' wrote, where a monitor shows the face: its colours are in the loop.",
    )
    display_cos: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0,
        description="Cosine of the angle at which the camera looks at the monitor, in the mean of a drive.",
    )
    subject: str = Field(
        default="board", min_length=1, description="Motion-capture subject, where no target is given."
    )

    @model_validator(mode="after")
    def _consistent(self) -> ObjectRequest:
        if self.levels and self.kind != "file":
            raise ValueError("expected levels with kind 'file' only: a face has one flat grid of colours")
        if (self.kind == "file") != (self.file is not None):
            raise ValueError("expected a file exactly with kind 'file'")
        if (self.kind == "mesh") != (self.mesh is not None):
            raise ValueError("expected the key mesh exactly with kind 'mesh'")
        if self.kind == "mesh" and (self.free == "face" or self.target is not None):
            raise ValueError(
                "expected neither free: face nor a target with a mesh: it has no face that could be displayed"
            )
        place = (self.x_m, self.y_m, self.z_m)
        if self.T_world_from_object is None and None in place:
            raise ValueError("expected either T_world_from_object or x_m, y_m and z_m (and yaw_rad)")
        if self.T_world_from_object is not None and (place != (None, None, None) or self.yaw_rad is not None):
            raise ValueError("expected T_world_from_object or x_m, y_m, z_m, yaw_rad, not both")
        return self

    @field_validator("T_world_from_object")
    @classmethod
    def _rigid(cls, rows: tuple[Row, ...] | None) -> tuple[Row, ...] | None:
        if rows is not None:
            T = np.array(rows)
            error = max(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max(), np.abs(T[3] - [0, 0, 0, 1]).max())
            if error > _RIGID_TOLERANCE or np.linalg.det(T[:3, :3]) < 0:
                raise ValueError(
                    f"expected a rotation and a translation with last row 0 0 0 1, is off by {error:.1e}"
                )
        return rows

    @property
    def pose(self) -> Array:
        """``T_world_from_object`` ``[4, 4]``."""
        if self.T_world_from_object is not None:
            return np.array(self.T_world_from_object)
        return make_transform(
            rotation_z(self.yaw_rad or 0.0), [self.x_m or 0.0, self.y_m or 0.0, self.z_m or 0.0]
        )


class StartsRequest(StrictModel):
    """Start poses optimised together: listed, or drawn around a nominal one."""

    poses: tuple[tuple[float, float, float], ...] = Field(
        default=(), description="x [m], y [m], yaw [rad] of each; if given, nothing is drawn."
    )
    nominal: tuple[float, float, float] | None = Field(
        default=None, description="x [m], y [m], yaw [rad]; the room's own start if it is not given."
    )
    count: Count = Field(default=1, description="How many are drawn; the first of seed 0 is the nominal one.")
    nominal_start: bool = Field(
        default=False, description="The first start of every seed is the nominal one, not of seed 0 alone."
    )
    sigma: NotNegative = Field(
        default=0.1, description="Spread of starts [m and rad]; headings a quarter of it."
    )


class DynamicsRequest(StrictModel):
    """What the surrogate's car is like beyond its calibration."""

    speed_mps: AboveZero = Field(default=0.8, description="Driving speed [m/s].")
    dt_s: AboveZero = Field(default=0.1, description="Control period [s].")
    delay_s: NotNegative = Field(
        default=0.0, description="From image to wheels, fractions of a period allowed [s]."
    )
    lag_s: NotNegative = Field(default=0.0, description="Time constant of the steering [s].")
    slew_radps: AboveZero | None = Field(default=None, description="Limit of the wheels' rate [rad/s].")


class SearchRequest(SearchBudget):
    """The adversary and its budget."""

    method: MethodReference = Field(
        default="gradient",
        description="A method of attack: built in, of an installed package, or file.py:Name, relative to this file.",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="What the method alone knows.")
    learning_rate: AboveZero | None = Field(
        default=None,
        description="Of Adam: 0.1 for gradient, gradient_coarse, frame and distilled, 0.3 for guided, 0.5 for evolution, if not given.",
    )
    sigma: AboveZero | None = Field(
        default=None,
        description="Spread of theta: 5 for random and its families, 3 to begin with for cem, 1 for evolution, if not given.",
    )
    cells: Annotated[int, Field(ge=0)] = Field(
        default=8,
        description="Cells along an edge of coarse textures (cem, evolution, guided, gradient_coarse, random_coarse); 0 for the face's own.",
    )
    probes: Count | None = Field(
        default=None,
        description="Pairs of textures asked about after each drive: 3 for guided, 1 for distilled.",
    )
    warm_pairs: Count | None = Field(
        default=None, description="Pairs of the first lesson of distilled and guided; 300 if not given."
    )
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1, description="One attack for each.")
    together: bool = Field(
        default=False, description="Gradient: search all seeds in one batch, not one after the other."
    )

    @property
    def method_name(self) -> str:
        """What the method is called in tables and attack files."""
        return name_in_results(self.method)


class AttackRequest(StrictModel):
    """One attack, resolved; see the sections for their values."""

    name: str = Field(default="attack", min_length=1)
    scene: Path = Field(description="Checkpoint of a trained scene.")
    policy: Path = Field(description="Policy file, or package.module:factory.")
    calibration: Path | None = Field(
        default=None, description="Folder with camera.yaml, vehicle.yaml and room.yaml."
    )
    camera: Path | None = Field(default=None, description="Camera calibration, instead of the folder's.")
    vehicle: Path | None = Field(default=None, description="Vehicle calibration, instead of the folder's.")
    room: Path | None = Field(default=None, description="Room calibration, instead of the folder's.")
    objects: tuple[ObjectRequest, ...] = Field(min_length=1, description="What carries the attack.")
    starts: StartsRequest = StartsRequest()
    goals: tuple[tuple[float, ...], ...] = Field(
        default=(),
        description="Goal vectors: one for all starts, or one for each listed start; none without goals.",
    )
    horizon: Count = Field(default=60, description="Control ticks that are optimised (T).")
    depth_tolerance_m: NotNegative = Field(
        default=0.15,
        description="An object is hidden only by a surface nearer than this much in front of it [m].",
    )
    dynamics: DynamicsRequest = DynamicsRequest()
    search: SearchRequest = SearchRequest()
    robustness: RobustnessConfig = RobustnessConfig()
    poses: PosesRequest | None = Field(
        default=None, description="Where objects may stand; 'advnerf attack poses'."
    )
    shape: ShapeRequest | None = Field(
        default=None, description="Attack the shapes of meshes, not their colours."
    )

    @model_validator(mode="after")
    def _complete(self) -> AttackRequest:
        missing = [name for name in ("camera", "vehicle", "room") if getattr(self, name) is None]
        if (
            built_in := METHODS.get(self.search.method)
        ) is not None:  # others are looked at when they are loaded
            built_in.options(self.search.options, "search.options")
        if self.search.together and self.search.method != "gradient":
            raise ValueError(
                f"search.together is for the gradient method only, got method {self.search.method}"
            )
        one_face = len(self.objects) == 1 and self.objects[0].kind in ("face", "cube")
        if any(wanted.display is not None for wanted in self.objects) and (
            not one_face or self.search.together
        ):
            raise ValueError(
                "display: expected one object, a face or cube, and seeds searched one after the other"
            )
        if self.calibration is None and missing:
            raise ValueError(f"expected a calibration folder, or files for {', '.join(missing)}")
        if self.poses is not None and len(self.poses.bounds) != len(self.objects):
            raise ValueError(
                f"poses: expected bounds of {len(self.objects)} object(s), got {len(self.poses.bounds)}"
            )
        meshes = [wanted.kind == "mesh" for wanted in self.objects]
        if self.poses is not None and any(meshes):
            raise ValueError(
                "poses: expected objects made of voxels, got a mesh; 'advnerf scene object build' makes voxels of it"
            )
        if self.shape is not None:
            if not all(meshes):
                raise ValueError("shape: expected objects of kind 'mesh' only")
            of_colours = built_in is not None and not built_in.reads_scale
            if of_colours or self.search.together or self.robustness.smoothness:
                raise ValueError(
                    f"shape: expected method {SHAPE_METHODS}, no search.together and no smoothness of colours"
                )
        count = len(self.starts.poses) or self.starts.count
        if len(self.goals) not in (0, 1, count):
            raise ValueError(f"expected no goal, one, or {count} (one per start), got {len(self.goals)}")
        return self

    def calibration_file(self, name: str) -> Path:
        """Calibration file ``camera``, ``vehicle`` or ``room``."""
        own: Path | None = getattr(self, name)
        return own if own is not None else Path(self.calibration or ".") / f"{name}.yaml"


_PATHS = ("scene", "policy", "calibration", "camera", "vehicle", "room")


def load_request(path: Path, overrides: Sequence[str] = ()) -> AttackRequest:
    """Read a ``*.attack.yaml`` file; anything unknown or wrong is one `ConfigError` with file and line."""
    return _resolve(read_yaml(path), Path(path).parent, overrides)


def parse_request(
    text: str, source: str = "request", folder: Path | None = None, overrides: Sequence[str] = ()
) -> AttackRequest:
    """The same from text; ``source`` is what messages call it, paths are relative to ``folder`` (here, if None)."""
    return _resolve(parse_yaml(text, source), folder or Path.cwd(), overrides)


def request_text(request: AttackRequest) -> str:
    """YAML text from which `parse_request` makes the same request on the same machine."""
    return dump_yaml(request.model_dump(mode="json"), default_flow_style=None, width=120)


def _resolve(document: Document, folder: Path, overrides: Sequence[str]) -> AttackRequest:
    apply_overrides(document, overrides)
    request = validate(AttackRequest, document, folder)

    def absolute(path: Path | None) -> Path | None:
        if path is None or is_factory(str(path)):
            return path
        return (folder / expanded(path)).resolve()

    changes: dict[str, Any] = {name: absolute(getattr(request, name)) for name in _PATHS}
    changes["objects"] = tuple(
        wanted.model_copy(
            update={name: absolute(getattr(wanted, name)) for name in ("file", "target", "display")}
            | {"mesh": wanted.mesh and wanted.mesh.model_copy(update={"file": absolute(wanted.mesh.file)})}
        )
        for wanted in request.objects
    )
    if request.poses is not None:
        changes["poses"] = request.poses.model_copy(update={"attack": absolute(request.poses.attack)})
    return request.model_copy(update=changes)
