import json
import struct
from pathlib import Path

import numpy as np
import pytest

import nodes
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import SecurityError
from nodes.runtime.messages import decode, encode, image_message, type_definition
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import TOPICS
from nodes.viewer import ViewerConfig, ViewerNode

pytestmark = pytest.mark.live

pytest.importorskip("foxglove")
client = pytest.importorskip("websockets.sync.client")
PIXELS = np.random.default_rng(2).integers(0, 256, (188, 336, 3), dtype=np.uint8)
MESSAGE_DATA = 1  # opcode of the protocol's binary message: opcode, subscription u32, log time u64, payload


def test_a_real_client_gets_the_published_bytes_and_the_schema(tmp_path):
    node = ViewerNode(ViewerConfig(port=0, topics=("/camera/image_raw",)))
    message = image_message(PIXELS, 77, "camera")
    try:
        with (
            Bus(tmp_path) as bus,
            Bus(tmp_path) as eyes,
            client.connect(f"ws://127.0.0.1:{node.port}", subprotocols=["foxglove.sdk.v1"]) as socket,
        ):
            info = json.loads(socket.recv(timeout=60))
            assert info["op"] == "serverInfo"
            assert not {"clientPublish", "services", "parameters"} & set(info["capabilities"])
            advertised = json.loads(socket.recv(timeout=60))["channels"][0]
            assert (advertised["topic"], advertised["encoding"]) == ("/camera/image_raw", "cdr")
            assert advertised["schemaEncoding"] == "ros2msg"
            assert advertised["schema"] == type_definition("sensor_msgs/msg/Image")
            subscription = {"id": 5, "channelId": advertised["id"]}
            socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            eyes.subscribe("/camera/image_raw")
            bus.publisher("/camera/image_raw")
            bus.wait_for_subscribers(["/camera/image_raw"], 60.0)
            data = None
            for _ in range(100):
                bus.publish("/camera/image_raw", message)
                eyes.wait(1.0)
                for received in eyes.receive():
                    node.handle(received.topic, None, received.info, SystemClock().now())
                try:
                    data = socket.recv(timeout=0.05)
                except TimeoutError:
                    continue
                break
            assert isinstance(data, bytes)
            opcode, number, _ = struct.unpack_from("<BIQ", data)
            assert (opcode, number) == (MESSAGE_DATA, 5)
            assert data[13:] == encode(message)
            np.testing.assert_array_equal(
                rgb_image(decode("sensor_msgs/msg/Image", data[13:]), "test"), PIXELS
            )
            assert node.status()[0] == "active"
    finally:
        node.close()


def test_an_address_for_all_must_be_meant():
    with pytest.raises(SecurityError, match="without keys"):
        ViewerNode(ViewerConfig(host="0.0.0.0", port=0))


def test_shipped_layout_shows_topics_that_exist():
    text = (Path(nodes.__file__).parent / "foxglove_layout.json").read_text()
    panels = json.loads(text)["configById"]
    assert panels["Image!attacked"]["imageMode"]["imageTopic"] in TOPICS
    assert panels["Image!camera"]["imageMode"]["imageTopic"] in TOPICS
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert paths
    assert all(path.split(".")[0] in TOPICS for path in paths)
