"""Real rclpy programs as peers: images, poses and diagnostics arrive, and a policy in ROS drives the simulated lab.

The programs run in an environment of their own: ``make test-ros2``.
"""

import hashlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from benchmarks.rclpy_peer import PEERS, ROOT, RclpyPeer, peers_have
from hardware.mocap.vicon import free_udp_port
from nodes.bags import read_info, read_messages
from nodes.runtime.messages import decode, drive_message, image_message, pose_message, stamp_ns, types
from nodes.runtime.messages import header as make_header
from tests.support.live.operator import LiveOperator
from tests.support.live.ros2_bridge import VEHICLE, Bridge

pytestmark = [pytest.mark.ros2, pytest.mark.live]
pytest.importorskip("cyclonedds")

DOMAIN = 71
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
REFERENCE = ROOT / "docs" / "results" / "reference" / "policy_722ab9106e2fbad0" / "policy.safetensors"


@pytest.fixture(autouse=True, scope="module")
def _peers_are_installed():
    if not peers_have("rclpy"):
        pytest.skip("no environment with rclpy; make setup-ros2 installs one")


@pytest.fixture
def bridge_of(tmp_path):
    made = []

    def make(config, domain=DOMAIN):
        made.append(Bridge(tmp_path, config, domain))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def peer_of():
    made = []

    def make(script, *arguments, domain=DOMAIN):
        made.append(RclpyPeer(domain, script, *arguments))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.mark.parametrize("reliability", ["best_effort", "reliable"])
def test_rclpy_gets_every_image_with_the_same_pixels(bridge_of, peer_of, reliability):
    bridge = bridge_of(
        {"send": [{"topic": "/compositor/image", "ros": "/image_raw", "reliability": reliability}]}
    )
    peer = peer_of(PEERS / "answering.py", "--digest", *["--reliable"] * (reliability == "reliable"))
    bridge.wait_for_readers("/image_raw")
    time.sleep(1.0)  # the other end of the match
    rng, sent = np.random.default_rng(0), {}
    began = time.monotonic()
    for k in range(50):
        pixels = rng.integers(0, 256, (188, 336, 3), dtype=np.uint8)
        stamp = time.time_ns()
        sent[stamp] = hashlib.sha256(pixels.tobytes()).hexdigest()
        bridge.bus.publish("/compositor/image", image_message(pixels, stamp, "camera"))
        bridge.watch(max(0.0, began + (k + 1) / 10.0 - time.monotonic()))
    bridge.watch(1.0)
    got = {line["stamp_ns"]: line["sha256"] for line in peer.lines}
    assert got.items() <= sent.items()
    # Best effort may lose an image on a busy machine.
    assert len(got) == len(sent) if reliability == "reliable" else len(got) >= 0.9 * len(sent)
    assert peer.lines[0]["shape"] == [188, 336, "rgb8", 336 * 3]


def test_commands_of_rclpy_arrive_as_answers_only(bridge_of, peer_of):
    bridge = bridge_of(
        {
            "send": [{"topic": "/compositor/image", "ros": "/image_raw"}],
            "take": [
                {
                    "topic": "/policy/drive",
                    "ros": "/cmd_vel",
                    "type": "geometry_msgs/msg/TwistStamped",
                    "answers": "/compositor/image",
                }
            ],
        }
    )
    peer_of(PEERS / "answering.py", "--commands", "/cmd_vel", "--speed", "0.5")
    bridge.wait_for_readers("/image_raw")
    time.sleep(1.0)
    pixels, stamps = np.zeros((188, 336, 3), np.uint8), []
    for _ in range(20):
        stamps.append(time.time_ns())
        bridge.bus.publish("/compositor/image", image_message(pixels, stamps[-1], "camera"))
        bridge.watch(0.1)
    bridge.watch(0.3)
    assert [stamp_ns(message) for _, message in bridge.got] == stamps
    assert {(message.drive.speed, message.drive.steering_angle) for _, message in bridge.got} == {(0.5, 0.0)}
    assert bridge.state[0] == "active"
    # A second publisher makes the first one worthless, too.
    peer_of(PEERS / "answering.py", "--commands", "/cmd_vel", "--speed", "0.9")
    deadline = time.monotonic() + 120.0
    while bridge.state[0] != "fault" and time.monotonic() < deadline:
        bridge.watch(0.1)
    assert "2 publishers" in bridge.state[1]
    bridge.got.clear()
    for _ in range(5):
        bridge.bus.publish("/compositor/image", image_message(pixels, time.time_ns(), "camera"))
        bridge.watch(0.1)
    assert bridge.got == []


def test_rclpy_reads_poses_odometry_diagnostics_and_commands(bridge_of, peer_of):
    bridge = bridge_of(
        {
            "send": [
                {"topic": "/vicon/car", "ros": "/pose"},
                {"topic": "/odom"},
                {
                    "topic": "/compositor/attack",
                    "ros": "/attack",
                    "type": "diagnostic_msgs/msg/DiagnosticArray",
                },
                {"topic": "/safety/drive", "ros": "/car_cmd", "type": "geometry_msgs/msg/TwistStamped"},
            ]
        }
    )
    peer = peer_of(
        PEERS / "listening.py",
        "/pose=geometry_msgs/PoseStamped",
        "/odom=nav_msgs/Odometry",
        "/attack=diagnostic_msgs/DiagnosticArray",
        "/car_cmd=geometry_msgs/TwistStamped",
    )
    bridge.wait_for_readers("/pose", "/odom", "/attack", "/car_cmd")
    time.sleep(1.0)
    now_ns = time.time_ns()
    pose = pose_message(planar_pose(1.5, -2.0, 0.5), now_ns, "world")
    zero, covariance = types.Vector3(x=0.0, y=0.0, z=0.0), np.zeros(36)
    odometry = types.Odometry(
        header=pose.header,
        child_frame_id="car",
        pose=types.PoseWithCovariance(pose=pose.pose, covariance=covariance),
        twist=types.TwistWithCovariance(twist=types.Twist(linear=zero, angular=zero), covariance=covariance),
    )
    attack = types.AttackStamp(header=make_header(now_ns), attack_id="ab12", drawn=True, reason="")
    for topic, message in (
        ("/vicon/car", pose),
        ("/odom", odometry),
        ("/compositor/attack", attack),
        ("/safety/drive", drive_message(0.5, 0.2, now_ns)),
    ):
        bridge.bus.publish(topic, message)
    deadline = time.monotonic() + 120.0
    while len(dict(peer.lines)) < 4 and time.monotonic() < deadline:
        bridge.watch(0.1)
    got = dict(reversed(peer.lines))  # the first of each
    assert got["/pose"]["pose"]["position"] == {"x": 1.5, "y": -2.0, "z": 0.0}
    assert got["/pose"]["header"]["frame_id"] == "world"
    assert got["/odom"]["pose"]["pose"] == got["/pose"]["pose"]
    assert {each["key"]: each["value"] for each in got["/attack"]["status"][0]["values"]} == {
        "attack_id": "ab12",
        "drawn": "true",
    }
    twist = got["/car_cmd"]["twist"]
    assert twist["linear"]["x"] / twist["angular"]["z"] == pytest.approx(0.25 / np.tan(0.2), rel=1e-5)
    # The safety node of this test is silent from now on, so the car in ROS is told to stop.
    bridge.watch(1.0)
    stops = [line["twist"]["linear"]["x"] for name, line in peer.lines if name == "/car_cmd"]
    assert stops[0] == 0.5
    assert set(stops[1:]) == {0.0}


def launch_of(file, run_dir, *settings):
    """A launch as a process; its log lies beside the run folder."""
    options = [word for setting in settings for word in ("--set", setting)]
    with open(run_dir.with_suffix(".log"), "wb") as log:
        command = [
            sys.executable,
            "-m",
            "nodes.cli.main",
            "launch",
            file,
            "--folder",
            str(run_dir),
            *options,
        ]
        return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)


def test_a_car_in_ros_obeys_the_safety_node_only(tmp_path, peer_of):
    run_dir, domain = tmp_path / "run", DOMAIN + 2
    launch = launch_of(
        "launch/ros2_car.launch.yaml",
        run_dir,
        f"params.domain_id={domain}",
        "policy.module=tests.support.live.straight_policy",
        "policy.config.speed_mps=0.5",
        "ros2.send=[{topic: /safety/drive, ros: /safe_cmd, type: geometry_msgs/msg/TwistStamped}]",
        "record=false",
    )
    operator = LiveOperator(run_dir, ("compositor", "policy", "ros2", "safety"))
    car = peer_of(PEERS / "car.py", "/safe_cmd", "-2.0", "-2.0", domain=domain)

    def moved_after(mono_ns):
        return [line for line in car.lines if line["mono_ns"] > mono_ns and line["speed_mps"] != 0.0]

    try:
        operator.wait_until(lambda: operator.state_of("ros2") == "active", 60.0, "for the car")
        operator.watch(1.0)
        assert not moved_after(0)
        operator.say_arm(source="trial")
        operator.watch(0.5)
        assert not operator.armed  # a program may arm only the simulated car
        operator.wait_until(
            lambda: (operator.say_arm(source="operator"), operator.watch(0.3), operator.armed)[2],
            20.0,
            "to arm",
        )
        operator.watch(1.0)
        assert operator.armed, operator.describe()
        assert {line["speed_mps"] for line in moved_after(0)} == {0.5}
        # The safety node hangs: nothing arrives from it any more, and the ROS 2 node tells the car to stop.
        os.kill(operator.pid_of("safety"), signal.SIGSTOP)
        hung_ns = time.monotonic_ns()
        operator.watch(1.0)
        stop = next(line for line in car.lines if line["mono_ns"] > hung_ns and line["speed_mps"] == 0.0)
        assert (stop["mono_ns"] - hung_ns) / 1e6 <= 350.0
        assert not moved_after(stop["mono_ns"])
    finally:
        operator.bus.close()
        os.kill(operator.pid_of("safety"), signal.SIGCONT)
        launch.send_signal(signal.SIGINT)
        launch.wait(120)


def test_a_policy_in_ros_answers_as_a_black_box(tmp_path, peer_of):
    torch = pytest.importorskip("torch")
    from advnerf_core.policies.load import load_driver
    from advnerf_core.policies.view import PolicyView
    from nodes.lab.ros2_policy import ros2_policy

    onnx = tmp_path / "policy.onnx"
    command = [
        sys.executable,
        "-m",
        "nodes.cli.main",
        "policy",
        "export",
        str(REFERENCE),
        "--onnx",
        str(onnx),
    ]
    subprocess.run(command, cwd=ROOT, check=True)
    peer_of(ROOT / "examples" / "ros2_policy.py", str(onnx), domain=DOMAIN + 3)
    policy = ros2_policy(VEHICLE.parent / "camera.yaml", VEHICLE, domain_id=DOMAIN + 3)
    itself = load_driver(onnx)
    images = np.random.default_rng(1).integers(0, 256, (5, 188, 336, 3), dtype=np.uint8)
    asked = policy(torch.from_numpy(np.moveaxis(images, -1, 1) / np.float32(255.0)))
    assert not policy.differentiable
    assert isinstance(policy.contract.view, PolicyView)
    expected = [itself.steer(itself.view.image(image), ()) for image in images]
    assert asked.tolist() == pytest.approx(expected, abs=1e-4)
    assert np.ptp(expected) > 1e-3


def test_a_policy_in_ros_drives_the_lab_and_the_drive_is_recorded(tmp_path, peer_of):
    onnx = tmp_path / "policy.onnx"
    advnerf = [sys.executable, "-m", "nodes.cli.main"]
    subprocess.run([*advnerf, "policy", "export", str(REFERENCE), "--onnx", str(onnx)], cwd=ROOT, check=True)
    run_dir, domain = tmp_path / "run", DOMAIN + 1
    settings = (f"params.domain_id={domain}", f"params.vicon_port={free_udp_port()}")
    launch = launch_of("launch/ros2.launch.yaml", run_dir, *settings)
    nodes = ("twin", "camera", "vicon", "compositor", "ros2", "safety", "motor")
    operator = LiveOperator(run_dir, nodes)
    try:
        operator.wait_ready(90.0)
        assert not operator.armed
        peer = peer_of(ROOT / "examples" / "ros2_policy.py", str(onnx), domain=domain)
        operator.wait_until(lambda: operator.state_of("ros2") == "active", 40.0, "for the policy")
        operator.watch(1.0)
        assert not operator.armed  # commands alone do not arm
        start = operator.seen["/vicon/car"].pose.position
        operator.arm()
        operator.watch(4.0)
        assert operator.armed, operator.describe()
        now = operator.seen["/vicon/car"].pose.position
        assert np.hypot(now.x - start.x, now.y - start.y) > 1.5
        peer.process.send_signal(signal.SIGKILL)
        operator.wait_until(lambda: not operator.armed, 2.0, "for the stop")
        assert "no command from the policy" in operator.seen["/safety/state"].reason
        operator.watch(1.0)
        assert abs(operator.seen["/motor/state"].speed_mps) < 0.05
    finally:
        operator.bus.close()
        launch.send_signal(signal.SIGINT)
        assert launch.wait(120) == 0
    bag = run_dir / "bag"
    counts = {topic.name: topic.count for topic in read_info(bag).topics}
    assert counts["/policy/drive"] >= 40
    images = {
        stamp_ns(decode("sensor_msgs/msg/Image", m.cdr)) for m in read_messages(bag, ["/compositor/image"])
    }
    commands = [decode(ACKERMANN, m.cdr) for m in read_messages(bag, ["/policy/drive"])]
    assert {stamp_ns(command) for command in commands} <= images
