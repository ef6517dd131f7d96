"""The attack file: one ``.safetensors`` file with what an attack found and everything needed to deploy and to trace it.

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
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save

from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import with_sorted_header, write_atomically
from advnerf_core.geometry import Array, Pinhole

FILE_FORMAT = "advnerf-attack-1"
TEXTURE_PX = 512


class AttackFileError(AdvnerfError, ValueError):
    """An attack file cannot be read, or is not what was saved."""


@dataclass(frozen=True, eq=False)
class AttackedObject:
    """One of several objects of an attack, or one without a face that could be displayed.

    Attributes:
        name: What it is, e.g. ``hydrant.object`` or ``face``.
        theta: Its free colours before squashing, ``[..., 3]`` float32.
        T_world_from_object: Its pose, ``[4, 4]``.
        scale: World metres per object unit.
        sha256: Hash of its geometry and fixed colours.
    """

    name: str
    theta: NDArray[np.float32]
    T_world_from_object: Array
    scale: float
    sha256: str

    def __post_init__(self) -> None:
        if self.theta.ndim < 2 or self.theta.shape[-1] != 3 or self.theta.dtype != np.float32:
            raise AttackFileError(f"expected theta [..., 3] float32, got {self.theta.shape} {self.theta.dtype}")
        if not (np.isfinite(self.theta).all() and np.isfinite(self.T_world_from_object).all()):
            raise AttackFileError(f"expected finite colours and a finite pose of {self.name}, got some that are not")


@dataclass(frozen=True, eq=False)
class AttackFile:
    """An attack, ready to be shown.

    Attributes:
        method: Name of the method that found the texture; ``none`` is the plain object.
        theta: Colour grid before squashing, ``[N, N, 3]`` float32; row 0 on top, column 0 left for the viewer. Empty if no object
            has a face that can be displayed.
        texture: The face as it is displayed, ``[H, W, 3]`` uint8 sRGB; empty like ``theta``.
        size_m: Width and height of the face [m].
        T_world_from_object: Pose of the object when it was attacked, ``[4, 4]``.
        subject: Motion-capture subject that carries the face.
        corners_in_subject: Corners ``[4, 3]`` of the face in the subject's frame: top left, top right, bottom right, bottom
            left for the viewer [m].
        camera: Intrinsics of the images the policy saw during the attack.
        scene_sha256: Hash of the scene the attack was computed in.
        policy_sha256: Hash of the victim.
        config_sha256: Hash of the experiment's configuration.
        seed: Seed of the attack.
        predicted_total_cte_m: Total CTE the surrogate predicts, averaged over starts [m]; None if it was not computed.
        software_version: Version of advnerf that wrote the file.
        clean_drive: The victim's drive without an attack, from the same starts in the same scene; None if it was not driven.
        extra: Anything else worth keeping, as plain data.
        objects: All objects with their colours, where there is more to them than the one face.
    """

    method: str
    theta: NDArray[np.float32]
    texture: NDArray[np.uint8]
    size_m: tuple[float, float]
    T_world_from_object: Array
    subject: str
    corners_in_subject: Array
    camera: Pinhole
    scene_sha256: str
    policy_sha256: str
    config_sha256: str
    seed: int
    predicted_total_cte_m: float | None
    software_version: str
    clean_drive: CleanDrive | None = None
    extra: dict[str, Any] = field(default_factory=dict)
    objects: tuple[AttackedObject, ...] = ()

    def __post_init__(self) -> None:
        if not self.method or not isinstance(self.method, str):
            raise AttackFileError(f"expected the name of a method, got {self.method!r}")
        if self.theta.ndim != 3 or self.theta.shape[2] != 3 or self.theta.dtype != np.float32:
            raise AttackFileError(f"expected theta [N, N, 3] float32, got {self.theta.shape} {self.theta.dtype}")
        if self.texture.ndim != 3 or self.texture.shape[2] != 3 or self.texture.dtype != np.uint8:
            raise AttackFileError(f"expected a texture [H, W, 3] uint8, got {self.texture.shape} {self.texture.dtype}")
        numbers = (self.theta, self.T_world_from_object, self.corners_in_subject)
        if np.shape(self.corners_in_subject) != (4, 3) or np.shape(self.T_world_from_object) != (4, 4):
            raise AttackFileError("expected corners [4, 3] and a pose [4, 4]")
        if not all(np.isfinite(part).all() for part in numbers):
            raise AttackFileError("expected finite colours, corners and pose, got some that are not")

    @cached_property
    def sha256(self) -> str:
        """Hash of the content: tensors and metadata."""
        digest = hashlib.sha256(_canonical(self._metadata()).encode())
        for name, tensor in sorted(self._tensors().items()):
            digest.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
            digest.update(tensor.tobytes())
        return digest.hexdigest()

    @property
    def has_face(self) -> bool:
        """Whether there is a face that a projection or a display can show."""
        return self.texture.size > 0

    @property
    def attack_id(self) -> str:
        """Short hash that names this attack everywhere."""
        return self.sha256[:12]

    def _tensors(self) -> dict[str, NDArray[Any]]:
        others = {f"objects.{k}.theta": np.ascontiguousarray(each.theta) for k, each in enumerate(self.objects)}
        return {"theta": np.ascontiguousarray(self.theta), "texture": np.ascontiguousarray(self.texture), **others}

    def _metadata(self) -> dict[str, Any]:
        # Left out when there are none: a file with one face, or without a drive, keeps its hash.
        clean = {"clean_drive": self.clean_drive.to_dict()} if self.clean_drive is not None else {}
        objects = {"objects": [_object_metadata(each) for each in self.objects]} if self.objects else {}
        return {
            "method": self.method,
            "size_m": [float(v) for v in self.size_m],
            "T_world_from_object": np.asarray(self.T_world_from_object, dtype=np.float64).tolist(),
            "subject": self.subject,
            "corners_in_subject": np.asarray(self.corners_in_subject, dtype=np.float64).tolist(),
            "camera": vars(self.camera) | {},
            "scene_sha256": self.scene_sha256,
            "policy_sha256": self.policy_sha256,
            "config_sha256": self.config_sha256,
            "seed": int(self.seed),
            "predicted_total_cte_m": self.predicted_total_cte_m,
            "software_version": self.software_version,
            "extra": self.extra,
            **clean,
            **objects,
        }


def _object_metadata(each: AttackedObject) -> dict[str, Any]:
    pose = np.asarray(each.T_world_from_object, dtype=np.float64).tolist()
    return {"name": each.name, "T_world_from_object": pose, "scale": float(each.scale), "sha256": each.sha256}


def face_texture(theta: ArrayLike, size_px: int = TEXTURE_PX) -> NDArray[np.uint8]:
    """The displayed texture ``[size_px, size_px, 3]`` of a face grid ``[N, N, 3]``: squashed, then interpolated bilinearly.

    Same convention as the renderer: grid values sit at cell centres and are clamped at the border.
    """
    colours = 1.0 / (1.0 + np.exp(-np.asarray(theta, dtype=np.float64)))
    enlarged = cv2.resize(colours, (size_px, size_px), interpolation=cv2.INTER_LINEAR)
    return np.round(255.0 * np.clip(enlarged, 0.0, 1.0)).astype(np.uint8)


def save_attack(path: str | os.PathLike[str], attack: AttackFile) -> str:
    """Write an attack file atomically and return its id."""
    header = {"format": FILE_FORMAT, "sha256": attack.sha256, "metadata": _canonical(attack._metadata())}
    write_atomically(Path(path), with_sorted_header(save(attack._tensors(), metadata=header)))
    return attack.attack_id


def load_attack(path: str | os.PathLike[str]) -> AttackFile:
    """Read an attack file and check that it is what was saved.

    Raises:
        AttackFileError: If it is missing, damaged, changed by hand, or something else.
    """
    source = Path(path)
    if not source.is_file():
        raise AttackFileError(f"expected an attack file at {source}, found none; run the attack, or correct the path")
    try:
        with safe_open(source, framework="numpy") as handle:
            header = handle.metadata() or {}
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError, ValueError) as error:
        raise AttackFileError(f"cannot read {source} as an attack file ({error}); make it again") from error
    return _checked(header, tensors, str(source))


def attack_from_bytes(content: bytes, source: str) -> AttackFile:
    """An attack file's content, checked as `load_attack` does; ``source`` is what messages call it."""
    # The container begins with the length of its header and the header itself, which is all that its reader of bytes leaves out.
    try:
        length = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + length])["__metadata__"]
        tensors = load(content)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise AttackFileError(f"cannot read {source} as an attack file ({error}); make it again") from error
    return _checked(header, tensors, source)


def _checked(header: dict[str, Any], tensors: dict[str, NDArray[Any]], source: str) -> AttackFile:
    if header.get("format") != FILE_FORMAT:
        raise AttackFileError(f"expected {source} to be of format {FILE_FORMAT}, got {header.get('format')!r}")
    try:
        attack = _from_parts(json.loads(header["metadata"]), tensors)
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
    values["size_m"] = tuple(values["size_m"])
    values["T_world_from_object"] = np.array(values["T_world_from_object"])
    values["corners_in_subject"] = np.array(values["corners_in_subject"])
    if "clean_drive" in values:
        values["clean_drive"] = CleanDrive.from_dict(values["clean_drive"])
    values["objects"] = tuple(
        AttackedObject(
            each["name"],
            tensors[f"objects.{k}.theta"],
            np.array(each["T_world_from_object"]),
            each["scale"],
            each["sha256"],
        )
        for k, each in enumerate(values.get("objects", ()))
    )
    return AttackFile(theta=tensors["theta"], texture=tensors["texture"], **values)


def _canonical(data: Any) -> str:
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
