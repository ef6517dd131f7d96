import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import LoadedPolicy, PolicyFileError, load_policy, save_policy
from advnerf_core.policies.torch_driver import TorchDriver
from advnerf_core.policies.view import PolicyView
from nodes.policy import PolicyNode, PolicyNodeConfig
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import decode, encode, image_message, stamp_ns, type_name
from nodes.runtime.node import MessageInfo, NodeContext

pytestmark = pytest.mark.live

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
T0 = 1_700_000_000_000_000_000
MS = 1_000_000


def _loaded(goal_size: int = 0) -> LoadedPolicy:
    torch.manual_seed(0)
    return LoadedPolicy(PilotNet(goal_size).eval().requires_grad_(False), VIEW, {}, "ab" * 32)


def _node(driver: TorchDriver, **settings: Any) -> PolicyNode:
    return PolicyNode(PolicyNodeConfig(policy="policy", **settings), driver)


def _rgb(value: int = 90, shape: tuple[int, int, int] = (188, 336, 3)) -> np.ndarray:
    return (np.random.default_rng(value).random(shape) * 255).astype(np.uint8)


def _send(node: PolicyNode, message, captured_ms: int = 30, published_ms: int = 2):
    """Hand over a message through CDR, ``captured_ms`` after its stamp and ``published_ms`` after publication."""
    raw = encode(message)
    clock = ManualClock(mono_ns=10**10, real_ns=stamp_ns(message) + captured_ms * MS)
    info = MessageInfo(10**10 - published_ms * MS, 10**10, raw=raw)
    return node.handle("/compositor/image", decode(type_name(message), raw), info, clock.now())


def test_steers_like_the_policy_and_keeps_the_capture_stamp() -> None:
    node, rgb = _node(TorchDriver(_loaded()), speed_mps=0.7), _rgb()
    (out,) = _send(node, image_message(rgb, T0, "camera"))
    assert out.topic == "/policy/drive"
    assert stamp_ns(out.message) == T0
    expected = float(_loaded().policy(images_to_tensor(VIEW.image(rgb)))[0])
    assert out.message.drive.steering_angle == pytest.approx(expected, abs=1e-6)
    assert out.message.drive.speed == pytest.approx(0.7)
    assert node.status()[0] == "active"
    assert node.counters()["images"] == 1
    encode(out.message)


@pytest.mark.parametrize(("captured_ms", "published_ms"), [(151, 2), (30, 151)])
def test_stale_images_are_refused(captured_ms: int, published_ms: int) -> None:
    node = _node(TorchDriver(_loaded()))
    assert _send(node, image_message(_rgb(), T0, "camera"), captured_ms, published_ms) == []
    assert node.counters()["dropped_stale"] == 1
    assert node.status() == ("ready", "image is 151 ms old")
    assert len(_send(node, image_message(_rgb(), T0, "camera"), 149, 149)) == 1
    assert node.status()[0] == "active"


def test_images_of_a_recording_may_be_old_or_of_a_clock_ahead_but_not_held_up() -> None:
    node = _node(TorchDriver(_loaded()), recorded=True)
    for captured_ms in (3_600_000, -3_600_000):
        (out,) = _send(node, image_message(_rgb(), T0, "camera"), captured_ms, 2)
        assert stamp_ns(out.message) == T0
    assert _send(node, image_message(_rgb(), T0, "camera"), 30, 151) == []
    assert node.status() == ("ready", "image is 151 ms old")


def test_images_that_the_policy_does_not_know_are_a_fault() -> None:
    node = _node(TorchDriver(_loaded()))
    assert _send(node, image_message(_rgb(shape=(94, 168, 3)), T0, "camera")) == []
    assert node.status() == ("fault", "expected images of 336 x 188, got 168 x 94; train for this camera")
    depth = image_message(_rgb(), T0, "camera")
    depth.encoding = "32FC1"
    assert _send(node, depth) == []
    assert "expected a supported image encoding, got '32FC1'" in node.status()[1]
    assert _send(node, image_message(_rgb(), T0, "camera"), captured_ms=-50) == []
    assert "clocks" in node.status()[1]
    assert node.counters()["dropped_bad"] == 3
    assert len(_send(node, image_message(_rgb(), T0, "camera"))) == 1


def test_a_policy_that_is_not_finite_sends_nothing() -> None:
    loaded = _loaded()
    node = _node(TorchDriver(loaded))
    with torch.no_grad():
        loaded.policy.head[-1].bias.fill_(float("nan"))
    assert _send(node, image_message(_rgb(), T0, "camera")) == []
    assert node.status() == ("fault", "the policy's output is not finite")


def test_status_shows_that_images_have_stopped() -> None:
    node = _node(TorchDriver(_loaded()))
    assert node.status() == ("ready", "policy abababababab, waiting for images")
    _send(node, image_message(_rgb(), T0, "camera"))
    clock = ManualClock(mono_ns=10**10 + 1100 * MS)
    assert node.tick(clock.now()) == []
    assert node.status()[0] == "ready"


def test_built_from_a_file_with_its_hash(tmp_path: Path) -> None:
    digest = save_policy(tmp_path / "policy.safetensors", _loaded().policy, VIEW, {})
    context = NodeContext("policy", tmp_path, ManualClock())
    threads = torch.get_num_threads()
    try:
        config = PolicyNodeConfig(
            policy=str(tmp_path / "policy.safetensors"), sha256=digest, image_topic="/camera/image_raw"
        )
        node = PolicyNode.build(config, context)
        assert node.subscriptions == ("/camera/image_raw",)
        assert torch.get_num_threads() == 1
        with pytest.raises(PolicyFileError, match="expected the policy 00"):
            PolicyNode.build(config.model_copy(update={"sha256": "00"}), context)
    finally:
        torch.set_num_threads(threads)
    assert load_policy(tmp_path / "policy.safetensors").sha256 == digest


def test_goal_must_fit_the_policy() -> None:
    with pytest.raises(ConfigError, match="goal of 3 numbers for this policy, got 0"):
        _node(TorchDriver(_loaded(goal_size=3)))
    node = _node(TorchDriver(_loaded(goal_size=3)), goal=(0.0, 1.0, 0.0))
    assert len(_send(node, image_message(_rgb(), T0, "camera"))) == 1


def test_a_policy_of_several_images_forgets_them_after_a_gap() -> None:
    contract = PolicyContract(VIEW, frames=FrameStack(count=2, axis="time"))
    network = adapt(lambda stack: stack.mean((2, 3, 4)) @ torch.tensor([0.5, 1.0]), contract)
    node = _node(TorchDriver(LoadedPolicy(network, VIEW, {}, "ab" * 32)))
    greys = [np.full((188, 336, 3), value, np.uint8) for value in (51, 102, 204)]

    def steered(grey: np.ndarray, at_ms: int) -> float:
        raw = encode(image_message(grey, T0, "camera"))
        clock = ManualClock(mono_ns=10**10 + at_ms * MS, real_ns=T0)
        info = MessageInfo(clock.now().mono_ns, 10**10, raw=raw)
        (out,) = node.handle(
            "/compositor/image", decode(type_name(image_message(grey, T0, "camera")), raw), info, clock.now()
        )
        return float(out.message.drive.steering_angle)

    assert steered(greys[0], 0) == pytest.approx(0.3), (
        "the first image is also the one before; the warm-up is forgotten"
    )
    assert steered(greys[1], 1000) == pytest.approx(0.5 * 0.2 + 0.4)
    assert steered(greys[2], 2001) == pytest.approx(1.5 * 0.8)


def test_the_speed_of_waypoints_is_used_where_it_is_asked_for() -> None:
    tracked = {"times_s": [0.5, 1.0], "lookahead_m": 0.3, "wheelbase_m": 0.25}
    contract = PolicyContract(VIEW, trajectory=tracked)
    line = torch.tensor([[0.3, 0.0], [0.6, 0.0]])
    network = adapt(lambda images: images.mean() * line.expand(len(images), 2, 2), contract)
    loaded, image = LoadedPolicy(network, VIEW, {}, "ab" * 32), np.full((188, 336, 3), 255, np.uint8)

    def speed(**settings: object) -> float:
        (out,) = _send(_node(TorchDriver(loaded), **settings), image_message(image, T0, "camera"))
        return float(out.message.drive.speed)

    assert speed(speed_mps=0.8) == pytest.approx(0.8)
    assert speed(speed_mps=0.8, planned_speed=True) == pytest.approx(0.6)
    assert speed(speed_mps=0.4, planned_speed=True) == pytest.approx(0.4), "the node's own is the limit"
    with pytest.raises(ConfigError, match="answers with waypoints for planned_speed"):
        _node(TorchDriver(_loaded()), planned_speed=True)


def test_an_onnx_policy_steers_alike_in_a_process_without_torch(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    file = tmp_path / "policy.onnx"
    export_onnx(_loaded(goal_size=2).policy, PolicyContract(VIEW, goal_size=2), file)
    np.save(tmp_path / "rgb.npy", _rgb())
    code = f"""
import sys
sys.modules["torch"] = None
import numpy as np
from pathlib import Path
from nodes.policy import PolicyNodeConfig, PolicyNode
from nodes.runtime.clock import ManualClock
from nodes.runtime.messages import image_message
from nodes.runtime.node import MessageInfo, NodeContext
node = PolicyNode.build(PolicyNodeConfig(policy={str(file)!r}, goal=(0.5, -1.0)), NodeContext("policy", Path("."), ManualClock()))
clock = ManualClock(mono_ns=10**10, real_ns={T0} + 10**7)
(out,) = node.handle("/compositor/image", image_message(np.load({str(tmp_path / "rgb.npy")!r}), {T0}, "c"), MessageInfo(10**10, 10**10), clock.now())
print(out.message.drive.steering_angle)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    goal = torch.tensor([[0.5, -1.0]])
    expected = float(_loaded(goal_size=2).policy(images_to_tensor(VIEW.image(_rgb())), goal)[0])
    assert float(done.stdout) == pytest.approx(expected, abs=1e-5)


def test_a_camera_that_sends_bgr_is_steered_by_in_its_true_colours() -> None:
    node, rgb = _node(TorchDriver(_loaded())), _rgb()
    (straight,) = _send(node, image_message(rgb, T0, "camera"))
    (turned,) = _send(node, image_message(np.ascontiguousarray(rgb[..., ::-1]), T0, "camera", "bgr8"))
    assert turned.message.drive.steering_angle == straight.message.drive.steering_angle
