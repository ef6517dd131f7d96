"""Compressed pictures at their consumers: the same decisions as with raw ones, and damage is dropped and said."""

from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.policies.torch_driver import TorchDriver
from advnerf_core.policies.view import PolicyView
from nodes.compositor import CompositorConfig, CompositorNode
from nodes.policy import PolicyNode, PolicyNodeConfig
from nodes.runtime.clock import ManualClock
from nodes.runtime.messages import decode, encode, image_message, stamp_ns, type_name
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.pictures import COMPRESSED_TOPIC, compressed_image_message, rgb_image

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
T0 = 1_700_000_000_000_000_000
CLOCK = ManualClock(mono_ns=10**10, real_ns=T0 + 20_000_000)


def picture():
    rows, columns = np.mgrid[0:188, 0:336]
    return np.stack([rows, columns // 2, 255 - rows], axis=2).astype(np.uint8)


def hand_over(node, message):
    raw = encode(message)
    info = MessageInfo(CLOCK.now().mono_ns, CLOCK.now().mono_ns, raw=raw)
    return node.handle(COMPRESSED_TOPIC, decode(type_name(message), raw), info, CLOCK.now())


def damaged():
    message = compressed_image_message(picture(), T0, "camera")
    message.data = message.data[:40]
    return message


@pytest.fixture
def compositor(tmp_path):
    config = CompositorConfig(
        camera=TWIN / "camera.yaml", target=TWIN / "board.yaml", image_topic=COMPRESSED_TOPIC
    )
    return CompositorNode.build(config, NodeContext("compositor", tmp_path, CLOCK))


def test_compositor_takes_compressed_pictures_and_gives_raw_ones(compositor):
    assert COMPRESSED_TOPIC in compositor.subscriptions
    assert "/camera/image_raw" not in compositor.subscriptions
    image, label = hand_over(compositor, compressed_image_message(picture(), T0, "camera", 95))
    assert (type_name(image.message), stamp_ns(image.message)) == ("sensor_msgs/msg/Image", T0)
    assert stamp_ns(label.message) == T0
    assert np.abs(rgb_image(image.message, "test").astype(int) - picture()).max() < 12
    assert encode(image.message)


def test_compositor_drops_a_damaged_picture_and_says_so(compositor):
    assert hand_over(compositor, damaged()) == []
    assert compositor.counters()["dropped_bad"] == 1
    assert "image dropped: /camera/image_raw/compressed: expected JPEG data" in compositor.status()[1]
    assert len(hand_over(compositor, compressed_image_message(picture(), T0, "camera"))) == 2
    assert "dropped" not in compositor.status()[1]


def test_compositor_listens_to_cameras_only():
    with pytest.raises(ValidationError, match="image_raw/compressed"):
        CompositorConfig(
            camera=TWIN / "camera.yaml", target=TWIN / "board.yaml", image_topic="/compositor/image"
        )


def test_policy_steers_nearly_as_with_the_raw_picture():
    torch.manual_seed(0)
    view = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
    loaded = LoadedPolicy(PilotNet(0).eval().requires_grad_(False), view, {}, "ab" * 32)
    node = PolicyNode(PolicyNodeConfig(policy="policy"), TorchDriver(loaded))
    (raw,) = hand_over(node, image_message(picture(), T0, "camera"))
    (small,) = hand_over(node, compressed_image_message(picture(), T0, "camera", 95))
    assert stamp_ns(small.message) == T0
    angles = [out.message.drive.steering_angle for out in (raw, small)]
    assert angles[0] == pytest.approx(angles[1], abs=2e-3)
    assert hand_over(node, damaged()) == []
    assert node.counters()["dropped_bad"] == 1
    assert "expected JPEG data" in node.status()[1]
