"""A policy that is served is driven by programs of others: the fake loop of carla-driver-interface, and our own client."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from advnerf_core.driving.rollout import Remembering
from advnerf_core.geometry import Pinhole, camera_mount
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.policies.torch_driver import TorchDriver
from advnerf_core.policies.tracker import TrackedTrajectory
from advnerf_core.policies.view import PolicyView
from nodes.runtime.errors import ConfigError

pytest.importorskip("carla_driver_interface")

import grpc
from carla_driver_interface.testing import FakeCamera, FakeLoop

from advnerf_core.policies.egodriver import DrivenRig, load_driver_at
from nodes.lab.policy_server import ServedCar, ServedPolicy, serving

CAMERA = FakeCamera(width=64, height=36, fov_deg=60.0)
FOCAL_PX = CAMERA.focal_px
PINHOLE = Pinhole(64, 36, FOCAL_PX, FOCAL_PX, 32.0, 18.0)
VIEW = PolicyView(PINHOLE, 0, 36, 64, 36)
WHEELBASE_M, STEERING_RAD = 2.5, 0.05


def driver_of(network, **declared):
    policy = adapt(network, PolicyContract(VIEW, **declared))
    return TorchDriver(LoadedPolicy(policy, VIEW, {}, "ab" * 32))


def constant(images):
    return torch.full((len(images),), STEERING_RAD)


def target(address):
    return address.partition("://")[2]


class KeepsTheLane(torch.nn.Module):
    """Steers to where the road is bright: the mean place of the markings in the lower half."""

    def forward(self, images):
        marking = (images[:, :, 18:].mean(1) - 0.5).clamp(min=0.0)
        side = torch.linspace(1.0, -1.0, 64)
        return 0.2 * (marking * side).sum((1, 2)) / (marking.sum((1, 2)) + 1e-3)


def test_the_fake_loop_drives_a_served_file_100_of_100_steps(tmp_path):
    file = tmp_path / "lane.onnx"
    export_onnx(KeepsTheLane().eval(), PolicyContract(VIEW), file)
    command = [sys.executable, "-m", "nodes.cli", "policy", "serve", str(file), "--listen", "127.0.0.1:0"]
    with subprocess.Popen(
        [*command, "--wheelbase", "2.5", "--speed", "6"], stdout=subprocess.PIPE, text=True
    ) as served:
        try:
            line = served.stdout.readline()
            assert line.startswith("lane.onnx-")
            with FakeLoop(
                target(line.split()[3].rstrip(";")), [CAMERA], initial_lateral_offset_m=0.4
            ) as loop:
                result = loop.run(100)
        finally:
            served.terminate()
        assert served.wait(30) == 128 + 15
    assert (result.steps, result.terminated_by_policy) == (100, False)
    assert result.ego.poses[-1].position[0] == pytest.approx(6.0 * 0.1 * 99, rel=0.02)
    assert abs(result.lateral_offsets_m[-1]) < abs(result.lateral_offsets_m[0]), "it keeps its lane"
    assert all(each.policy_name.startswith("lane.onnx-") for each in result.debug)


def test_a_policy_that_steers_is_answered_with_the_arc_at_the_speed_of_the_car():
    served = ServedPolicy(driver_of(constant), "constant", ServedCar(WHEELBASE_M))
    with (
        serving(served, "127.0.0.1:0") as address,
        FakeLoop(target(address), [CAMERA], initial_speed_mps=4.0) as loop,
    ):
        result = loop.run(50)
    radius_m = WHEELBASE_M / np.tan(STEERING_RAD)
    turned = 4.0 * 0.1 * 49 / radius_m
    x, y = result.ego.poses[-1].position[:2]
    assert (x, y) == pytest.approx((radius_m * np.sin(turned), radius_m * (1.0 - np.cos(turned))), rel=1e-2)


def test_waypoints_are_passed_on_with_their_times():
    def accelerates(images):
        return torch.tensor([[0.5, 0.0], [1.5, 0.0]]).expand(len(images), 2, 2)

    tracked = TrackedTrajectory(times_s=(0.1, 0.2), lookahead_m=1.0, wheelbase_m=1.0)
    served = ServedPolicy(driver_of(accelerates, trajectory=tracked), "waypoints", ServedCar())
    with serving(served, "127.0.0.1:0") as address, FakeLoop(target(address), [CAMERA], step_s=0.2) as loop:
        result = loop.run(3)
    assert result.speeds_mps[1:] == pytest.approx([7.5, 7.5])
    assert result.ego.poses[-1].position[0] == pytest.approx(3.0)


def test_our_client_and_our_server_agree_and_each_session_has_its_own_memory():
    stack = FrameStack(count=2, first="black")

    def changes(images):
        return 0.3 * (images[:, 3:].mean((1, 2, 3)) - images[:, :3].mean((1, 2, 3)))

    network = adapt(changes, PolicyContract(VIEW, frames=stack))
    served = ServedPolicy(TorchDriver(LoadedPolicy(network, VIEW, {}, "cd" * 32)), "changes", ServedCar(0.3))
    rig = DrivenRig(PINHOLE, camera_mount(0.3, 0.1, 0.2, 0.17), 0.8, 0.1, 0.3, (-0.3, 0.3))
    images = torch.rand(4, 2, 3, 36, 64, generator=torch.Generator().manual_seed(0)) * torch.rand(
        4, 2, 1, 1, 1
    )
    with serving(served, "127.0.0.1:0") as address:
        asked = Remembering(load_driver_at(address, VIEW, rig).policy, 2)
        here = Remembering(network, 2)
        for seen in images:
            assert asked(seen).tolist() == pytest.approx(here(seen).tolist(), abs=2e-3)


def test_a_wrong_camera_is_refused_when_the_session_starts():
    served = ServedPolicy(driver_of(constant), "constant", ServedCar(WHEELBASE_M))
    with serving(served, "127.0.0.1:0") as address:
        for camera in (
            FakeCamera(width=32, height=36, fov_deg=60.0),
            FakeCamera(width=64, height=36, fov_deg=90.0),
        ):
            with (
                FakeLoop(target(address), [camera]) as loop,
                pytest.raises(
                    grpc.RpcError, match=r"expected one camera of 64 x 36 with a focal length of 55\.4 px"
                ),
            ):
                loop.run(1)


def test_other_computers_are_served_by_tls(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    from nodes.operator_page.certificate import certificate

    served = ServedPolicy(driver_of(constant), "constant", ServedCar(WHEELBASE_M))
    with serving(served, "0.0.0.0:0") as address:
        assert address.startswith("grpcs://")
        port = address.rpartition(":")[2]
        trust = grpc.ssl_channel_credentials(certificate().file.read_bytes())
        with grpc.secure_channel(f"localhost:{port}", trust) as channel:
            assert FakeLoop(channel, [CAMERA]).run(2).steps == 2
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel, pytest.raises(grpc.RpcError):
            FakeLoop(channel, [CAMERA], timeout_s=5.0).run(1)


@pytest.mark.parametrize("wheelbase_m", [0.0, 29.0, 2900.0])
def test_a_wheelbase_in_another_unit_would_plan_straight_on(wheelbase_m):
    with pytest.raises(
        ConfigError, match="--wheelbase: expected metres above 0 and at most 20, not cm or mm, got"
    ):
        ServedPolicy(driver_of(constant), "constant", ServedCar(wheelbase_m))


def test_an_answer_that_is_no_number_is_no_plan():
    served = ServedPolicy(
        driver_of(lambda images: images.mean((1, 2, 3)) * np.nan), "nan", ServedCar(WHEELBASE_M)
    )
    with (
        serving(served, "127.0.0.1:0") as address,
        pytest.raises(grpc.RpcError, match="expected a finite plan from nan-"),
    ):
        FakeLoop(target(address), [CAMERA], initial_speed_mps=4.0).run(3)


def test_what_is_missing_is_said():
    with pytest.raises(ConfigError, match="give --wheelbase"):
        ServedPolicy(driver_of(constant), "constant", ServedCar())
    with pytest.raises(ConfigError, match="expected a goal of 2 numbers for this policy, got 0; give --goal"):
        ServedPolicy(driver_of(constant, goal_size=2), "constant", ServedCar(WHEELBASE_M))
    served = ServedPolicy(driver_of(constant), "constant", ServedCar(WHEELBASE_M))
    with (
        pytest.raises(ConfigError, match="expected HOST:PORT to listen on, got 6789"),
        serving(served, "6789"),
    ):
        pass
    with (
        serving(served, "127.0.0.1:0") as address,
        pytest.raises(ConfigError, match="cannot listen on"),
        serving(served, target(address)),
    ):
        pass
