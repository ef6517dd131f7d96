"""A driver behind a socket as a policy: alpasim's egodriver protocol, which CARLA users also have (PyPI ``carla-driver-interface``).

The driver receives a camera's pictures and the car's pose, and answers with a plan: poses ahead. A car of constant speed follows it with the
tracker of `advnerf_core.policies.tracker`, which looks as far ahead as the car drives in half a second. The poses are integrated from the start of the drive by the car's steering, like an odometer's. No route is sent: a policy of this project sees
pictures.

A drive is a session. The memory of the policy holds, per car: the session, the tick, x [m], y [m], yaw [rad].
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
import uuid
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.data.image_files import encoded
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.policies.adapter import AdaptedPolicy, adapt
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.policies.tracker import TrackedTrajectory, pursued_points
from advnerf_core.policies.view import PolicyView

_ADDRESS = re.compile(r"(grpcs?)://(\[[0-9a-f:]+\]|[^:/\s]+):(\d{1,5})")
_CAMERA, _US_PER_S = "camera_front", 1_000_000
_LOOKAHEAD_S, _ANSWER_S = 0.5, 60.0
# A plan leads backwards from this share of the lookahead behind the car on; one that stands still is nearer.
_BACKWARDS = 0.1


@dataclass(frozen=True, eq=False)
class DrivenRig:
    """The car and camera that a driver is told about.

    Attributes:
        pinhole: Intrinsics of the sent pictures.
        T_car_from_camera: Pose ``[4, 4]`` of the camera on the car.
        speed_mps: The car's speed [m/s].
        dt_s: Time between two pictures [s].
        wheelbase_m: Distance between the axles [m]; None for a car whose control is a turn rate.
        control_limits: Rightmost and leftmost control of the car, which clamps others.
    """

    pinhole: Pinhole
    T_car_from_camera: Array
    speed_mps: float
    dt_s: float
    wheelbase_m: float | None
    control_limits: tuple[float, float]

    @cached_property
    def tracker(self) -> TrackedTrajectory:
        """The tracker of the plans, which may have any length."""
        speed_mps = self.speed_mps if self.wheelbase_m is None else None
        return TrackedTrajectory(
            times_s=(_LOOKAHEAD_S,),
            lookahead_m=self.speed_mps * _LOOKAHEAD_S,
            wheelbase_m=self.wheelbase_m,
            car_speed_mps=speed_mps,
        )

    def turn_rate_radps(self, control: float) -> float:
        """Turn rate of the car under a control, which it clamps at its limits."""
        clamped = float(np.clip(control, *self.control_limits))
        return (
            clamped
            if self.wheelbase_m is None
            else self.speed_mps * float(np.tan(clamped)) / self.wheelbase_m
        )


class EgoDriver:
    """A network for `advnerf_core.policies.adapter.adapt` that queries a driver.

    Args:
        address: ``grpc://HOST:PORT`` on this computer, or ``grpcs://HOST:PORT`` by TLS.

    Raises:
        PolicyContractError: The address is invalid, its package is not installed, or no driver answers.
    """

    training = False

    def __init__(self, address: str, rig: DrivenRig) -> None:
        self.address, self.rig = address, rig
        self._channel = _channel(address)
        self._sessions: list[str] = []
        self._revision = 0
        self.identity = self._version()

    @cached_property
    def _stub(self) -> Any:
        from carla_driver_interface.protocol import EgodriverServiceStub

        return EgodriverServiceStub(self._channel)

    def _version(self) -> str:
        from carla_driver_interface.contract import ContractError, negotiate
        from grpc import RpcError

        try:
            version, self._revision = negotiate(self._stub, timeout=_ANSWER_S)
        except RpcError as error:
            raise PolicyContractError(
                f"expected a driver at {self.address}, got {error.code().name}: {error.details()}; start it first"
            ) from None
        except ContractError as error:
            raise PolicyContractError(f"{self.address}: {error}") from None
        return f"{version.version_id} {version.git_hash}".strip()

    def initial_memory(self, batch: int) -> Tensor:
        """Begin a session for each car, and end earlier ones.

        Raises:
            PolicyContractError: Another driver than at first answers, or none.
        """
        from carla_driver_interface.protocol import DriveSessionCloseRequest

        if (now := self._version()) != self.identity:
            raise PolicyContractError(
                f"expected the driver {self.identity} at {self.address}, got {now}: another one was started there; start the first one again"
            )
        for session in self._sessions:
            self._ask("close_session", DriveSessionCloseRequest(session_uuid=session))
        self._sessions = [self._begin() for _ in range(batch)]
        memory = torch.zeros(batch, 5, dtype=torch.float64)
        memory[:, 0] = torch.arange(batch)
        return memory

    def _begin(self) -> str:
        from carla_driver_interface.contract import CONTRACT_REVISION, camera_to_revision, contract_metadata
        from carla_driver_interface.protocol import DriveSessionRequest

        session = str(uuid.uuid4())
        request = DriveSessionRequest(session_uuid=session, random_seed=0)
        request.debug_info.scene_id = "advnerf"
        camera = camera_to_revision(_camera(self.rig), CONTRACT_REVISION, self._revision)
        request.rollout_spec.vehicle.available_cameras.append(camera)
        self._ask("start_session", request, metadata=contract_metadata(self._revision))
        return session

    def __call__(self, images: Tensor, goals: Tensor | None, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Controls ``[B]`` of pictures ``[B, 3, H, W]``, and the memory ``[B, 5]`` after them."""
        del goals
        pictures = (images.detach() * 255.0).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        following, controls = memory.clone(), []
        for index, (number, tick, *pose) in enumerate(memory.tolist()):
            control = self._control(self._sessions[int(number)], int(tick), pose, pictures[index])
            controls.append(control)
            following[index, 1:] = torch.tensor([tick + 1, *self._moved(pose, control)])
        return images.new_tensor(controls), following

    def _control(self, session: str, tick: int, pose: list[float], picture: Array) -> float:
        """Control from the plan of one car."""
        from carla_driver_interface.geometry import Pose, Trajectory
        from carla_driver_interface.protocol import (
            DriveRequest,
            DynamicState,
            RolloutCameraImage,
            RolloutEgoTrajectory,
            Vec3,
        )

        now_us = round(tick * self.rig.dt_s * _US_PER_S)
        rig = Pose.from_xyz_yaw(pose[0], pose[1], 0.0, pose[2])
        moved = RolloutEgoTrajectory(session_uuid=session)
        moved.trajectory.CopyFrom(Trajectory([now_us], [rig]).to_proto())
        moved.dynamic_states.append(DynamicState(linear_velocity=Vec3(x=self.rig.speed_mps)))
        self._ask("submit_egomotion_observation", moved)
        image = RolloutCameraImage(session_uuid=session)
        image.camera_image.logical_id = _CAMERA
        image.camera_image.frame_start_us = image.camera_image.frame_end_us = now_us
        image.camera_image.image_bytes = encoded(np.ascontiguousarray(picture), ".png")
        self._ask("submit_image_observation", image)
        query_us = now_us + round(self.rig.dt_s * _US_PER_S)
        request = DriveRequest(session_uuid=session, time_now_us=now_us, time_query_us=query_us)
        plan = Trajectory.from_proto(self._ask("drive", request).trajectory)
        if not len(plan):
            return 0.0  # a driver without a plan holds its course
        ahead = rig.inverse().transform_points(plan.positions)[None, :, :2]
        self._require_drivable(ahead, tick)
        return float(self.rig.tracker.control(ahead)[0])

    def _require_drivable(self, ahead: Array, tick: int) -> None:
        """Raise for a plan ``[1, N, 2]`` [m] that a car of constant speed cannot follow; the tracker makes a forward turn of one that leads backwards."""
        where = f"from the driver {self.identity} at {self.address} in tick {tick}"
        if not np.isfinite(ahead).all():
            wrong = int(np.argmin(np.isfinite(ahead).all(axis=-1)))
            raise PolicyContractError(
                f"expected a plan of finite positions {where}, got NaN or infinity as pose {wrong + 1} of {ahead.shape[1]}; correct the driver"
            )
        lookahead_m = self.rig.tracker.lookahead_m
        x_m, y_m = pursued_points(ahead, lookahead_m)[0].tolist()
        if x_m < -_BACKWARDS * lookahead_m:
            raise PolicyContractError(
                f"expected a plan that leads ahead {where}, got one to {x_m:.2f} m ahead and {y_m:.2f} m to the left of the car, whose speed is constant; "
                "plan in the car's frame, x forward"
            )

    def _moved(self, pose: list[float], control: float) -> list[float]:
        """The car's pose a tick later: along an arc."""
        turn_rad = self.rig.turn_rate_radps(control) * self.rig.dt_s
        way_m, yaw_rad = self.rig.speed_mps * self.rig.dt_s, pose[2] + 0.5 * turn_rad
        chord_m = way_m * float(np.sinc(0.5 * turn_rad / np.pi))
        return [
            pose[0] + chord_m * float(np.cos(yaw_rad)),
            pose[1] + chord_m * float(np.sin(yaw_rad)),
            pose[2] + turn_rad,
        ]

    def _ask(self, name: str, request: Any, **more: Any) -> Any:
        from grpc import RpcError

        try:
            return getattr(self._stub, name)(request, timeout=_ANSWER_S, **more)
        except RpcError as error:
            raise PolicyContractError(
                f"expected an answer of the driver at {self.address} to {name}, got {error.code().name}: {error.details()}"
            ) from None


def load_driver_at(
    address: str, view: PolicyView, rig: DrivenRig, expected_sha256: str | None = None
) -> LoadedPolicy:
    """A driver as a policy without a gradient; its hash identifies its version and its answers to fixed pictures.

    Raises:
        PolicyContractError: No driver answers, or another than expected.
    """
    policy = driver_at(address, view, rig)
    digest = hashlib.sha256(f"{policy.identity}\0{policy.contract.to_json()}\0{policy.answers()}".encode())
    sha256 = digest.hexdigest()
    if expected_sha256 not in (None, sha256):
        raise PolicyContractError(
            f"expected the driver {expected_sha256} at {address}, got {sha256}: it answers otherwise; run the experiment again"
        )
    return LoadedPolicy(policy, view, {"origin": address, "not_fixed": policy.identity}, sha256)


def driver_at(address: str, view: PolicyView, rig: DrivenRig) -> AdaptedPolicy:
    """A driver behind the contract of policies: pictures of a view in, controls out."""
    contract = PolicyContract(view, stateless=False, differentiable=False)
    return adapt(EgoDriver(address, rig), contract)


def _camera(rig: DrivenRig) -> Any:
    from carla_driver_interface.geometry import Pose
    from carla_driver_interface.protocol import (
        AvailableCamera,
        CameraSpec,
        OpenCVPinholeCameraParam,
        ShutterType,
    )
    from scipy.spatial.transform import Rotation

    T, pinhole = rig.T_car_from_camera, rig.pinhole
    spec = CameraSpec(
        opencv_pinhole_param=OpenCVPinholeCameraParam(
            principal_point_x=pinhole.cx,
            principal_point_y=pinhole.cy,
            focal_length_x=pinhole.fx,
            focal_length_y=pinhole.fy,
        ),
        logical_id=_CAMERA,
        resolution_w=pinhole.width,
        resolution_h=pinhole.height,
        shutter_type=ShutterType.GLOBAL,
    )
    pose = Pose.from_rotation(T[:3, 3], Rotation.from_matrix(T[:3, :3]))
    return AvailableCamera(intrinsics=spec, rig_to_camera=pose.to_proto(), logical_id=_CAMERA)


def _channel(address: str) -> Any:
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise PolicyContractError(f"expected grpc://HOST:PORT or grpcs://HOST:PORT, got {address}")
    scheme, host, port = found.groups()
    try:
        import grpc
        from carla_driver_interface.protocol import channel_options
    except ModuleNotFoundError:
        raise PolicyContractError(
            f"{address}: drivers behind a socket need a package: pip install 'advnerf[egodriver]'"
        ) from None
    if scheme == "grpcs":
        return grpc.secure_channel(
            f"{host}:{port}", grpc.ssl_channel_credentials(), options=channel_options()
        )
    if not _on_this_computer(host):
        raise PolicyContractError(
            f"expected a driver on this computer, or grpcs:// (TLS), got {address}: anyone on the way could steer; forward a port to this computer "
            "(ssh -L), or use TLS"
        )
    return grpc.insecure_channel(f"{host}:{port}", options=channel_options())


def _on_this_computer(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
