"""The attack file: one ``.safetensors`` file with an attack and everything needed to deploy and to trace it.

The compositor, the monitor, the simulators and the report all read this file. Its short hash is the attack id that accompanies
every attacked image. No torch here: the car's own nodes load it.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import is_plain_name, read_tensors, write_tensors
from advnerf_core.geometry import Array, Pinhole, yaw_of

FILE_FORMAT = "advnerf-attack-2"
# The published form, a fortieth of the size: without derived data, the displayed texture of a face, and with theta in half precision where
# that is exact. The attack file is restored from it to the bit.
PACKED_FORMAT = "advnerf-attack-2-packed"
TEXTURE_PX = 512
_TEXTURE = "face.texture"

# The spaces that a search can change.
COLOURS, PLACES, MESH_TEXTURE, MESH_SHAPE = "colours", "places", "mesh_texture", "mesh_shape"


class AttackFileError(AdvnerfError, ValueError):
    """An attack file cannot be read, or differs from what was saved."""


@dataclass(frozen=True, eq=False)
class AttackedObject:
    """One object of an attack, in its attacked form.

    Attributes:
        name: Name of the object, e.g. ``hydrant.object`` or ``face``.
        theta: Attacked parameters, ``[..., 3]`` float32: colours before squashing; for an attack on shapes the search's parameters of
            each vertex ``[V, 3]``.
        T_world_from_object: Pose of the object, ``[4, 4]``.
        scale: World metres per object unit.
        sha256: Hash of its geometry and fixed colours.
        glb: The attacked mesh as a binary glTF file, in the object's frame; empty for other objects.
        size_m: Width and height of a panel's texture [m]; None for solid objects, for a face (see `AttackFace`), and in older files.
        marker_m: Side of the markers in the border that it had in the search [m]; None without a border.
    """

    name: str
    theta: NDArray[np.float32]
    T_world_from_object: Array
    scale: float
    sha256: str
    glb: bytes = b""
    size_m: tuple[float, float] | None = None
    marker_m: float | None = None

    @property
    def placement(self) -> tuple[float, float, float, float]:
        """Placement: x [m], y [m], yaw [rad] and scale."""
        T = np.asarray(self.T_world_from_object)
        return float(T[0, 3]), float(T[1, 3]), yaw_of(T), float(self.scale)

    def __post_init__(self) -> None:
        if not is_plain_name(self.name):
            raise AttackFileError(
                f"expected a name of an object without slashes, as files are called by it, got {self.name!r:.80}"
            )
        if self.glb and not self.glb.startswith(b"glTF"):
            raise AttackFileError(f"expected the mesh of {self.name} to be a GLB file, got something else")
        if self.theta.ndim < 2 or self.theta.shape[-1] != 3 or self.theta.dtype != np.float32:
            raise AttackFileError(
                f"expected theta [..., 3] float32, got {self.theta.shape} {self.theta.dtype}"
            )
        if np.shape(self.T_world_from_object) != (4, 4):
            raise AttackFileError(
                f"expected a pose [4, 4] of {self.name}, got {np.shape(self.T_world_from_object)}"
            )
        if not (np.isfinite(self.theta).all() and np.isfinite(self.T_world_from_object).all()):
            raise AttackFileError(
                f"expected finite colours and a finite pose of {self.name}, got some that are not"
            )


@dataclass(frozen=True, eq=False)
class AttackFace:
    """The face of an object that a projection or a display can show.

    Attributes:
        texture: The displayed face, ``[H, W, 3]`` uint8 sRGB.
        size_m: Width and height [m].
        subject: Motion-capture subject that carries the face.
        corners_in_subject: Corners ``[4, 3]`` in the subject's frame: top left, top right, bottom right, bottom left for the viewer [m].
        carried_by: Number of the object with this face; its theta is the colour grid ``[N, N, 3]``, row 0 on top, column 0 left for the viewer.
    """

    texture: NDArray[np.uint8]
    size_m: tuple[float, float]
    subject: str
    corners_in_subject: Array
    carried_by: int = 0

    def __post_init__(self) -> None:
        if (
            self.texture.ndim != 3
            or self.texture.shape[2] != 3
            or self.texture.dtype != np.uint8
            or not self.texture.size
        ):
            raise AttackFileError(
                f"expected a texture [H, W, 3] uint8, got {self.texture.shape} {self.texture.dtype}"
            )
        if np.shape(self.corners_in_subject) != (4, 3) or not np.isfinite(self.corners_in_subject).all():
            raise AttackFileError("expected four finite corners [4, 3] of the face, got others")


@dataclass(frozen=True, eq=False)
class AttackFile:
    """An attack on any space, ready to be deployed.

    Attributes:
        method: Name of the method; ``none`` is the plain object.
        space: Searched space: ``colours``, ``places`` (with or without colours), ``mesh_texture``, ``mesh_shape``, or a user's own.
        objects: The attacked objects, at least one.
        face: The face for a projection or a display; None if no object has one.
        camera: Intrinsics of the images the policy saw during the attack.
        scene_sha256: Hash of the scene the attack was computed in.
        policy_sha256: Hash of the victim.
        config_sha256: Hash of the experiment's configuration.
        seed: Seed of the attack.
        predicted_total_cte_m: Total CTE the surrogate predicts, averaged over starts [m]; None if it was not computed.
        software_version: Version of advnerf that wrote the file.
        clean_drive: The victim's drive without an attack, from the same starts in the same scene; None if there was none.
        extra: Further plain data.
        field_total_cte_m: The predicted total CTE of the same drives through the learned field itself, if the search used a baked one [m].
    """

    method: str
    space: str
    objects: tuple[AttackedObject, ...]
    face: AttackFace | None
    camera: Pinhole
    scene_sha256: str
    policy_sha256: str
    config_sha256: str
    seed: int
    predicted_total_cte_m: float | None
    software_version: str
    clean_drive: CleanDrive | None = None
    extra: dict[str, Any] = field(default_factory=dict)
    field_total_cte_m: float | None = None

    @property
    def objective_in_words(self) -> str:
        """Objective and value, and the value without an attack if the file has it; empty for ``cte``, whose value is the predicted total CTE."""
        found = self.extra.get("objective")
        if found is None:
            return ""
        clean, unit = found.get("clean_value"), found["unit"]
        beside = "" if clean is None else f", without attack {clean:.4g} {unit}"
        return f"{found['name']} {found['value']:.4g} {unit}{beside}"

    @property
    def value(self) -> float | None:
        """Value of the objective, averaged over starts, in its own unit; for ``cte`` it is the predicted total CTE [m]."""
        found = self.extra.get("objective")
        return self.predicted_total_cte_m if found is None else found["value"]

    def __post_init__(self) -> None:
        for name in ("method", "space"):
            value = getattr(self, name)
            if not isinstance(value, str) or not value:
                raise AttackFileError(f"expected the name of a {name}, got {value!r}")
        if not self.objects:
            raise AttackFileError("expected at least one object, got none")
        if self.face is not None:
            if not 0 <= self.face.carried_by < len(self.objects):
                raise AttackFileError(
                    f"expected a face of object 0 to {len(self.objects) - 1}, got {self.face.carried_by}"
                )
            if self.face_object.theta.ndim != 3:
                raise AttackFileError(
                    f"expected theta [N, N, 3] of the face, got {self.face_object.theta.shape}"
                )

    @cached_property
    def sha256(self) -> str:
        """Hash of the content: tensors and metadata."""
        digest = hashlib.sha256(_canonical(self._metadata()).encode())
        for name, tensor in sorted(self._tensors().items()):
            digest.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
            digest.update(tensor.tobytes())
        return digest.hexdigest()

    @property
    def attack_id(self) -> str:
        """Short hash that names this attack everywhere."""
        return self.sha256[:12]

    @property
    def face_object(self) -> AttackedObject:
        """The object that carries the face.

        Raises:
            AttackFileError: The attack has no face.
        """
        return self.objects[self.required_face().carried_by]

    def required_face(self) -> AttackFace:
        """The face, for a projection or a display.

        Raises:
            AttackFileError: The attack has none.
        """
        if self.face is None:
            names = ", ".join(each.name for each in self.objects)
            raise AttackFileError(
                f"expected an attack with a face that can be shown, got one on the {self.space} of {names}; search one for a face"
            )
        return self.face

    def _tensors(self) -> dict[str, NDArray[Any]]:
        found: dict[str, NDArray[Any]] = {}
        for k, each in enumerate(self.objects):
            found[f"objects.{k}.theta"] = np.ascontiguousarray(each.theta)
            if each.glb:
                found[f"objects.{k}.glb"] = np.frombuffer(each.glb, np.uint8)
        if self.face is not None:
            found[_TEXTURE] = np.ascontiguousarray(self.face.texture)
        return found

    def _metadata(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "space": self.space,
            "objects": [_object_metadata(each) for each in self.objects],
            "face": None if self.face is None else _face_metadata(self.face),
            "camera": vars(self.camera) | {},
            "scene_sha256": self.scene_sha256,
            "policy_sha256": self.policy_sha256,
            "config_sha256": self.config_sha256,
            "seed": int(self.seed),
            "predicted_total_cte_m": self.predicted_total_cte_m,
            "software_version": self.software_version,
            "clean_drive": None if self.clean_drive is None else self.clean_drive.to_dict(),
            "extra": self.extra,
            **({} if self.field_total_cte_m is None else {"field_total_cte_m": self.field_total_cte_m}),
        }


def _object_metadata(each: AttackedObject) -> dict[str, Any]:
    pose = np.asarray(each.T_world_from_object, dtype=np.float64).tolist()
    return {
        "name": each.name,
        "T_world_from_object": pose,
        "scale": float(each.scale),
        "sha256": each.sha256,
        **({} if each.size_m is None else {"size_m": [float(v) for v in each.size_m]}),
        **({} if each.marker_m is None else {"marker_m": each.marker_m}),
    }


def _face_metadata(face: AttackFace) -> dict[str, Any]:
    return {
        "size_m": [float(v) for v in face.size_m],
        "subject": face.subject,
        "corners_in_subject": np.asarray(face.corners_in_subject, dtype=np.float64).tolist(),
        "carried_by": int(face.carried_by),
    }


def face_texture(theta: ArrayLike, size_px: int = TEXTURE_PX) -> NDArray[np.uint8]:
    """The displayed texture ``[size_px, size_px, 3]`` of a face grid ``[N, N, 3]``: squashed, then interpolated bilinearly.

    Same convention as the renderer: grid values sit at cell centres and are clamped at the border.
    """
    colours = 1.0 / (1.0 + np.exp(-np.asarray(theta, dtype=np.float64)))
    enlarged = cv2.resize(colours, (size_px, size_px), interpolation=cv2.INTER_LINEAR)
    return np.round(255.0 * np.clip(enlarged, 0.0, 1.0)).astype(np.uint8)


def save_attack(path: str | os.PathLike[str], attack: AttackFile, small: bool = False) -> str:
    """Write an attack file atomically and return its id.

    Args:
        small: Leave out derived tensors; `load_attack` restores them.
    """
    header = {"format": FILE_FORMAT, "sha256": attack.sha256, "metadata": _canonical(attack._metadata())}
    tensors = attack._tensors()
    if small:
        header["format"] = PACKED_FORMAT
        tensors = _packed(tensors, attack.face.carried_by if attack.face else None)
    write_tensors(path, "numpy", tensors, header)
    return attack.attack_id


def _packed(tensors: dict[str, NDArray[Any]], carried_by: int | None) -> dict[str, NDArray[Any]]:
    """The tensors without the derived ones; ``carried_by`` is the number of the object with the face."""
    found = {name: _narrowed(each) if name.endswith(".theta") else each for name, each in tensors.items()}
    if carried_by is not None:
        theta = tensors[f"objects.{carried_by}.theta"]
        if np.array_equal(tensors[_TEXTURE], face_texture(theta)):
            del found[_TEXTURE]
    return found


def _unpacked(tensors: dict[str, NDArray[Any]], carried_by: int | None) -> dict[str, NDArray[Any]]:
    found = {
        name: each.astype(np.float32) if name.endswith(".theta") else each for name, each in tensors.items()
    }
    if carried_by is not None and _TEXTURE not in found:
        found[_TEXTURE] = face_texture(found[f"objects.{carried_by}.theta"])
    return found


def _narrowed(theta: NDArray[Any]) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        half = theta.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), theta) else theta


def load_attack(path: str | os.PathLike[str]) -> AttackFile:
    """Read an attack file and verify its hash.

    Raises:
        AttackFileError: If it is missing, damaged, changed by hand, or something else.
    """
    source = Path(path)
    if not source.is_file():
        raise AttackFileError(
            f"expected an attack file at {source}, found none; run the attack, or correct the path"
        )
    try:
        header, tensors = read_tensors(source, "numpy")
    except (OSError, ValueError) as error:
        raise AttackFileError(f"cannot read {source} as an attack file ({error}); make it again") from error
    return _checked(header, tensors, str(source))


def attack_from_bytes(content: bytes, source: str) -> AttackFile:
    """An attack file's content, checked as by `load_attack`; ``source`` names it in messages."""
    # The container begins with the length of its header and the header itself; its bytes reader checks nothing else.
    try:
        length = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + length])["__metadata__"]
        tensors = load(content)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise AttackFileError(f"cannot read {source} as an attack file ({error}); make it again") from error
    return _checked(header, tensors, source)


def _checked(header: dict[str, Any], tensors: dict[str, NDArray[Any]], source: str) -> AttackFile:
    if header.get("format") not in (FILE_FORMAT, PACKED_FORMAT):
        raise AttackFileError(
            f"expected {source} to be of format {FILE_FORMAT}, got {header.get('format')!r}"
        )
    try:
        metadata = json.loads(header["metadata"])
        if header["format"] == PACKED_FORMAT:
            face = metadata["face"]
            tensors = _unpacked(tensors, None if face is None else face["carried_by"])
        attack = _from_parts(metadata, tensors)
    except AttackFileError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise AttackFileError(f"cannot read {source} as an attack file ({error}); make it again") from error
    if attack.sha256 != header.get("sha256"):
        raise AttackFileError(
            f"{source} was changed after it was saved: its content does not match its hash; make it again"
        )
    return attack


def _from_parts(metadata: dict[str, Any], tensors: dict[str, NDArray[Any]]) -> AttackFile:
    values = dict(metadata)
    values["camera"] = Pinhole(**values["camera"])
    clean, face = values["clean_drive"], values["face"]
    values["clean_drive"] = None if clean is None else CleanDrive.from_dict(clean)
    values["objects"] = tuple(
        AttackedObject(
            each["name"],
            tensors[f"objects.{k}.theta"],
            np.array(each["T_world_from_object"]),
            each["scale"],
            each["sha256"],
            tensors[f"objects.{k}.glb"].tobytes() if f"objects.{k}.glb" in tensors else b"",
            tuple(each["size_m"]) if "size_m" in each else None,
            each.get("marker_m"),
        )
        for k, each in enumerate(values["objects"])
    )
    if face is not None:
        corners = np.array(face["corners_in_subject"])
        values["face"] = AttackFace(
            tensors[_TEXTURE], tuple(face["size_m"]), face["subject"], corners, face["carried_by"]
        )
    return AttackFile(**values)


def _canonical(data: Any) -> str:
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
