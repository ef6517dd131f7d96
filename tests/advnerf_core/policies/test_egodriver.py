"""A driver behind a socket steers as its plan says, and is told what the car sees and where it is."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from advnerf_core.driving.rollout import Remembering
from advnerf_core.geometry import Array, Pinhole, camera_mount
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.egodriver import DrivenRig, driver_at, load_driver_at
from advnerf_core.policies.load import is_address, is_code, load_any_policy
from advnerf_core.policies.view import PolicyView

pytest.importorskip("carla_driver_interface")

from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult
from carla_driver_interface.geometry import Pose, Trajectory
from carla_driver_interface.server import serving

PINHOLE = Pinhole(40, 24, 30.0, 31.0, 19.0, 12.5)
VIEW = PolicyView(PINHOLE, 0, PINHOLE.height, PINHOLE.width, PINHOLE.height)
MOUNT = camera_mount(0.3, 0.1, 0.2, 0.17)
RADIUS_M, WHEELBASE_M, SPEED_MPS, DT_S = 2.0, 0.3, 0.8, 0.1
ACKERMANN = DrivenRig(PINHOLE, MOUNT, SPEED_MPS, DT_S, WHEELBASE_M, (-0.3, 0.3))
DUBINS = DrivenRig(PINHOLE, MOUNT, SPEED_MPS, DT_S, None, (-1.0, 1.0))
# Their circle is tighter than these cars can drive.
STIFF = DrivenRig(PINHOLE, MOUNT, SPEED_MPS, DT_S, WHEELBASE_M, (-0.1, 0.1))
SLOW = DrivenRig(PINHOLE, MOUNT, SPEED_MPS, DT_S, None, (-0.3, 0.3))


def arc(radius_m: float, along_m: Array) -> Array:
    """Points of a circle to the left that starts ahead."""
    turn = along_m / radius_m
    return np.column_stack([radius_m * np.sin(turn), radius_m * (1.0 - np.cos(turn))])


class OnACircle(BaseDriver):
    """Plans a circle to the left, and keeps what it was told."""

    name = "on_a_circle"

    def __init__(self, radius_m: float = RADIUS_M) -> None:
        self.radius_m = radius_m
        self.pictures: list[Array] = []
        self.poses: list[tuple[float, float, float]] = []
        self.cameras: list[object] = []
        self.open = 0

    def on_session_start(self, session: object) -> None:
        self.open += 1

    def on_session_close(self, session: object) -> None:
        self.open -= 1

    def drive(self, ctx: DriveContext) -> DriveResult:
        frame, pose = ctx.session.latest_frame("camera_front"), ctx.session.latest_pose()
        self.pictures.append(frame.as_array())
        self.poses.append((*pose.position[:2], pose.yaw))
        self.cameras = list(ctx.session.cameras.values())
        assert ctx.session.speed_mps() == pytest.approx(SPEED_MPS)
        plan = Trajectory.empty()
        for number, (x, y) in enumerate(arc(self.radius_m, np.linspace(0.05, 1.0, 20)), start=1):
            plan.append(ctx.time_now_us + number * 100_000, Pose.from_xyz_yaw(x, y, 0.0, 0.0))
        return DriveResult(trajectory_in_rig=plan)


@contextmanager
def served(driver: BaseDriver) -> Iterator[str]:
    with serving(driver, port=0, host="127.0.0.1") as port:
        yield f"grpc://127.0.0.1:{port}"


@pytest.mark.parametrize(
    ("rig", "control", "turn_radps"),
    [
        (ACKERMANN, np.arctan(WHEELBASE_M / RADIUS_M), SPEED_MPS / RADIUS_M),
        (DUBINS, SPEED_MPS / RADIUS_M, SPEED_MPS / RADIUS_M),
        (STIFF, np.arctan(WHEELBASE_M / RADIUS_M), SPEED_MPS * math.tan(0.1) / WHEELBASE_M),
        (SLOW, SPEED_MPS / RADIUS_M, 0.3),
    ],
)
def test_a_driver_steers_and_is_told_camera_pictures_and_poses(
    rig: DrivenRig, control: float, turn_radps: float
) -> None:
    driver, ticks, cars = OnACircle(), 5, 2
    images = torch.rand(
        ticks, cars, 3, PINHOLE.height, PINHOLE.width, generator=torch.Generator().manual_seed(0)
    )
    with served(driver) as address:
        policy = driver_at(address, VIEW, rig)
        drive = Remembering(policy, cars)
        for seen in images:
            assert drive(seen).tolist() == pytest.approx([control] * cars, rel=1e-3)
        assert driver.open == cars
        Remembering(policy, 1)
        assert driver.open == 1, "a new drive ends the sessions of the one before"
    for number, picture in enumerate(driver.pictures):
        sent = images[number // cars, number % cars].permute(1, 2, 0).numpy()
        assert np.abs(picture / 255.0 - sent).max() <= 0.51 / 255.0
    radius_m = SPEED_MPS / turn_radps
    for number, pose in enumerate(driver.poses):
        along_m = SPEED_MPS * DT_S * (number // cars)
        assert pose == pytest.approx((*arc(radius_m, np.array([along_m]))[0], along_m / radius_m), abs=1e-3)
    (camera,) = driver.cameras
    intrinsics = camera.intrinsics.opencv_pinhole_param
    assert (intrinsics.focal_length_x, intrinsics.principal_point_y) == (PINHOLE.fx, PINHOLE.cy)
    assert np.allclose(Pose.from_proto(camera.rig_to_camera).as_matrix(), MOUNT, atol=1e-6)


def test_its_hash_names_its_answers() -> None:
    with served(OnACircle()) as address:
        first = load_driver_at(address, VIEW, ACKERMANN)
        assert load_driver_at(address, VIEW, ACKERMANN, first.sha256).sha256 == first.sha256
        assert first.policy.stateless is False
        assert first.policy.differentiable is False
        assert "on_a_circle" in first.metadata["not_fixed"]
    with served(OnACircle()) as elsewhere:
        assert load_driver_at(elsewhere, VIEW, ACKERMANN).sha256 == first.sha256
    with (
        served(OnACircle(radius_m=1.0)) as other,
        pytest.raises(PolicyContractError, match="it answers otherwise"),
    ):
        load_driver_at(other, VIEW, ACKERMANN, first.sha256)


def test_another_driver_at_the_same_address_is_not_asked_on() -> None:
    with serving(OnACircle(), port=0, host="127.0.0.1") as port:
        policy = driver_at(f"grpc://127.0.0.1:{port}", VIEW, ACKERMANN)
        Remembering(policy, 1)
    other = OnACircle(radius_m=1.0)
    other.name = "on_a_smaller_circle"
    with (
        serving(other, port=port, host="127.0.0.1"),
        pytest.raises(PolicyContractError, match=rf"driver on_a_circle.*:{port}, got on_a_smaller_circle"),
    ):
        Remembering(policy, 1)
    assert not other.pictures


class AsTold(OnACircle):
    """Plans the points that it is given, in the car's frame."""

    def __init__(self, points: list[tuple[float, float]]) -> None:
        super().__init__()
        self.points = points

    def drive(self, ctx: DriveContext) -> DriveResult:
        plan = Trajectory.empty()
        for number, (x, y) in enumerate(self.points, start=1):
            plan.append(ctx.time_now_us + number * 100_000, Pose.from_xyz_yaw(x, y, 0.0, 0.0))
        return DriveResult(trajectory_in_rig=plan)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(0.1, 0.0), (1.0, math.nan)], r"finite positions from the driver on_a_circle.*in tick 1, got NaN or infinity as pose 3 of 3"),
        ([(math.inf, 0.0)], r"finite positions .*in tick 1"),
        ([(-1.0, 0.2), (-2.0, 0.5)], r"leads ahead from the driver on_a_circle.*in tick 1, got one to -0\.39 m ahead"),
        ([(-0.1, 0.0)], r"leads ahead .*in tick 1"),
    ],
)  # fmt: skip
def test_a_plan_that_cannot_be_driven_is_refused(points: list[tuple[float, float]], message: str) -> None:
    driver, image = AsTold([(1.0, 0.0)]), torch.zeros(1, 3, PINHOLE.height, PINHOLE.width)
    with served(driver) as address:
        drive = Remembering(driver_at(address, VIEW, ACKERMANN), 1)
        assert drive(image).tolist() == [0.0]
        driver.points = points
        with pytest.raises(PolicyContractError, match=message):
            drive(image)


@pytest.mark.parametrize(
    "points", [[(0.0, 0.0)], [(-0.001, 0.0), (-0.002, 0.0)], [(0.1, 0.3), (0.0, 0.6), (-0.3, 0.7)]]
)
def test_a_plan_to_stand_still_or_turn_hard_is_followed(points: list[tuple[float, float]]) -> None:
    with served(AsTold(points)) as address:
        drive = Remembering(driver_at(address, VIEW, ACKERMANN), 1)
        assert np.isfinite(drive(torch.zeros(1, 3, PINHOLE.height, PINHOLE.width)).tolist()).all()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("grpc://192.168.0.4:50051", r"on this computer, or grpcs:// \(TLS\)"),
        ("grpc://driver.example:50051", r"on this computer, or grpcs:// \(TLS\)"),
        ("grpc://127.0.0.1", "expected grpc://HOST:PORT"),
        (
            "grpc://127.0.0.1:1",
            r"expected a driver at grpc://127\.0\.0\.1:1, got UNAVAILABLE.*start it first",
        ),
    ],
)
def test_an_address_that_is_none_is_said(address: str, message: str) -> None:
    assert is_address(address)
    assert is_code(address)
    with pytest.raises(PolicyContractError, match=message):
        load_driver_at(address, VIEW, ACKERMANN)
    with pytest.raises(PolicyContractError, match="which an experiment does"):
        load_any_policy(address)
