"""The place of an audit, from the user's input: photographs with poses, or a world that can be driven."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.documents import Document, read_yaml
from advnerf_core.geometry import Pinhole
from advnerf_core.plugins import absolute_reference
from advnerf_core.strict import validate
from hardware.worlds.world import NativePanels, NotOpenError, WorldDescription
from nodes.audit.asking import answer
from nodes.audit.cars import AuditedCar
from nodes.audit.images import PosedPlace
from nodes.audit.question import Place
from nodes.experiment.plan.sections import CaptureConfig
from nodes.lab.worlds.named import NamedWorld, read_world
from nodes.lab.worlds.photographs.config import DRIVEN
from nodes.lab.worlds.photographs.world import PATH, Photographs
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError
from nodes.runtime.paths import shipped

_DRIVEN_POSES = "transforms_car.json"
# A path is closed if its ends are no farther apart than this many usual steps.
_ROUND = 3.0
# Relative to the extent of the cameras: nothing is learned beyond. A place with more distant walls fails on its held-out views.
_REACH = 1.5
# A height that was measured by hand, to the lens.
_HEIGHT_OFF_M, _HEIGHT_OFF = 0.05, 0.25
_WORLD = "world."


@dataclass(frozen=True)
class Answers:
    """Options about a place; None asks the user, or is derived.

    Attributes:
        limit_m: Half the width of the lane [m].
        speed_mps: Speed of the drives [m/s].
        camera_height_m: Height of the driving camera [m].
        path: ``driven``, a CSV file, the poses of a drive, or the name of a world's path.
    """

    limit_m: float | None = None
    speed_mps: float | None = None
    camera_height_m: float | None = None
    path: str | None = None


def place_of_photographs(
    given: Path,
    there: PosedPlace,
    answers: Answers,
    car: AuditedCar,
    camera: Pinhole | None,
    overrides: Sequence[str] = (),
) -> tuple[Place, float]:
    """A place of posed photographs, and half the width of its lane [m]; without the policy's own camera it has the photographs'.

    Args:
        overrides: ``KEY=VALUE`` texts about the experiment; those of its world count here already.

    Raises:
        ConfigError: The photographs show no path.
        UnansweredError: See `answer`.
    """
    limit_m = answer(
        answers.limit_m, "--limit", "From the middle of the lane to where the car is out of it [m]", float
    )
    driven = there.poses.parent / _DRIVEN_POSES
    path = answers.path or (str(driven) if driven.exists() else DRIVEN)
    of_car = car.car.model_dump(mode="json")
    if answers.speed_mps is not None:
        of_car["speed_mps"] = answers.speed_mps
    height_m = answers.camera_height_m or car.camera_height_m
    # Photographs that do not show a drive were taken at another height.
    if there.ground_at_zero and (path == DRIVEN or path.endswith(".json")):
        seen_m = _height_m(there.poses if path == DRIVEN else Path(path))
        height_m = _require_same_height(height_m or seen_m, seen_m)
    height_m = answer(height_m, "--camera-height", "Height of the driving camera above the ground [m]", float)
    world: dict[str, Any] = {
        "kind": "photographs",
        "images": str(there.poses.resolve()),
        "path": path if path == DRIVEN else str(Path(path).resolve()),
        "off_track_m": limit_m,
        "car": of_car,
        "camera": {"x_m": car.camera_ahead_m, "y_m": car.camera_left_m, "z_m": height_m},
    }
    if there.ground_at_zero:
        world["ground_z_m"] = 0.0
    if camera is not None:
        world["camera"]["pinhole"] = asdict(camera)
    apply_overrides(
        Document({"world": world}, "--place"), [each for each in overrides if each.startswith(_WORLD)]
    )
    derived, held_out = _found_out(world)
    world |= derived
    title, source = f"the place of {name_of(given)}", str(given)
    return Place(title, there.kind, source, there.scale, world, path=PATH, held_out=held_out), limit_m


def name_of(given: Path) -> str:
    """The name of a folder, of the folder of a ``transforms.json``, or of a video without its suffix."""
    whole = given.resolve()
    if whole.is_dir():
        return whole.name
    return whole.parent.name if whole.suffix == ".json" else whole.stem


def _height_m(poses: Path) -> float:
    """Height of the driving camera above the ground at z = 0, in the middle of its photographs [m]."""
    frames = load_transforms(poses, require_all=True).frames
    return round(float(np.median([each.T_world_from_camera[2, 3] for each in frames])), 4)


def _require_same_height(height_m: float, seen_m: float) -> float:
    """The height that was given, if the photographs of the drive were taken there.

    Raises:
        ConfigError: They were not: the policy would see another place than its car.
    """
    if abs(height_m - seen_m) > max(_HEIGHT_OFF_M, _HEIGHT_OFF * seen_m):
        raise ConfigError(
            f"expected the height of the driving camera in its photographs, {seen_m:g} m above the ground, got {height_m:g} m; leave --camera-height (or "
            "camera_height_m of the car) out, or correct the scale of the place"
        )
    return height_m


def camera_of(there: PosedPlace, path: str | None) -> Pinhole:
    """Intrinsics of the driving camera, undistorted: from the photographs that were taken while driving."""
    driven = there.poses.parent / _DRIVEN_POSES
    named = Path(path) if path is not None and path.endswith(".json") else driven
    poses = named if named.exists() else there.poses
    return load_image(load_transforms(poses, require_all=True).frames[0])[1]


def _found_out(world: dict[str, Any]) -> tuple[dict[str, Any], int | None]:
    """Settings derived from the photographs: whether the driven path is closed, and the largest extent of the place; and `Place.held_out`."""
    settings = {key: value for key, value in world.items() if key != "kind"}
    document = Document({**settings, "closed": False}, "--place")
    there = Photographs(validate(Photographs.Config, document, Path.cwd()))
    points = there.path_points()
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    closed = bool(np.linalg.norm(points[-1] - points[0]) <= _ROUND * float(np.median(steps_m)))
    usual, few = CaptureConfig().held_out, len(there.along) // 4
    held_out = None if few >= usual else max(few, 3)
    return {"closed": closed, "reach_m": round(_REACH * there.extent_m, 2)}, held_out


@dataclass(frozen=True)
class AuditedWorld:
    """A world that can be driven; it is asked for its description once, if that is needed at all.

    Attributes:
        name: Its kind, or ``file.py:Class``.
    """

    name: str

    @cached_property
    def description(self) -> WorldDescription:
        """Its description; it is opened if it must be open for that.

        Raises:
            ConfigError: The world is unknown.
        """
        try:
            return self._named.describe()
        except NotOpenError:
            with self._named.make() as world:
                return world.describe()

    def place(self, path: str | None) -> Place:
        """The place, driven along a path: the named one, that of its experiment file, or its first.

        Raises:
            ConfigError: The world is unknown.
        """
        data = self._shipped
        panels = isinstance(self._named.make(), NativePanels)
        path = path or next(iter(data.get("paths") or self.description.paths), "")
        base = _known_settings(self.name)
        # The experiment file is in another folder than the one that the user is in.
        world = {**data["world"], "kind": absolute_reference(self.name, Path.cwd())}
        return Place(self._named.kind, "world", self.name, "world", world, base, path, panels)

    @cached_property
    def _shipped(self) -> Any:
        base = _known_settings(self.name)
        return {"world": {}} if base is None else read_yaml(base).data

    @cached_property
    def _named(self) -> NamedWorld:
        section = {**self._shipped["world"], "kind": self.name}
        return read_world(Document(section, f"--world {self.name}"), Path.cwd())


def _known_settings(name: str) -> Path | None:
    """An experiment file of advnerf with this world: its settings for photographs and learning suit it."""
    for file in sorted(shipped("launch").glob("*.experiment.yaml")):
        data = read_yaml(file).data
        if "base" not in data and data.get("world", {}).get("kind") == name:
            return file
    return None
