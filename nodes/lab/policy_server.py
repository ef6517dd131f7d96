"""Serves a policy to others as a driver behind gRPC: the egodriver protocol of alpasim, Autoware and CARLA users.

Each session has its own memory. A policy of waypoints answers with its plan and times. A policy that steers answers with the
arc of its curvature, at the car's speed.

Needs ``pip install 'advnerf[egodriver]'``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult, SessionState
from carla_driver_interface.geometry import Pose, Trajectory
from carla_driver_interface.protocol import (
    add_CarlaVehicleServiceServicer_to_server,
    add_EgodriverServiceServicer_to_server,
    channel_options,
)
from carla_driver_interface.service import EgodriverServicer, ServiceMode
from numpy.typing import NDArray

from advnerf_core.policies.driver import Driver, require_goal
from advnerf_core.unit_bounds import MOST_LENGTH_M
from nodes.linking.keys import is_loopback
from nodes.operator_page.certificate import certificate
from nodes.runtime.errors import ConfigError
from nodes.runtime.terminal import listen_address

_US_PER_S, _PERIOD_S, _HORIZON_S = 1_000_000, 0.1, 3.0
# Two calibrations of one camera differ by less than this share of its focal length.
_FOCAL_SHARE = 0.02
_WORKERS, _GRACE_S = 8, 1.0


@dataclass(frozen=True)
class ServedCar:
    """The car's data that a policy that steers lacks.

    Attributes:
        wheelbase_m: Distance between the axles, which converts a wheel angle to an arc [m]; None for a policy without need of it.
        speed_mps: Speed of the plans [m/s]; None for the car's current speed.
    """

    wheelbase_m: float | None = None
    speed_mps: float | None = None
    goal: tuple[float, ...] = ()


class ServedPolicy(BaseDriver):
    """A policy as a driver of the protocol.

    Args:
        name: Name of the driver; the start of the policy's hash follows.

    Raises:
        ConfigError: The policy steers and the wheelbase is missing or in another unit, or its goal has another length.
    """

    def __init__(self, driver: Driver, name: str, car: ServedCar) -> None:
        contract = driver.contract
        self.wheelbase_m = contract.wheelbase_m if car.wheelbase_m is None else car.wheelbase_m
        if contract.trajectory is None and self.wheelbase_m is None:
            raise ConfigError(
                "expected a wheelbase for a policy that answers with wheel angles; give --wheelbase of the car that it was trained for"
            )
        if self.wheelbase_m is not None and not 0.0 < self.wheelbase_m <= MOST_LENGTH_M:
            raise ConfigError(
                f"--wheelbase: expected metres above 0 and at most {MOST_LENGTH_M:g}, not cm or mm, got {self.wheelbase_m:g}; correct it"
            )
        require_goal(car.goal, driver.goal_size, "give --goal")
        self.name = f"{name}-{driver.sha256[:12]}"
        self._driver, self._car = driver, car
        self._sessions: dict[str, tuple[str, Driver]] = {}

    def on_session_start(self, session: SessionState) -> None:
        """Find the policy's camera among the session's, and reset its memory.

        Raises:
            ValueError: No camera of the session has the size and lens of the policy's.
        """
        wanted = self._driver.view.camera
        fitting = [name for name, camera in session.cameras.items() if _fits(camera, wanted)]
        if len(fitting) != 1:
            described = ", ".join(f"{name} {_described(camera)}" for name, camera in session.cameras.items())
            raise ValueError(
                f"expected one camera of {wanted.width} x {wanted.height} with a focal length of {wanted.fx:.1f} px, got {described or 'none'}; "
                "declare the camera that the policy was made for"
            )
        driver = copy.copy(self._driver)
        driver.reset()
        self._sessions[session.uuid] = (fitting[0], driver)

    def on_session_close(self, session: SessionState) -> None:
        """Forget the session."""
        self._sessions.pop(session.uuid, None)

    def drive(self, ctx: DriveContext) -> DriveResult:
        """The policy's plan in the car's frame; an empty one, which holds the car, before the first picture.

        Raises:
            ValueError: The policy's answer is no finite number.
        """
        camera, driver = self._sessions[ctx.session.uuid]
        frame = ctx.session.latest_frame(camera)
        plan = Trajectory.empty()
        if frame is None:
            return DriveResult(trajectory_in_rig=plan)
        raw = driver.answer(driver.view.image(np.asarray(frame.as_array(), dtype=np.uint8)), self._car.goal)
        steering_rad = float(driver.contract.to_steering_rad(raw, 1)[0])
        trajectory = driver.contract.trajectory
        if trajectory is not None:
            times_s = np.array(trajectory.times_s)
            points = np.asarray(driver.contract.waypoints_m(raw, 1)[0], dtype=np.float64)
            poses = np.column_stack([points, _headings(points)])
        else:
            times_s = np.arange(1, round(_HORIZON_S / _PERIOD_S) + 1) * _PERIOD_S
            speed_mps = ctx.session.speed_mps() if self._car.speed_mps is None else self._car.speed_mps
            poses = _arc(np.tan(steering_rad) / float(self.wheelbase_m or 0.0), speed_mps * times_s)
        if not np.isfinite(poses).all():
            raise ValueError(
                f"expected a finite plan from {self.name}, got one with NaN or infinity; look at it with advnerf policy check"
            )
        for time_s, (x, y, yaw) in zip(times_s, poses, strict=True):
            plan.append(ctx.time_now_us + round(time_s * _US_PER_S), Pose.from_xyz_yaw(x, y, 0.0, yaw))
        return DriveResult(trajectory_in_rig=plan, debug_scalars={"steering_rad": steering_rad})


def _arc(curvature_1pm: float, along_m: NDArray[Any]) -> NDArray[np.float64]:
    """Poses ``[N, 3]`` (x, y [m], yaw [rad]) on the arc that starts ahead."""
    yaw = curvature_1pm * along_m
    chord_m = along_m * np.sinc(0.5 * yaw / np.pi)
    return np.column_stack([chord_m * np.cos(0.5 * yaw), chord_m * np.sin(0.5 * yaw), yaw])


def _headings(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heading [rad] at each waypoint ``[N, 2]``: of the piece that leads to it."""
    steps = np.diff(points, axis=0, prepend=0.0)
    return np.asarray(np.arctan2(steps[:, 1], steps[:, 0]))


def _fits(camera: Any, wanted: Any) -> bool:
    spec = camera.intrinsics
    if (spec.resolution_w, spec.resolution_h) != (wanted.width, wanted.height):
        return False
    if spec.WhichOneof("camera_param") != "opencv_pinhole_param":
        return False
    lens = spec.opencv_pinhole_param
    given = (lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y)
    expected = (wanted.fx, wanted.fy, wanted.cx, wanted.cy)
    return all(
        abs(has - wants) <= _FOCAL_SHARE * wanted.fx for has, wants in zip(given, expected, strict=True)
    )


def _described(camera: Any) -> str:
    spec = camera.intrinsics
    lens = spec.WhichOneof("camera_param")
    focal = (
        f" with {spec.opencv_pinhole_param.focal_length_x:.1f} px" if lens == "opencv_pinhole_param" else ""
    )
    return f"of {spec.resolution_w} x {spec.resolution_h}{focal}"


@contextmanager
def serving(policy: BaseDriver, listen: str, mode: ServiceMode = "carla") -> Iterator[str]:
    """Serve a policy while the block runs; yields the address for clients.

    Args:
        listen: ``HOST:PORT``; port 0 takes a free one. On an address that other computers reach, TLS with this user's certificate.
        mode: ``alpasim`` for a runtime of alpasim itself, whose opaque fields differ.

    Raises:
        ConfigError: The address is invalid, or taken.
    """
    host, port = listen_address(listen)
    # Two servers would silently share a port, and each answer some of the requests.
    options = [*channel_options(), ("grpc.so_reuseport", 0)]
    server = grpc.server(ThreadPoolExecutor(max_workers=_WORKERS), options=options)
    servicer = EgodriverServicer(policy, mode)
    add_EgodriverServiceServicer_to_server(servicer, server)
    add_CarlaVehicleServiceServicer_to_server(servicer, server)
    scheme = "grpc" if is_loopback(host.strip("[]")) else "grpcs"
    try:
        bound = (
            server.add_insecure_port(listen) if scheme == "grpc" else server.add_secure_port(listen, _tls())
        )
    except RuntimeError:
        bound = 0
    if bound == 0:
        raise ConfigError(f"cannot listen on {host}:{port}; stop the program that does, or take another port")
    server.start()
    try:
        yield f"{scheme}://{host}:{bound}"
    finally:
        server.stop(grace=_GRACE_S).wait()


def _tls() -> Any:
    own = certificate()
    return grpc.ssl_server_credentials([(own.key_file.read_bytes(), own.file.read_bytes())])
