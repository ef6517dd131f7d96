"""``advnerf scene world check``: good worlds pass, and each of the planted faults is found and named."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from advnerf_core.documents import Document
from advnerf_core.geometry import (
    OPENGL_FROM_OPENCV,
    Pinhole,
    VehicleState,
    camera_mount,
    invert_transform,
    planar_pose,
)
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import Box, CarDescription, NotOpenError, WorldError
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.named import NamedWorld, read_world
from nodes.runtime.errors import ConfigError
from tests.support.warehouse import EXAMPLES, Warehouse, small

PARTS = [
    "description", "pictures", "repeatable", "time", "reset", "car", "frames", "camera", "ground", "photographs", "coverage", "box", "paths",
    "expert",
]  # fmt: skip


def named(kind: str) -> NamedWorld:
    return read_world(Document({"kind": kind}, "test"), EXAMPLES)


@pytest.mark.parametrize(
    "kind",
    [
        "lab",
        pytest.param("junction", marks=pytest.mark.slow),
        pytest.param("world_warehouse.py:Warehouse", marks=pytest.mark.slow),
    ],
)
def test_good_worlds_pass(kind: str, tmp_path: Any) -> None:
    findings = check_world(named(kind), tmp_path / "look")
    shows_panels = ["panels"] if kind == "lab" else []  # the only one of them with native panels
    assert [finding.name for finding in findings] == [*PARTS, *shows_panels]
    assert [f"{finding.name}: {finding.text}" for finding in findings if finding.state != "met"] == []
    views = len(findings[0].text.split("paths ")[1].split("), "))
    assert len(list((tmp_path / "look").glob("*.png"))) == 3 * views


class Small(Warehouse):  # type: ignore[misc]
    """The warehouse with small photographs too."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        p = self.photo_pinhole
        self.photo_pinhole = p.resized(p.width // 2, p.height // 2)

    def changed(self, **changes: Any) -> Any:
        """The warehouse's own description with changes."""
        return type(Warehouse.describe(self))(**{**vars(Warehouse.describe(self)), **changes})


def test_the_small_warehouse_passes() -> None:
    assert [
        f"{finding.name}: {finding.text}" for finding in check_world(small(Small)) if finding.state != "met"
    ] == []


class Mirrored(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return np.ascontiguousarray(rgb[:, ::-1]), np.ascontiguousarray(z[:, ::-1]) if depth else None


class UpsideDown(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(z[::-1]) if depth else None


class DepthAlongTheRay(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return rgb, (z * np.linalg.norm(self.camera_pinhole.directions(), axis=-1)).astype(
            np.float32
        ) if depth else None


class Millimetres(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return rgb, 1000.0 * z if depth else None


class SaturatedDepth(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return rgb, np.minimum(z, np.float32(4.0)) if depth else None


class HalfTheDepthAbove(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        z[: len(z) // 2] *= 0.5
        return rgb, z if depth else None


class LevelCamera(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = self._cast(planar_pose(*pose) @ camera_mount(0.4, 0.0, 0.5), self.camera_pinhole)
        return rgb, z if depth else None


class CameraFurtherAhead(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        T = camera_mount(0.55, 0.0, 0.5, math.radians(10.0))
        rgb, z = self._cast(planar_pose(*pose) @ T, self.camera_pinhole)
        return rgb, z if depth else None


class ShortLens(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        p = self.camera_pinhole
        lens = Pinhole(p.width, p.height, 0.95 * p.fx, 0.95 * p.fy, p.cx, p.cy)
        rgb, z = self._cast(planar_pose(*pose) @ self.T_car_from_camera, lens)
        return rgb, z if depth else None


class DrivesSlowly(Small):
    def step(self, wheel: float, speed: float, duration: float) -> VehicleState:
        return super().step(wheel, 0.9 * speed, duration)


class SteersTooLittle(Small):
    def step(self, wheel: float, speed: float, duration: float) -> VehicleState:
        return super().step(0.85 * wheel, speed, duration)


class CameraOnTheRearAxle(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        T = camera_mount(-1.0, 0.0, 0.5, math.radians(10.0))
        rgb, z = self._cast(planar_pose(*pose) @ T, self.camera_pinhole)
        return rgb, z if depth else None


class InverseMount(Small):
    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self._mount, self.T_car_from_camera = self.T_car_from_camera, invert_transform(self.T_car_from_camera)

    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = self._cast(planar_pose(*pose) @ self._mount, self.camera_pinhole)
        return rgb, z if depth else None


class HigherThanDeclared(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        T = camera_mount(0.4, 0.0, 0.7, math.radians(10.0))
        rgb, z = self._cast(planar_pose(*pose) @ T, self.camera_pinhole)
        return rgb, z if depth else None


class YawToTheRight(Small):
    def observe_at(self, x: float, y: float, yaw: float, depth: bool = True) -> Any:
        return super().observe_at(x, y, -yaw, depth)


class BlueFirst(Small):
    def photograph(self, T: Any) -> Any:
        return np.ascontiguousarray(super().photograph(T)[..., ::-1])


class PhotographsByTheInverse(Small):
    def photograph(self, T: Any) -> Any:
        return super().photograph(invert_transform(T))


class Late(Small):
    _shown: Any = None

    def reset(self, *pose: float) -> VehicleState:
        self._shown = tuple(pose)
        return super().reset(*pose)

    def step(self, *command: float) -> VehicleState:
        self._shown = self._pose
        return super().step(*command)

    def observe(self, depth: bool = True) -> Any:
        return super().observe_at(*self._shown, depth=depth)


class SteersTheOtherWay(Small):
    def step(self, wheel: float, speed: float, duration: float) -> VehicleState:
        return super().step(-wheel, speed, duration)


class KilometresPerHour(Small):
    def step(self, wheel: float, speed: float, duration: float) -> VehicleState:
        return super().step(wheel, speed / 3.6, duration)


class WheelsInDegrees(Small):
    def step(self, wheel: float, speed: float, duration: float) -> VehicleState:
        return super().step(math.radians(wheel), speed, duration)


class StateInKilometresPerHour(Small):
    @property
    def state(self) -> Any:
        found = super().state
        return replace(found, speed_mps=3.6 * found.speed_mps)


class OneSpeed(Small):
    def step(self, wheel_rad: float, speed_mps: float, duration_s: float) -> Any:
        return super().step(wheel_rad, self.config.speed_mps, duration_s)


class OneTick(Small):
    def step(self, wheel_rad: float, speed_mps: float, duration_s: float) -> Any:
        return super().step(wheel_rad, speed_mps, 0.1)


class ReturnsTheStateBefore(Small):
    def step(self, wheel_rad: float, speed_mps: float, duration_s: float) -> Any:
        before = self.state
        super().step(wheel_rad, speed_mps, duration_s)
        return before


class PhotographsInMillimetres(Small):
    def photo_poses(self, count: int, rng: np.random.Generator) -> Any:
        return [
            T @ np.eye(4) * np.array([[1, 1, 1, 1e3]] * 3 + [[1] * 4])
            for T in super().photo_poses(count, rng)
        ]


class LanesInCentimetres(Small):
    def describe(self) -> Any:
        return replace(super().describe(), off_track_m=60.0)


class WrongWheelbase(Small):
    def describe(self) -> Any:
        return self.changed(car=CarDescription("ackermann", self.config.speed_mps, (-0.5, 0.5), 0.3))


class StateInDegrees(Small):
    @property
    def state(self) -> VehicleState:
        x, y, yaw = self._pose
        return VehicleState(x, y, math.degrees(yaw), self._speed_mps)


class BodysMiddle(Small):
    @property
    def state(self) -> VehicleState:
        x, y, yaw = self._pose
        return VehicleState(x + 0.3 * math.cos(yaw), y + 0.3 * math.sin(yaw), yaw, self._speed_mps)


class DrivesByItsMiddle(BodysMiddle):
    def reset(self, x: float, y: float, yaw: float) -> VehicleState:
        super().reset(x - 0.3 * math.cos(yaw), y - 0.3 * math.sin(yaw), yaw)
        return self.state


class KeepsTheWheels(Small):
    def reset(self, *pose: float) -> VehicleState:
        wheel = getattr(self, "_wheel_rad", 0.0)
        super().reset(*pose)
        self._wheel_rad = wheel
        return self.state


class LookingTakesTime(Small):
    def observe(self, depth: bool = True) -> Any:
        seen = super().observe(depth)
        if self._speed_mps:
            self.step(0.0, self._speed_mps, 0.02)
        return seen


class LookingElsewhereGoesThere(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        self._pose = tuple(map(float, pose))
        return super().observe_at(*pose, depth=depth)


class Noisy(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose, depth=depth)
        noise = np.random.default_rng().integers(0, 3, rgb.shape)
        return np.clip(rgb + noise, 0, 255).astype(np.uint8), z


class OneBuffer(Small):
    _buffer: Any = None

    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose, depth=depth)
        self._buffer = rgb.copy() if self._buffer is None else self._buffer
        np.copyto(self._buffer, rgb)
        return self._buffer, z


class DoubleDepth(Small):
    def observe_at(self, *pose: float, depth: bool = True) -> Any:
        rgb, z = super().observe_at(*pose)
        return rgb, z.astype(np.float64) if depth else None


class TightPath(Small):
    def describe(self) -> Any:
        tight = ReferencePath(
            (-4.0, -3.0, 0.0), (("line", 3.0), ("arc", 0.6, 0.5 * math.pi), ("line", 0.3)), (1.0, 0.0)
        )
        return self.changed(paths={"tight": tight})


class PathThroughAShelf(Small):
    def describe(self) -> Any:
        return self.changed(paths={"through": ReferencePath((-6.0, -1.0, 0.0), (("line", 7.0),), (1.0, 0.0))})


class OneGoalForTwoPaths(Small):
    def describe(self) -> Any:
        paths = Warehouse.describe(self).paths
        return self.changed(
            paths={name: ReferencePath(p.start_pose, p.segments, (), p.closed) for name, p in paths.items()}
        )


class OpenGlPhotographs(Small):
    def photo_poses(self, count: int, rng: np.random.Generator) -> Any:
        return [pose @ OPENGL_FROM_OPENCV for pose in super().photo_poses(count, rng)]


class PhotographsOfOneCorner(Small):
    def photo_poses(self, count: int, rng: np.random.Generator) -> Any:
        return [planar_pose(-5.0, 3.0, 3.0) @ self.T_car_from_camera] * count


class SmallBox(Small):
    def describe(self) -> Any:
        return self.changed(box=Box((-4.0, -4.0, 0.0), (4.0, 4.0, 2.0)))


class AnotherEveryTime(Small):
    _asked = 0

    def describe(self) -> Any:
        self._asked += 1
        return self.changed(facts={"asked": self._asked})


class Raises(Small):
    def photo_poses(self, count: int, rng: np.random.Generator) -> Any:
        raise KeyError("poses")


@pytest.mark.parametrize(
    ("fault", "part", "told"),
    [
        (Mirrored, "camera", "mirrored left to right"),
        (UpsideDown, "camera", "upside down"),
        (DepthAlongTheRay, "camera", "distance along the ray"),
        (Millimetres, "camera", "in millimetres"),
        (SaturatedDepth, "camera", "largest depth, 4 m"),
        (HalfTheDepthAbove, "camera", "in the upper half of the picture"),
        (ShortLens, "camera", "compare camera_pinhole with the camera that draws"),
        (LevelCamera, "camera", "the camera that draws is level"),
        (CameraOnTheRearAxle, "camera", "compare T_car_from_camera"),
        (InverseMount, "camera", "inverse of what is meant"),
        (YawToTheRight, "camera", "yaw turns to the right"),
        (HigherThanDeclared, "ground", "at z = 0; got a median of -0.2"),
        (BlueFirst, "photographs", "is blue, green, red"),
        (PhotographsByTheInverse, "photographs", "camera to world"),
        (Late, "frames", "the picture is late"),
        (SteersTheOtherWay, "car", "it turns right"),
        (KilometresPerHour, "car", "0.28 times as fast; speeds are in m/s"),
        (WheelsInDegrees, "car", "in degrees?"),
        (
            StateInKilometresPerHour,
            "car",
            "expected a state's speed of 1.2 m/s, at which the car moves; got 4.32 m/s",
        ),
        (OneSpeed, "car", "obey speed_mps"),
        (OneTick, "car", "obey duration_s"),
        (ReturnsTheStateBefore, "car", "expected step to return the state"),
        (PhotographsInMillimetres, "coverage", "poses are in metres"),
        (WrongWheelbase, "car", "0.60 times as fast; correct kind"),
        (StateInDegrees, "reset", "yaw is in radians"),
        (BodysMiddle, "reset", "after reset"),
        (DrivesByItsMiddle, "car", "not of the body's middle"),
        (KeepsTheWheels, "reset", "forget commands under way"),
        (LookingTakesTime, "time", "observe changes the car's state"),
        (LookingElsewhereGoesThere, "time", "observe_at changes the car's state"),
        (Noisy, "repeatable", "another picture"),
        (OneBuffer, "pictures", "return a copy"),
        (DoubleDepth, "pictures", "float32 in metres; got float64"),
        (TightPath, "paths", "curves that the car can follow"),
        (PathThroughAShelf, "paths", "the car is blocked at"),
        (OneGoalForTwoPaths, "paths", "no policy can tell them apart"),
        (OpenGlPhotographs, "coverage", "OpenGL"),
        (PhotographsOfOneCorner, "coverage", "% of the paths are seen"),
        (SmallBox, "box", "make it larger"),
        (AnotherEveryTime, "description", "when it is asked again"),
        (Raises, "coverage", "raised KeyError: 'poses'"),
    ],
)
def test_a_planted_fault_is_found_and_named(fault: Callable[..., Any], part: str, told: str) -> None:
    (finding,) = [each for each in check_world(small(fault), only=[part]) if each.name == part]
    assert not finding.met
    assert told in finding.text


@pytest.mark.parametrize(
    ("fault", "part", "told"),
    [
        (CameraFurtherAhead, "camera", "look at T_car_from_camera and camera_pinhole"),
        (CameraFurtherAhead, "photographs", "correlation below 0.97"),
        (DrivesSlowly, "car", "speed x 0.90"),
        (SteersTooLittle, "car", "turn x 0.85"),
    ],
)
def test_a_small_fault_is_met_but_shown(fault: Callable[..., Any], part: str, told: str) -> None:
    (finding,) = [each for each in check_world(small(fault), only=[part]) if each.name == part]
    assert (finding.state, finding.met) == ("met, but look", True), finding.text
    assert told in finding.text


def test_lanes_in_another_unit_are_refused() -> None:
    with pytest.raises(WorldError, match=r"half a lane, .* at most 20 m; got 60\.0; it is in metres"):
        check_world(small(LanesInCentimetres))


def test_parts_are_looked_at_alone_and_unknown_ones_are_refused() -> None:
    alone = check_world(small(Small), only=["reset", "time"])
    assert [finding.name for finding in alone] == ["description", "pictures", "time", "reset"]
    with pytest.raises(ConfigError, match=r"part of the contract.*camera.*got 'cameras'"):
        check_world(small(Small), only=["cameras"])


def test_what_a_world_must_be_asked_for_is_asked_once_it_is_open() -> None:
    class Asked(Small):
        opened = False

        def describe(self) -> Any:
            if not self.opened:
                raise NotOpenError("expected it to be open")
            return super().describe()

        def __enter__(self) -> Any:
            self.opened = True
            return self

    assert all(finding.met for finding in check_world(small(Asked), only=["description"]))
